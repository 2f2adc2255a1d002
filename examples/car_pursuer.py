"""A custom pursuer: a car, which cannot turn on the spot, and its barrier, solved on a grid."""

import jax.numpy as jnp

import sidestep
from sidestep.safety import grid_barrier, solve_distance
from sidestep.world import PursuerModel


class Car(PursuerModel):
    """Drives forwards at up to V, on arcs of a given radius or more (the homicidal chauffeur)."""

    radius: float = 1.0

    def limit(self, scenario, speed, turn_rate):
        speed = jnp.clip(speed, 0.0, scenario.pursuer_speed)
        return speed, jnp.clip(turn_rate, -speed / self.radius, speed / self.radius)

    def corners(self, scenario):
        return scenario.pursuer_speed * jnp.asarray([(0, 0), (1, 1 / self.radius), (1, -1 / self.radius)])

    def covering(self, scenario):
        return 1.75 * scenario.pursuer_speed, 0.75 * self.radius  # the b at which l_max is largest


if __name__ == "__main__":
    scenario = sidestep.load_scenario("paper", pursuer_model=Car(), capture_distance=0.15)
    value = solve_distance(scenario, reach=2.0, cells=60)
    print(f"The car can force {value.largest_capture_distance:.3f} m (+- {value.error:.3f})")
    for shield in ("game", grid_barrier(scenario, value)):
        seen = sidestep.evaluate(scenario, sidestep.goal_seeking, shield, "chauffeur", 100, key=0)
        print(f"{seen.captured} captured, {seen.collided} collided, {seen.reached} of 100 reached")
