"""How does an evader get past an obstacle that it is stuck behind?

The filter lets through what of the nominal action n.u >= c leaves. Exactly behind an obstacle, and in the
corner between two, that is nothing: every point there is the closest to the target that the rows allow. Such
undesired equilibria are a property of filters of this kind (Reis, Aguiar, Tabuada, "Control barrier
function-based quadratic programs introduce undesirable asymptotically stable equilibria", IEEE Control
Systems Letters 5(2), 2021). Rows say which actions are safe, so what may be changed is the nominal action:
here it is turned by a quarter towards one side, and filtered as ever, until it would lead on to that side by
itself. Nothing is changed where nothing is stuck.

`turn` is what is remembered: +1 to the left of the nominal action, -1 to the right, 0 not at all.
"""

from __future__ import annotations

from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from sidestep._arrays import AnyArray, Lanes, fold, length, stack
from sidestep.safety.barriers.barrier import ObstacleBarrier
from sidestep.world.scenario import Scenario
from sidestep.world.state import World

STUCK = 0.05
"""Speed relative to the obstacle, as a share of v_e, below which the evader is stuck behind it."""
PRESSING = 0.5
"""Share of v_e by which the nominal action must move relative to it: slower ones may want to wait."""
LEADS_ON = 0.3
"""Share of v_e at which the nominal action itself slides along the obstacle, so that it is turned no more."""

NEAR_PURSUER = 0.5
"""Pursuit barrier (m) below which the nominal action is not turned."""


class _Obstacles(NamedTuple):
    """Of each obstacle: whether its row keeps the nominal action out, whether that presses on, how fast
    (m/s) it slides along the obstacle to the left, counterclockwise."""

    hinders: Bool[Array, "k *lanes"]
    pressing: Bool[Array, "k *lanes"]
    slides: Float[Array, "k *lanes"]


def _obstacles(scenario: Scenario, world: World, nominal: Float[AnyArray, "2 *lanes"]) -> _Obstacles:
    obstacle, limit = ObstacleBarrier(), scenario.evader_speed
    rows = obstacle.rows(scenario, world, obstacle.remember(scenario, world))
    # What is beyond the speed limit only gives the direction; two steps, so that no square overflows.
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
    """The turn of the period before, or 0 where the nominal action gets on by itself: no obstacle's row
    keeps it out, or it slides along all that do to the side that was chosen."""
    found = _obstacles(scenario, world, nominal)
    # To the left of the nominal action is to the right along what it presses against.
    free = ~found.hinders | (-turn * found.slides >= LEADS_ON * scenario.evader_speed)
    return jnp.where(fold(jnp.logical_and, free, True), jnp.zeros_like(turn), turn)


def turned(nominal: Float[AnyArray, "2 *lanes"], turn: Float[AnyArray, "*lanes"]) -> Float[Array, "2 *lanes"]:
    """The nominal action turned by a quarter to that side; the very same where the turn is 0."""
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
    """What to remember once `action` (m/s) has been chosen for the `nominal` one as the policy gave it.

    Stuck means: an obstacle's row keeps out a nominal action that presses on, and the action hardly moves
    relative to that obstacle. The side is the one that the nominal action slides to, the left where it slides
    to neither. Where the evader is stuck on its way round too, it turns to the other side. `barriers` (m) are
    those towards the pursuers, -inf where the world was not finite.
    """
    found, limit = _obstacles(scenario, world, nominal), scenario.evader_speed
    slow = length(action[0] - world.obstacles[:, 2], action[1] - world.obstacles[:, 3]) < STUCK * limit
    stuck = fold(jnp.logical_or, found.hinders & found.pressing & slow, False)
    slides = fold(jnp.add, jnp.where(found.hinders, found.slides, 0.0), 0.0)
    chosen = jnp.where(turn == 0.0, jnp.where(slides > 0.0, -1.0, 1.0), -turn)
    far = fold(jnp.minimum, jnp.asarray(barriers), jnp.inf) >= NEAR_PURSUER
    return jnp.where(far, jnp.where(stuck, chosen, turn), 0.0).astype(turn.dtype)
