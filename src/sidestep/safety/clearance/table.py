"""The clearance table: how far away must an obstacle be for the evader to stay free of it and the pursuer?"""

from __future__ import annotations

import functools
import hashlib
import json
import math
import time
from collections.abc import Callable
from contextlib import suppress
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, UInt16

from sidestep import _interrupts
from sidestep._arrays import AnyArray, Scalar
from sidestep._compiled import cache_folder
from sidestep.safety.clearance.game import SPARE, ClearanceGame
from sidestep.safety.clearance.grid import Angles, Grid, Spacing
from sidestep.safety.clearance.solve import ROUGH, STAGES, Resolution, Solution, solve
from sidestep.store.checkpoints import CheckpointError, read_named, write_arrays
from sidestep.store.files import read_json
from sidestep.world.capture_geometry import to_pursuer_axes, to_pursuer_frame
from sidestep.world.scenario import Scenario

_FORMAT = 3
STEP = 2e-5
"""Unit (m) in which tables are kept: clearances are rounded up to it."""
_FOLDER = Path(__file__).with_name("tables")
_SAVE_SECONDS = 20.0
SHORT = 4.0
"""Time (s) that a table is for where none can be for ever."""


class ClearanceTable(eqx.Module):
    """How far away an obstacle must be, R, for the evader to stay free of it and of the pursuer.

    With z the evader in the pursuer's frame, beta its angle to the pursuer's axis, and p from the obstacle to
    the evader in the same frame, the evader can stay free where

        h'(z) >= 0  and  |p| >= R(z, direction of p),     h'(z) = |z| cos((S' - beta)+) - l,

    for ever, or for `periods`. The table is the fixed point of the game in which the evader holds each
    velocity for a period, or so many steps towards it, solved on a grid: it is computed, not proved (see
    `docs/theory.md`). R is interpolated between the nodes, never across the surfaces at which the evader
    loses the choice of a side. R', `after` the evader's move and before the pursuer's, is what then keeps R
    at the end of the period, whatever the pursuer does and however an obstacle of the game's speed drifts in
    it.

    Where the game has a `wall`, p = q n: its normal times the evader's distance q > 0 to it.

    **Attributes:** `clearance`, `after` (nodes, angles) in units of `STEP`; `ridge` (nodes,) rad, from which
    the angles of a row count; `game`, `grid` and `directions` what it was solved for; `sweeps` of the fixed
    point, `change` the largest in the last of them, m; `periods` that the evader stays free, None for ever.
    """

    clearance: UInt16[Array, "n k"]
    after: UInt16[Array, "n k"]
    ridge: Float[Array, "n"]
    game: ClearanceGame = eqx.field(static=True)
    grid: Grid = eqx.field(static=True)
    directions: Angles = eqx.field(static=True)
    sweeps: int = eqx.field(static=True)
    change: float = eqx.field(static=True)
    periods: int | None = eqx.field(static=True, default=None)

    @staticmethod
    def of(game: ClearanceGame, solution: Solution, periods: int | None = None) -> ClearanceTable:
        """The table of a solution, and of the `periods` that it was solved for.

        **Raises** `ValueError` for more clearance than a table holds, 1.3 m.
        """
        return ClearanceTable(
            _counted(solution.clearance),
            _counted(solution.after),
            jnp.asarray(solution.ridge, jnp.float32),
            game,
            solution.grid,
            solution.directions,
            solution.sweeps,
            solution.change,
            periods,
        )

    def __call__(self, z: Float[AnyArray, "2"], offset: Float[AnyArray, "2"]) -> tuple[Scalar, Scalar]:
        """h' and R, m, for z (m) and an obstacle in the direction of -`offset`, p = `offset` (m).

        Piecewise smooth: derivatives are those of the cell that the state lies in. In the capture set R is
        that at its edge.
        """
        return self._look(self.clearance, z[0], z[1], offset)

    def _look(
        self, rows: UInt16[Array, "n k"], ahead: Any, left: Any, offset: Float[AnyArray, "2"]
    ) -> tuple[Scalar, Scalar]:
        # Without the barriers XLA computes places again for every corner.
        place = jax.lax.optimization_barrier(self.grid.place(jnp, ahead, left))
        # Corner by corner: twice as fast as one array of four.
        middle = sum(weight * _taken(self.ridge, node) for node, weight in place.each)
        turned = place.sign * jnp.arctan2(offset[1], offset[0]) + math.pi * place.turns - middle
        angle, along = jax.lax.optimization_barrier(self.directions.place(jnp, turned))
        beyond = jnp.where(angle + 1 < self.directions.count, angle + 1, 0)
        clearance = jnp.zeros_like(turned)
        for node, weight in place.each:
            low, high = (_taken(rows, (node, column)).astype(turned.dtype) for column in (angle, beyond))
            clearance = clearance + weight * (low + along * (high - low))
        return place.height, STEP * clearance

    def margin(self, z: Float[AnyArray, "2"], offset: Float[AnyArray, "2"]) -> Scalar:
        """min(h', |p| - R), m: at least 0 in the set that the evader keeps."""
        height, clearance = self(z, offset)
        return jnp.minimum(height, jnp.hypot(offset[0], offset[1]) - clearance)

    def margin_after(
        self,
        z: Float[AnyArray, "2"],
        offset: Float[AnyArray, "2"],
        move: Float[AnyArray, "2"],
        poses: Float[AnyArray, "n 3"],
        drift: Float[AnyArray, ""] | float,
    ) -> Scalar:
        """The least `margin` (m) after a period, in the pursuer's frame at its beginning.

        **Arguments:** the evader moves by `move` (m), the pursuer to any of `poses` (m, m, rad), the obstacle
        by `drift` (m) in any of 16 directions. Below 0 also where the evader is then beyond a wall.
        """
        place = z + move
        angles = np.arange(16) * (np.pi / 8.0)
        around = jnp.asarray(np.stack([np.cos(angles), np.sin(angles)], -1), place.dtype)

        def after(pose: Float[Array, "3"], way: Float[Array, "2"]) -> Scalar:
            moved, distance = self._moved(offset, move - drift * way)
            seen = to_pursuer_axes(moved.astype(pose.dtype), pose[2])
            height, clearance = self(to_pursuer_frame(place, pose), seen)
            return jnp.minimum(height, distance - clearance)

        every = jax.vmap(jax.vmap(after, in_axes=(None, 0)), in_axes=(0, None))
        return jnp.min(every(jnp.asarray(poses), around))

    def spare_after(
        self,
        z: Float[AnyArray, "2"],
        offset: Float[AnyArray, "2"],
        move: Float[AnyArray, "2"],
        drift: Float[AnyArray, ""] | float,
    ) -> Scalar:
        """|p| - R (m) after a period, at least, whatever the pursuer does in it: by R', without h', at one
        look into the table. `drift` (m) of the obstacle in the period, at most that of the game."""
        ahead, (moved, distance) = self.grid.nearer(jnp, z[0] + move[0]), self._moved(offset, move)
        _, clearance = self._look(self.after, ahead, z[1] + move[1], moved)
        slower = self.game.obstacle_speed * self.game.control_period - drift
        return distance - clearance + self.game.spare + slower

    def _moved(self, offset: Float[AnyArray, "2"], move: Float[AnyArray, "2"]) -> tuple[Any, Scalar]:
        """In which direction from the obstacle or wall the evader is after a move, and how far, m."""
        if not self.game.wall:
            return offset + move, jnp.hypot(offset[0] + move[0], offset[1] + move[1])
        distance = jnp.hypot(offset[0], offset[1])
        return offset, distance + (offset[0] * move[0] + offset[1] * move[1]) / distance

    @property
    def farthest(self) -> float:
        """The largest R, m: obstacles beyond do not matter from any z with h' >= 0."""
        return STEP * float(np.max(np.asarray(self.clearance)))

    @property
    def smallest_gap(self) -> float:
        """How far apart, m, the centres of obstacles must stay for only one at a time to matter."""
        closing = self.game.evader_speed + self.game.obstacle_speed
        return 2.0 * (self.farthest + closing * self.game.control_period)

    def save(self, path: str | Path) -> None:
        """Write the table to a file. **Raises** `OutputError` where that cannot be written."""
        _write(path, self, game=self.game.as_dict, periods=self.periods)

    @staticmethod
    def load(path: str | Path) -> ClearanceTable:
        """The table of a file. **Raises** `ValueError` where there is none that this version reads."""
        try:
            solution, about = _read(path)
            return ClearanceTable.of(ClearanceGame(**about["game"]), solution, about.get("periods"))
        except (OSError, ValueError, KeyError, TypeError, CheckpointError) as error:
            raise ValueError(f"{path} is no clearance table of this version of sidestep ({error})") from None


