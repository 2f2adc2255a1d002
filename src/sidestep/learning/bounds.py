"""From the actions that a policy asks for to those that the robot drives, for a whole batch at once."""

from __future__ import annotations

from typing import Any

import jax
from jaxtyping import Array, Float, PRNGKeyArray

from sidestep._arrays import real
from sidestep.learning.td3 import Bound
from sidestep.world import Scenario, World, to_action, to_velocity
from sidestep.world.robots import limit_speed


def on_disc(actions: Float[Array, "batch action"], key: PRNGKeyArray) -> Float[Array, "batch action"]:
    """Actions as the robot executes them: norm cut to one (`to_velocity` does the same to the policy's)."""
    return jax.vmap(limit_speed, in_axes=(0, None))(actions, real(1.0))


def through_shield(scenario: Scenario, shield: Any, worlds: World) -> Bound:
    """Actions as the shield lets them through, each in its own world of `worlds` (a leading batch axis).

    The derivative of the answer with respect to the action comes with it: the identity where the shield
    lets the action pass, along a row where it is projected on that row, and 0 where it is held in a corner
    of two rows, or of a row and the speed limit; never NaN.

    It is the first control period of a decision that is filtered, with the memory of an episode that begins
    there. Where shield `joint` looks ahead, `shield.rows_only` stands in for it: an imagined chase for each
    world of each batch would cost far more than the training, and carries no derivatives.
    """
    filtered_by = getattr(shield, "rows_only", shield)

    def filtered(world: World, action: Float[Array, "2"]) -> Float[Array, "2"]:
        result, _ = filtered_by(world, to_velocity(scenario, world, action), filtered_by.init(world))
        return to_action(scenario, world, result.action)

    def bound(actions: Float[Array, "batch action"], key: PRNGKeyArray) -> Float[Array, "batch action"]:
        return jax.vmap(filtered)(worlds, actions)

    return bound
