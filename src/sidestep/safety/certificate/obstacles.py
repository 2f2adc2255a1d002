"""What can be said about obstacles beside the pursuer? Read off a clearance table."""

from __future__ import annotations

import math
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, replace

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from sidestep.safety.clearance import (
    Checked,
    ClearanceGame,
    ClearanceTable,
    Resolution,
    Solution,
    checked,
    solve,
    table_for,
)
from sidestep.safety.clearance.solve import STAGES
from sidestep.world.scenario import Scenario

HEIGHTS = (0.0, 0.01, 0.03, 0.06)
"""Distances h' (m) from the capture set at which directions are reported."""
BEARINGS = (0.0, 5.0, 30.0, 90.0)
"""Bearings (deg) of the evader in the pursuer's frame at which they are."""
_MOST = 1.0
_COARSE = Resolution(
    height=0.004, growth=1.4, share=0.02, share_growth=1.5, bearings=10, angles=64, ridge=0.05, headings=24,
    turns=3,
)  # fmt: skip
_DRIFT_STEP = 0.005
_SWEEPS = 400
"""Sweeps after which a coarse table that still grows counts as one that never ends."""


@dataclass(frozen=True)
class Direction:
    """The clearance (m) an obstacle needs from an evader that is `height` (m) outside the capture set at
    `bearing` (rad) in the pursuer's frame: in the `best` and in the `worst` direction, and which that is,
    `towards` (rad, from the pursuer's axis)."""

    height: float
    bearing: float
    best: float
    worst: float
    towards: float


@dataclass(frozen=True)
class ObstacleClearance:
    """What a clearance table says, in m and m/s.

    - `beyond`: an obstacle whose centre is farther away than that does not matter, wherever the evader is
    - `smallest_gap` between the centres of obstacles at which only one at a time can matter
    - `drift` that the table is for; `fastest_drift` at which there still is one, on a coarse grid, or None
      where it was not asked for
    - `directions` see `Direction`
    - `seconds` for which all that holds, None for ever
    - `checked`: how much of the table is proved, None where that was not tried
    - `start_height` h' of the asked start, `start_clearance` that an obstacle must have from it in the
      `start_worst` direction (rad); `obstacle_margin` of the asked obstacle; None where not asked
    """

    game: ClearanceGame
    beyond: float
    smallest_gap: float
    drift: float
    fastest_drift: float | None
    directions: tuple[Direction, ...]
    seconds: float | None = None
    checked: Checked | None = None
    start_height: float | None = None
    start_clearance: float | None = None
    start_worst: float | None = None
    obstacle: tuple[float, float] | None = None
    obstacle_margin: float | None = None


def obstacle_clearance(
    scenario: Scenario,
    *,
    start: tuple[float, float] | None = None,
    obstacle: tuple[float, float] | None = None,
    search_drift: bool = False,
    tell: Callable[[str], None] = lambda _: None,
) -> ObstacleClearance:
    """What can be kept from an obstacle beside one pursuer.

    **Arguments:** `start` and `obstacle`, places in the pursuer's frame (m, x ahead, y left) to check;
    `search_drift`: also search for the fastest drift, which takes minutes; `tell` gets, in words, what is
    computed next.

    **Raises** `ValueError` where there is no table, saying why.
    """

    def progress(solution: Solution) -> None:
        tell(
            f"clearance table, {STAGES[solution.stage]}, sweep {solution.sweeps}, largest "
            f"{float(np.max(solution.clearance)):.3f} m, last change {1e3 * solution.change:.2g} mm"
        )

    table = table_for(scenario, progress=progress)
    game = table.game
    drift = float(np.hypot(*np.asarray(scenario.obstacle_velocity, float)))
    found = ObstacleClearance(
        game=game,
        beyond=table.farthest,
        smallest_gap=table.smallest_gap,
        drift=drift,
        fastest_drift=fastest_drift(game, drift, tell) if search_drift and table.periods is None else None,
        directions=tuple(_direction(table, h, math.radians(b)) for b in BEARINGS for h in HEIGHTS),
        seconds=None if table.periods is None else table.periods * game.control_period,
        checked=checked(table),
    )
    if start is None:
        return found
    z = np.asarray(start, float)
    height = float(table.grid.height(np, z[0], z[1]))
    _, worst, towards = _over_directions(table, z)
    found = replace(found, start_height=height, start_clearance=worst, start_worst=towards)
    if obstacle is None:
        return found
    offset = z - np.asarray(obstacle, float)
    margin = float(table.margin(jnp.asarray(z), jnp.asarray(offset)))
    return replace(found, obstacle=obstacle, obstacle_margin=margin)


def fastest_drift(game: ClearanceGame, drift: float, tell: Callable[[str], None]) -> float:
    """The fastest drift (m/s) at which a coarse table stays below 1 m, to 2 mm/s, by bisection from
    `drift`."""
    low, high = drift, game.evader_speed
    while high - low > _DRIFT_STEP:
        middle = (low + high) / 2.0
        tell(f"the fastest drift: between {low:.3f} and {high:.3f} m/s")
        tried = replace(game, obstacle_speed=middle)
        if _lasts(tried):
            low = middle
        else:
            high = middle
    return low


class _Decided(Exception):
    """It is known whether clearance grows on and on."""


def _lasts(game: ClearanceGame) -> bool:
    """Whether the coarse solution, the first stage, ends."""
    ends = False

    def watch(solution: Solution) -> None:
        nonlocal ends
        ends = solution.stage > 0
        if ends or float(np.max(solution.clearance)) >= 0.95 * _MOST or solution.sweeps >= _SWEEPS:
            raise _Decided

    with suppress(_Decided):
        solve(game, _COARSE, most=_MOST, progress=watch)
    return ends


def _direction(table: ClearanceTable, height: float, bearing: float) -> Direction:
    game = table.game
    distance = (game.capture_distance + height) / math.cos(max(game.angle - bearing, 0.0))
    # Just off the axis: there the side is taken.
    bearing = max(bearing, 1e-3)
    z = distance * np.array([math.cos(bearing), math.sin(bearing)])
    best, worst, towards = _over_directions(table, z)
    return Direction(height, bearing, best, worst, towards)


def clearances(table: ClearanceTable, z: np.ndarray, count: int = 720) -> tuple[np.ndarray, np.ndarray]:
    """Directions (rad) in which an obstacle lies from the evader at z (m), in the pursuer's frame, and the
    clearance (m) that it needs there."""
    towards = np.linspace(-math.pi, math.pi, count, endpoint=False)
    # The table's direction is that from the obstacle to the evader.
    offsets = -np.stack([np.cos(towards), np.sin(towards)], -1)
    return towards, np.asarray(_needed(table, jnp.asarray(z), jnp.asarray(offsets)), float)


@eqx.filter_jit
def _needed(table: ClearanceTable, z: Float[Array, "2"], offsets: Float[Array, "n 2"]) -> Float[Array, "n"]:
    return jax.vmap(lambda offset: table(z, offset)[1])(offsets)


def _over_directions(table: ClearanceTable, z: np.ndarray) -> tuple[float, float, float]:
    towards, needed = clearances(table, z)
    worst = int(np.argmax(needed))
    return float(np.min(needed)), float(needed[worst]), float(towards[worst])
