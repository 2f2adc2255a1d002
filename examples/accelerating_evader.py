"""A custom evader with mass, which cannot change its velocity at once."""

import jax.numpy as jnp

import sidestep
from sidestep.world import EvaderModel, EvaderState


class Accelerating(EvaderModel):
    """A double integrator whose controller approaches the commanded velocity with time constant tau. Tau is
    chosen so that the acceleration limit is never exceeded: |u - v|/tau <= 2 v_e/tau."""

    most: float = 4.0  # m/s^2

    def lag(self, scenario):
        return 2.0 * scenario.evader_speed / self.most

    def after(self, scenario, robot, command, time):
        tau = self.lag(scenario)
        left, excess = jnp.exp(-time / tau), robot.velocity - command
        position = robot.position + command * time + excess * tau * (1.0 - left)
        return EvaderState(position, command + excess * left, robot.state)

    # q = p + tau v moves exactly as commanded: q' = v + (u - v) = u.
    def control_point(self, scenario, robot):
        return robot.position + self.lag(scenario) * robot.velocity

    def offset(self, scenario):
        return self.lag(scenario) * scenario.evader_speed


if __name__ == "__main__":
    scenario = sidestep.load_scenario(
        "paper", evader_model=Accelerating(), capture_distance=0.18, episode_steps=1200
    )
    for shield in ("none", "game"):
        seen = sidestep.evaluate(scenario, sidestep.goal_seeking, shield, "nash", episodes=100, key=0)
        print(f"{shield}: {seen.captured} captured, {seen.collided} collided, {seen.reached} of 100 reached")
