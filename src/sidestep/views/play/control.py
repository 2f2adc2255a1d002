"""Control of the pursuers by a strategy, or of the first one by the visitor."""

from __future__ import annotations

from typing import final

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, PRNGKeyArray

from sidestep._arrays import length
from sidestep.pursuit import PURSUERS, make_pursuer, pursue
from sidestep.pursuit.steering import bearing_of, nearer_end, turn_and_drive
from sidestep.world.capture_geometry import to_pursuer_frame
from sidestep.world.scenario import Scenario
from sidestep.world.state import World

STRATEGIES = tuple(PURSUERS)
"""Names of the strategies; a strategy's number is its index."""
BY_STRATEGY, BY_WHEELS, BY_POINT = 0.0, 1.0, 2.0
"""How the first pursuer is driven: by its strategy; by commanded wheel speeds, as shares of the largest; or
to a commanded point, m."""


@final
class PursuerControl(eqx.Module):
    """A strategy for all pursuers, which the visitor's command may override for the first one.

    `strategy ()` is an index of `STRATEGIES`; `mode ()` and `command (2,)` determine how the first one is
    driven. All are traced: another pursuer never recompiles. `key` is for strategies that draw random
    numbers.
    """

    strategy: Array
    mode: Float[Array, ""]
    command: Float[Array, "2"]
    key: PRNGKeyArray

    def steer_all(self, scenario: Scenario, world: World) -> Float[Array, "m 2"]:
        """Wheel rim speeds (left, right; m/s) of every pursuer."""

        def branch(name: str):
            return lambda: pursue(scenario, make_pursuer(name), world, self.key)

        wheels = jax.lax.switch(self.strategy, [branch(name) for name in STRATEGIES])
        limit = scenario.pursuer_speed
        driven = jnp.where(
            self.mode == BY_WHEELS, limit * jnp.clip(self.command, -1.0, 1.0), self._to_point(scenario, world)
        )
        first = jnp.where(self.mode == BY_STRATEGY, wheels[0], driven)
        return jnp.concatenate([first[None], wheels[1:]])

    def __call__(self, scenario: Scenario, world: World, key: PRNGKeyArray) -> Float[Array, "2"]:
        """Wheel speeds of the first pursuer alone."""
        return self.steer_all(scenario, world)[0]

    def _to_point(self, scenario: Scenario, world: World) -> Float[Array, "2"]:
        """Wheel speeds (m/s) that turn the nearer end to the point, drive to it, and stop there."""
        z = to_pursuer_frame(self.command, world.pursuer)
        end, turn = nearer_end(bearing_of(z))
        wheels = turn_and_drive(
            turn, end, scenario.pursuer_speed, scenario.pursuer_half_axle, scenario.control_period
        )
        reach = scenario.pursuer_speed * scenario.control_period
        return wheels * jnp.clip(length(z[0], z[1]) / reach, 0.0, 1.0)