def clearance_table(
    game: ClearanceGame,
    resolution: Resolution | None = None,
    *,
    periods: int | None = None,
    progress: Callable[[Solution], None] | None = None,
) -> ClearanceTable:
    """The table of a game: the one kept from an earlier time, or solved for, which takes minutes.

    It is kept in the user's cache folder (see `cache_folder`) under its parameters. So is a solution on the
    way, every 20 s and when Ctrl-C ends it: the next call goes on from there.

    **Arguments** and **raises** as `solve`.
    """
    resolution = Resolution() if resolution is None else resolution
    asked = {"format": _FORMAT, "game": game.as_dict, "resolution": asdict(resolution), "periods": periods}
    key = hashlib.sha256(json.dumps(asked, sort_keys=True).encode()).hexdigest()[:20]
    folder = cache_folder()
    kept = None if folder is None else folder / "clearance" / f"{key}.npz"
    if kept is None:
        return ClearanceTable.of(game, solve(game, resolution, periods=periods, progress=progress), periods)
    if kept.exists():
        with suppress(ValueError):
            return ClearanceTable.load(kept)
    on_the_way = kept.with_name(f"{key}.part.npz")
    saved, latest, begun = time.monotonic(), None, None

    def after(solution: Solution) -> None:
        nonlocal saved, latest
        latest = solution
        if time.monotonic() - saved > _SAVE_SECONDS:
            _write(on_the_way, solution, stage=solution.stage)
            saved = time.monotonic()
        if progress is not None:
            progress(solution)
        _interrupts.check()

    try:
        with _interrupts.held():
            with suppress(OSError, ValueError, KeyError, TypeError, CheckpointError):
                begun, _ = _read(on_the_way)
            solution = solve(game, resolution, periods=periods, begun=begun, progress=after)
    except KeyboardInterrupt:
        if latest is not None:
            _write(on_the_way, latest, stage=latest.stage)
        raise
    table = ClearanceTable.of(game, solution, periods)
    table.save(kept)
    on_the_way.unlink(missing_ok=True)
    return table


