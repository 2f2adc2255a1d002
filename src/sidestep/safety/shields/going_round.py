"""How does an evader get past an obstacle that it is stuck behind?

The filter lets through what the rows n.u >= c leave of the nominal action. Exactly behind an obstacle, and in
the corner between two, nothing is left: every point there is the closest to the target that the rows allow.
Such undesired equilibria are a property of filters of this kind (Reis, Aguiar, Tabuada, "Control barrier
function-based quadratic programs introduce undesirable asymptotically stable equilibria", IEEE Control
Systems Letters 5(2), 2021). The rows must stay, because they say which actions are safe. So the nominal
action is changed: it is turned by a quarter to one side and filtered as always, until it would get on to that
side by itself. An evader that is not stuck is not affected.

The memory is `turn`: +1 to the left of the nominal action, -1 to the right, 0 not at all.
"""

from __future__ import annotations

from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from sidestep._arrays import AnyArray, Lanes, fold, length, stack
from sidestep.safety.shields.answer import obstacle_rows
from sidestep.world.scenario import Scenario
from sidestep.world.state import World

STUCK = 0.05
"""Below this speed relative to the obstacle, as a share of v_e, the evader is stuck behind it."""
PRESSING = 0.5
"""Speed of the nominal action relative to the obstacle, as a share of v_e, from which on it presses. A slower
one may mean to wait."""
LEADS_ON = 0.3
"""Speed along the obstacle, as a share of v_e, at which the nominal action gets on by itself."""

NEAR_PURSUER = 0.5
"""Pursuit barrier (m) below which the nominal action is not turned."""


class _Obstacles(NamedTuple):
    """For each obstacle: whether its row forbids the nominal action, whether that action presses, and how
    fast (m/s) it slides along the obstacle to the left, counterclockwise."""

    hinders: Bool[Array, "k *lanes"]
    pressing: Bool[Array, "k *lanes"]
    slides: Float[Array, "k *lanes"]


def _obstacles(scenario: Scenario, world: World, nominal: Float[AnyArray, "2 *lanes"]) -> _Obstacles:
    rows, limit = obstacle_rows(scenario, world), scenario.evader_speed
    # Beyond the speed limit only the direction counts. Two steps, so that no square overflows.
    size = jnp.maximum(jnp.maximum(jnp.abs(nominal[0]), jnp.abs(nominal[1])) / limit, 1.0)
    x, y = nominal[0] / size, nominal[1] / size
    over = jnp.maximum(length(x, y) / limit, 1.0)
    x, y = x / over, y / over
    along_x, along_y = x - world.obstacles[:, 2], y - world.obstacles[:, 3]
    return _Obstacles(
        hinders=rows.normals[:, 0] * x + rows.normals[:, 1] * y < rows.offsets,
        pressing=length(along_x, along_y) > PRESSING * limit,
        slides=rows.normals[:, 0] * along_y - rows.normals[:, 1] * along_x,
    )


def still_turned(
    scenario: Scenario, world: World, nominal: Float[AnyArray, "2 *lanes"], turn: Float[AnyArray, "*lanes"]
) -> Lanes:
    """The turn of the last period, or 0 where the nominal action gets on by itself: no obstacle's row forbids
    it, or it slides to the chosen side along all obstacles whose rows do."""
    found = _obstacles(scenario, world, nominal)
    # Left of the nominal action is right along the obstacle in front of it.
    free = ~found.hinders | (-turn * found.slides >= LEADS_ON * scenario.evader_speed)
    return jnp.where(fold(jnp.logical_and, free, True), jnp.zeros_like(turn), turn)


def turned(nominal: Float[AnyArray, "2 *lanes"], turn: Float[AnyArray, "*lanes"]) -> Float[Array, "2 *lanes"]:
    """The nominal action turned by a quarter to that side; unchanged where the turn is 0."""
    x, y = nominal[0], nominal[1]
    aside = turn != 0.0
    return stack(jnp.where(aside, -turn * y, x), jnp.where(aside, turn * x, y))


def next_turn(
    scenario: Scenario,
    world: World,
    nominal: Float[AnyArray, "2 *lanes"],
    action: Float[AnyArray, "2 *lanes"],
    turn: Float[AnyArray, "*lanes"],
    barriers: Float[AnyArray, "m *lanes"],
) -> Lanes:
    """The turn for the next period, after `action` (m/s) was chosen for the policy's `nominal` action.

    The evader is stuck if an obstacle's row forbids a nominal action that presses, and the action hardly
    moves it relative to that obstacle. It turns to the side to which the nominal action slides, or left where
    it slides to neither. An evader that is stuck on its way round turns to the other side. There is no turn
    where a pursuit barrier in `barriers` (m, towards the pursuers) is below `NEAR_PURSUER`, or -inf because
    the world was not finite.
    """
    found, limit = _obstacles(scenario, world, nominal), scenario.evader_speed
    slow = length(action[0] - world.obstacles[:, 2], action[1] - world.obstacles[:, 3]) < STUCK * limit
    stuck = fold(jnp.logical_or, found.hinders & found.pressing & slow, False)
    slides = fold(jnp.add, jnp.where(found.hinders, found.slides, 0.0), 0.0)
    chosen = jnp.where(turn == 0.0, jnp.where(slides > 0.0, -1.0, 1.0), -turn)
    far = fold(jnp.minimum, jnp.asarray(barriers), jnp.inf) >= NEAR_PURSUER
    return jnp.where(far, jnp.where(stuck, chosen, turn), 0.0).astype(turn.dtype)
