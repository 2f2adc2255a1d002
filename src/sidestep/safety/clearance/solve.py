"""Solves for the clearance table: the least fixed point of the sampled game, from the collision distance up.

Where everything is kept: `sweep` has the equation, `grid` the nodes.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from sidestep._bounds import bounded, check
from sidestep._packages import needed
from sidestep.safety.certificate.flow_map import seen_from
from sidestep.safety.clearance.game import ClearanceGame
from sidestep.safety.clearance.grid import Angles, Grid, Place, Spacing

_BLOCK = 64
"""Nodes whose transitions are computed at once."""
_EVEN = 1e3
"""Scale (rad) of angles that are evenly spaced."""


@dataclass(frozen=True)
class Resolution:
    """How fine a table is.

    `height` (m) between the first two nodes in a and b, growing by `growth` up to `farthest` (m); `share` of
    the straight part between its first two nodes, growing by `share_growth`; `bearings` cells on the arc;
    `angles` directions phi, `ridge` (rad) apart at the ridge; `headings` that the evader chooses from;
    `turns` and `drives` of the pursuer's motions, see `ClearanceGame.motions`.
    """

    height: float = bounded(0.001, above=0.0, most=1.0, unit="m")
    growth: float = bounded(1.15, above=1.0, most=10.0)
    farthest: float = bounded(0.4, above=0.0, most=1e3, unit="m")
    share: float = bounded(0.004, above=0.0, most=0.5)
    share_growth: float = bounded(1.25, above=1.0, most=10.0)
    bearings: int = bounded(20, least=1, most=1000)
    angles: int = bounded(144, least=8, most=4096)
    ridge: float = bounded(math.radians(0.8), above=0.0, most=1.0, unit="rad")
    headings: int = bounded(48, least=8, most=4096)
    turns: int = bounded(6, least=1, most=1000)
    drives: int = bounded(2, least=2, most=100)

    def grid(self, game: ClearanceGame) -> Grid:
        """The nodes for a game."""
        return Grid(
            game.capture_distance,
            game.angle,
            Spacing.up_to(self.farthest, self.height, self.growth),
            Spacing.up_to(1.0, self.share, self.share_growth),
            self.bearings,
            # More than the evader gains on its other side in a period against a pursuer that drives at it.
            1.2
            * max(game.evader_speed - game.pursuer_speed * math.cos(game.angle), 0.0)
            * game.control_period
            + 1e-5,
        )

    def directions(self, *, even: bool = False) -> Angles:
        """The directions phi."""
        if even:
            return Angles(_EVEN, self.angles)
        low, high = 1e-3, _EVEN
        for _ in range(80):
            middle = math.sqrt(low * high)
            spacing = middle * math.sinh(Angles(middle, self.angles).rate)
            low, high = (middle, high) if spacing < self.ridge else (low, middle)
        return Angles(low, self.angles)


_ROUGH = Resolution(height=0.002, growth=1.3, share=0.01, share_growth=1.4, bearings=12, angles=96)
STAGES = ("finding the ridge", "aligning", "solving")
"""What a solution goes through: coarsely, with rows aligned by the coarse ridge, and by the fine one."""


class Solution(NamedTuple):
    """A table, solved or on the way.

    `clearance` (nodes, angles) m; `ridge` (nodes,) rad, from which the angles of a row count; `stage` in
    `STAGES`, the `sweeps` of it, and the largest `change` in the last of them, m.
    """

    grid: Grid
    directions: Angles
    ridge: Float[np.ndarray, "n"]
    clearance: Float[np.ndarray, "n k"]
    stage: int
    sweeps: int
    change: float


@dataclass(frozen=True)
class _Transitions:
    """What `sweep` reads: pairs of node and control, and where each motion leads from there."""

    nodes: Int[np.ndarray, "n"]
    first: Int[np.ndarray, "n1"]
    control: Int[np.ndarray, "p"]
    place: Int[np.ndarray, "p m"]
    share: Float[np.ndarray, "p m 2"]
    turned: Float[np.ndarray, "p m 2"]
    reached: tuple[Int[np.ndarray, "r"], Int[np.ndarray, "n1"]]
    """The nodes that each depends on, one after the other, and where those of each begin."""


def _transitions(
    game: ClearanceGame, grid: Grid, resolution: Resolution, ridge: Float[np.ndarray, "n"]
) -> _Transitions:
    moves = game.velocities(resolution.headings) * game.control_period
    motions = game.motions(resolution.turns, resolution.drives)
    count = grid.heights.count
    left, right = np.divmod(np.arange(grid.first_committed), count)
    # By the mirror the others are never read, but for the first beyond the axis.
    nodes = np.concatenate([np.flatnonzero(left >= right - 1), np.arange(grid.first_committed, grid.size)])
    points = grid.points
    parts: list[tuple[np.ndarray, ...]] = []
    counts, reached = [], []
    for begin in range(0, len(nodes), _BLOCK):
        z = points[nodes[begin : begin + _BLOCK]]
        after = seen_from(z[:, None, None] + moves[None, :, None], motions[None, None])
        place = grid.place(np, after[..., 0], after[..., 1])
        allowed = np.min(place.height, -1) >= -1e-9
        place = Place(*(np.broadcast_to(part, place.height.shape)[allowed] for part in place))
        corners, weights = place.corners(np)
        offset = math.pi * place.turns - place.sign * motions[:, 2] - np.sum(weights * ridge[corners], -1)
        parts.append(
            (
                np.nonzero(allowed)[1].astype(np.int32),
                place.node.astype(np.int32),
                np.stack([place.up, place.along], -1).astype(np.float32),
                np.stack([place.sign, offset], -1).astype(np.float32),
            )
        )
        each = np.sum(allowed, -1)
        counts.append(each)
        reached += [
            np.unique(some) for some in np.split(corners.reshape(len(corners), -1), np.cumsum(each)[:-1])
        ]
    control, node, share, turned = (np.concatenate(part) for part in zip(*parts, strict=True))
    stuck = np.concatenate(counts) == 0
    if stuck.any():
        raise ValueError(
            f"with the design angle {math.degrees(game.angle):.4g} deg no velocity keeps the pursuit barrier "
            f"for a period of {game.control_period:g} s at {np.mean(stuck):.1%} of the nodes; take another "
            "angle, a smaller capture distance or a shorter period"
        )
    sizes = [len(some) for some in reached]
    return _Transitions(
        nodes,
        np.concatenate([[0], np.cumsum(np.concatenate(counts))]),
        control,
        node,
        share,
        turned,
        (np.concatenate(reached), np.concatenate([[0], np.cumsum(sizes)])),
    )


def _settle(
    game: ClearanceGame,
    begun: Solution,
    resolution: Resolution,
    most: float,
    tolerance: float,
    periods: int | None,
) -> Iterator[Solution]:
    """Sweep after sweep until nothing changes by more than `tolerance`, or for so many periods."""
    from sidestep.safety.clearance.sweep import sweep

    grid, directions, ridge, table, stage, sweeps, change = begun
    transitions = _transitions(game, grid, resolution, ridge)
    angles, moves = directions.nodes, game.velocities(resolution.headings) * game.control_period
    reached, begins = transitions.reached
    due: Bool[np.ndarray, "n"] = np.ones(len(transitions.nodes), bool)
    spans = np.stack([transitions.first[:-1], transitions.first[1:]], -1)
    strides = np.array([grid.heights.count, grid.committed, grid.first_committed])
    table = table.copy()
    while change > tolerance and due.any() and (periods is None or sweeps < periods):
        nodes = transitions.nodes[due]
        new = sweep(
            table,
            nodes,
            spans[due],
            transitions.control,
            transitions.place,
            strides,
            transitions.share,
            transitions.turned,
            angles,
            ridge,
            moves,
            game.obstacle_speed * game.control_period,
            np.float32(most),
        )
        rise = np.max(new - table[nodes], axis=1)
        table[nodes] = new
        changed = np.zeros(grid.size, bool)
        changed[nodes] = rise > 0.0
        # A node is due again once a node that it depends on has changed.
        due = np.logical_or.reduceat(changed[reached], begins[:-1])
        sweeps, change = sweeps + 1, float(np.max(rise))
        yield Solution(grid, directions, ridge, table, stage, sweeps, change)


def _smooth(field: Float[np.ndarray, "a b"], weight: Float[np.ndarray, "a b"]) -> Float[np.ndarray, "a b"]:
    """A field of angles averaged over neighbours, unwrapped."""
    turned = np.exp(1j * field) * np.maximum(weight, 1e-6)
    for _ in range(3):
        padded = np.pad(turned, 1, mode="edge")
        beside = padded[:-2, 1:-1] + padded[2:, 1:-1] + padded[1:-1, :-2] + padded[1:-1, 2:]
        turned = (4.0 * turned + beside) / 8.0
    return np.unwrap(np.unwrap(np.angle(turned), axis=0), axis=1)


def ridge_of(solution: Solution) -> Float[np.ndarray, "n"]:
    """Where clearance is largest, rad, smoothed over the nodes."""
    grid, rows, angles = solution.grid, solution.clearance, solution.directions.nodes
    count = rows.shape[1]
    node, beside = np.arange(len(rows))[:, None], np.arange(-2, 3)
    top = np.argmax(rows, 1)[:, None] + beside
    near = rows[node, top % count] - np.min(rows[node, top % count], 1, keepdims=True)
    share = near**2 + 1e-12
    angle = solution.ridge + np.sum(
        share * (angles[top % count] + 2.0 * math.pi * (top // count)), 1
    ) / np.sum(share, 1)
    height = np.max(rows, 1) - np.min(rows)
    size = grid.heights.count
    # Beyond the axis the mirror images: there the other side's ridge is highest.
    chosen, high = (part[: grid.first_committed].reshape(size, size) for part in (angle, height))
    lower = np.tril_indices(size, -1)
    for part in (chosen, high):
        part[lower[1], lower[0]] = part[lower]
    committed = (size, grid.committed)
    rest = (part[grid.first_committed :].reshape(committed) for part in (angle, height))
    return np.concatenate([_smooth(chosen, high).ravel(), _smooth(*rest).ravel()])


def _spread(coarse: Grid, field: Float[np.ndarray, "n"], fine: Grid) -> Float[np.ndarray, "m"]:
    """A field of one grid on the nodes of another."""
    points = fine.points
    corners, weights = coarse.place(np, points[:, 0], np.abs(points[:, 1])).corners(np)
    return np.sum(weights * field[corners], -1)


def solve(
    game: ClearanceGame,
    resolution: Resolution | None = None,
    *,
    periods: int | None = None,
    most: float = 1.0,
    tolerance: float = 2e-6,
    begun: Solution | None = None,
    progress: Callable[[Solution], None] | None = None,
) -> Solution:
    """The clearance table of a game, see `STAGES` for the way.

    **Arguments:** `periods` for which the evader is to stay free, for ever if None; `most` (m) stands for
    every larger clearance; `tolerance` (m) of a sweep's change at which it ends; `begun`, a solution on the
    way, to go on from, with the same result; `progress` is called with each one.

    **Raises** `ValueError` for a bad number, where Numba is not installed, and where from some node no
    velocity keeps the pursuit barrier: the design angle does not suit the capture distance and the period.
    """
    resolution = Resolution() if resolution is None else resolution
    check(game, title="clearance game: ")
    check(resolution, title="resolution: ")
    if resolution.angles % 2:
        raise ValueError(f"resolution: angles = {resolution.angles}: it must be even")
    needed("numba", "clearance", "solving for a clearance table needs", ValueError)
    solution = _start(game, _ROUGH.grid(game), _ROUGH.directions(even=True)) if begun is None else begun
    for stage, (how, least) in enumerate(((_ROUGH, 1e-4), (resolution, 1e-4), (resolution, tolerance))):
        if stage < solution.stage:
            continue
        if stage > solution.stage:
            solution = _next(game, solution, resolution, warm=periods is None)
        for later in _settle(game, solution, how, most, least, periods):
            solution = later
            if progress is not None:
                progress(later)
    return solution


def _start(game: ClearanceGame, grid: Grid, directions: Angles) -> Solution:
    clearance = np.full((grid.size, directions.count), game.collision_distance, np.float32)
    return Solution(grid, directions, np.zeros(grid.size), clearance, 0, 0, math.inf)


def _next(game: ClearanceGame, solution: Solution, resolution: Resolution, *, warm: bool) -> Solution:
    """The first of the next stage: rows aligned by the ridge found; `warm` from the clearance found."""
    grid, ridge = resolution.grid(game), ridge_of(solution)
    fresh = _start(game, grid, resolution.directions())
    if solution.stage == 0:
        return fresh._replace(ridge=_spread(solution.grid, ridge, grid), stage=1)
    clearance = _turned(solution, ridge) if warm else fresh.clearance
    return fresh._replace(ridge=ridge, clearance=clearance, stage=2)


def _turned(solution: Solution, ridge: Float[np.ndarray, "n"]) -> Float[np.ndarray, "n k"]:
    """The clearance of a solution in rows aligned by another ridge."""
    angles = solution.directions.nodes + (ridge - solution.ridge)[:, None]
    node, weight = solution.directions.place(np, angles)
    row, after = np.arange(len(ridge))[:, None], (node + 1) % solution.directions.count
    mixed = (1.0 - weight) * solution.clearance[row, node] + weight * solution.clearance[row, after]
    return mixed.astype(np.float32)