def table_for(scenario: Scenario, *, progress: Callable[[Solution], None] | None = None) -> ClearanceTable:
    """The table that comes with sidestep for a scenario, or else the one of `clearance_table`: for ever, or
    for `SHORT` s where the evader can keep only nearly the capture distance for ever.

    **Raises** `ValueError` where there is none, saying why.
    """
    shipped = shipped_table(scenario)
    if shipped is not None:
        return shipped
    game = ClearanceGame.of(scenario, spare=SPARE, nearest=True)
    if not game.shortfall:
        return clearance_table(game, progress=progress)
    return clearance_table(game, ROUGH, periods=max(round(SHORT / game.control_period), 1), progress=progress)


def shipped_table(scenario: Scenario) -> ClearanceTable | None:
    """The table that comes with sidestep and serves a scenario (see `ClearanceGame.refuses`), if any: of
    several one for ever, and that with the least clearance."""
    return next((table for table in shipped_tables() if not table.game.refuses(scenario)), None)


def shipped_tables() -> list[ClearanceTable]:
    """The tables that come with sidestep, the one to be preferred first: for ever, with little clearance."""
    return sorted(_shipped().values(), key=lambda table: (table.periods is not None, table.farthest))


@dataclass(frozen=True)
class Checked:
    """What the proof of a table, box by box, came to: of small `boxes` drawn on the boundary of its set,
    where an obstacle of up to `drift` m/s matters, so many are `verified`, at least the share `at_least` of
    all such boxes at 95 %; in those `refuted` a motion was found that leaves the set."""

    boxes: int
    verified: int
    refuted: int
    at_least: float
    drift: float


