"""A custom evader: a unicycle, which cannot move sideways."""

import jax
import jax.numpy as jnp

import sidestep
from sidestep.world import EvaderModel, EvaderState


class Unicycle(EvaderModel):
    """The point d ahead of the axle moves with the commanded velocity u: v = u.e, omega = u.e'/d, e along
    and e' across the heading. The angle phi from u to the heading then obeys phi' = -(|u|/d) sin phi."""

    ahead: float = 0.02  # d, m

    def start(self, scenario, key):
        return jax.random.uniform(key, (1,), minval=-jnp.pi, maxval=jnp.pi)

    def after(self, scenario, robot, command, time):
        speed = jnp.hypot(*command)
        towards = jnp.arctan2(command[1], command[0])
        phi = (robot.state[0] - towards + jnp.pi) % (2.0 * jnp.pi) - jnp.pi
        phi = 2.0 * jnp.arctan(jnp.tan(phi / 2.0) * jnp.exp(-speed * time / self.ahead))
        heading = jnp.where(speed > 0.0, towards + phi, robot.state[0])
        axis = jnp.stack([jnp.cos(heading), jnp.sin(heading)])
        place = self.control_point(scenario, robot) + command * time - self.ahead * axis
        return EvaderState(place, axis * jnp.dot(axis, command), heading[None])

    def control_point(self, scenario, robot):
        return robot.position + self.ahead * jnp.concatenate([jnp.cos(robot.state), jnp.sin(robot.state)])

    def offset(self, scenario):
        return self.ahead


if __name__ == "__main__":
    scenario = sidestep.load_scenario("paper", evader_model=Unicycle(), capture_distance=0.17)
    seen = sidestep.evaluate(scenario, sidestep.goal_seeking, "game", "nash", episodes=100, key=0)
    print(f"{seen.captured} captured, {seen.collided} collided, {seen.reached} of 100 reached")
