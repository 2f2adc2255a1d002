"""Map a batch of proposed actions to the actions that the robot executes."""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, PRNGKeyArray

from sidestep._arrays import real
from sidestep.learning.td3 import Bound
from sidestep.learning.variation import FIXED, Variation
from sidestep.world import Scenario, World, to_action, to_velocity
from sidestep.world.robots import limit_speed


def on_disc(actions: Float[Array, "batch action"], key: PRNGKeyArray) -> Float[Array, "batch action"]:
    """Clip the norm of actions to 1, as `to_velocity` does with the policy's action."""
    return jax.vmap(limit_speed, in_axes=(0, None))(actions, real(1.0))


def through_shield(
    scenario: Scenario,
    shield: Any,
    worlds: World,
    variation: Variation = FIXED,
    drawn: Float[Array, "batch varied"] | None = None,
) -> Bound:
    """Filter each action with the shield, in its world of `worlds` (leading batch axis), where the robots are
    those `drawn`.

    The derivative with respect to the action is the identity where the shield accepts the action, the
    projection along a row where the action is projected on that row, and 0 in a corner of two rows, or of a
    row and the speed limit; never NaN.

    This filters the first control period of a decision, with the memory of an episode that begins there. The
    look-ahead of the shield `joint` is replaced by `shield.rows_only`: it would cost far more than the
    training, and has no derivatives.
    """

    def filtered(
        world: World, action: Float[Array, "2"], values: Float[Array, "varied"]
    ) -> Float[Array, "2"]:
        mine = variation.scenario(scenario, values)
        filtered_by = variation.shield(getattr(shield, "rows_only", shield), mine)
        result, _ = filtered_by(world, to_velocity(mine, world, action), filtered_by.init(world))
        return to_action(mine, world, result.action)

    def bound(actions: Float[Array, "batch action"], key: PRNGKeyArray) -> Float[Array, "batch action"]:
        values = jnp.zeros((len(actions), 0)) if drawn is None else drawn
        return jax.vmap(filtered)(worlds, actions, values)

    return bound