def checked(table: ClearanceTable) -> Checked | None:
    """The result of `benchmarks/clearance_check.py` that comes with a shipped table; None without one."""
    path = next((path for path, shipped in _shipped().items() if shipped is table), None)
    beside = None if path is None else path.with_suffix(".check.json")
    if path is None or beside is None or not beside.exists():
        return None
    found = read_json(beside)
    if found["asked"]["table"] != hashlib.sha256(path.read_bytes()).hexdigest():
        return None
    counts = (found[name] for name in ("boxes", "verified", "refuted", "share at least"))
    return Checked(*counts, drift=found["asked"]["drift"])


@functools.cache
def _shipped() -> dict[Path, ClearanceTable]:
    return {path: ClearanceTable.load(path) for path in sorted(_FOLDER.glob("*.npz"))}


def _taken(values: Array, index: Any) -> Array:
    """values[index], for an index that is known to be in bounds."""
    return values.at[index].get(mode="promise_in_bounds", wrap_negative_indices=False)


def _counted(clearance: np.ndarray) -> UInt16[Array, "n k"]:
    """Clearances (m) in units of `STEP`, rounded up but for rounding errors."""
    if clearance.dtype == np.uint16:
        return jnp.asarray(clearance)
    counts = np.ceil(clearance.astype(float) / STEP - 1e-3)
    most = np.iinfo(np.uint16).max
    if np.max(counts) > most:
        raise ValueError(
            f"a clearance of {np.max(clearance):.3g} m: a table holds {most * STEP:.3g} m at most; take a "
            "smaller `most`, or fewer periods"
        )
    return jnp.asarray(counts.astype(np.uint16))


def _write(path: str | Path, solution: Solution | ClearanceTable, **about: Any) -> None:
    write_arrays(
        Path(path),
        {"clearance": solution.clearance, "after": solution.after, "ridge": solution.ridge},
        compressed=True,
        format=_FORMAT,
        grid=_plain(solution.grid),
        directions=_plain(solution.directions),
        sweeps=solution.sweeps,
        change=solution.change,
        **about,
    )


def _read(path: str | Path) -> tuple[Solution, dict[str, Any]]:
    """What `_write` wrote; a finished table counts as in the last stage."""
    arrays, about = read_named(Path(path))
    if about["format"] != _FORMAT:
        raise ValueError(f"format {about['format']}, not {_FORMAT}")
    clearance, after, ridge = (arrays[f"['{name}']"] for name in ("clearance", "after", "ridge"))
    grid, directions = _grid(about["grid"]), Angles(*about["directions"])
    stage = about.get("stage", len(STAGES) - 1)
    return Solution(grid, directions, ridge, clearance, after, stage, about["sweeps"], about["change"]), about


def _plain(part: Any) -> Any:
    """A tuple of numbers and tuples, as lists."""
    return [_plain(entry) for entry in part] if isinstance(part, tuple) else part


def _grid(values: list[Any]) -> Grid:
    distance, angle, heights, shares, bearings, gap, reach = values
    return Grid(distance, angle, Spacing(*heights), Spacing(*shares), bearings, gap, reach)
