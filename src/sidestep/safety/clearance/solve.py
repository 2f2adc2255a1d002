"""Solves for the clearance table: the least fixed point of the sampled game, from the collision distance up.

Where everything is kept: `sweep` has the equation, `grid` the nodes.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from sidestep._bounds import bounded, check
from sidestep._packages import needed
from sidestep.safety.clearance.game import ClearanceGame
from sidestep.safety.clearance.grid import Angles, Grid, Place, Spacing
from sidestep.safety.sampled.flow_map import seen_from

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
    growth: float = bounded(1.15, above=1.0, most=2.0)
    farthest: float = bounded(0.25, above=0.0, most=1e3, unit="m")
    share: float = bounded(0.004, above=0.0, most=0.5)
    share_growth: float = bounded(1.25, above=1.0, most=2.0)
    bearings: int = bounded(20, least=1, most=1000)
    angles: int = bounded(144, least=32, most=4096)
    ridge: float = bounded(0.014, above=0.0, most=1.0, unit="rad")
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
            game.pursuer_speed * game.control_period,
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


ROUGH = Resolution(height=0.002, growth=1.3, share=0.01, share_growth=1.4, bearings=12, angles=96)
"""For first solutions, and for tables of a few seconds."""
STAGES = ("finding the ridge", "aligning", "solving")
"""What a solution goes through: coarsely, with rows aligned by the coarse ridge, and by the fine one."""


class Solution(NamedTuple):
    """A table, solved or on the way.

    `clearance` and `after` (nodes, angles) m, R and R' of `sweep`; `ridge` (nodes,) rad, from which the
    angles of a row count; `stage` in `STAGES`, the `sweeps` of it, and the largest `change` in the last of
    them, m.
    """

    grid: Grid
    directions: Angles
    ridge: Float[np.ndarray, "n"]
    clearance: Float[np.ndarray, "n k"]
    after: Float[np.ndarray, "n k"]
    stage: int
    sweeps: int
    change: float


class _Reads(NamedTuple):
    """Cells that a half of a period leads to, see `sweep`, and the nodes that each node depends on, one after
    the other, with where those of each begin."""

    place: Int[np.ndarray, "..."]
    share: Float[np.ndarray, "... 2"]
    turned: Float[np.ndarray, "... 2"]
    reached: Int[np.ndarray, "r"]
    begins: Int[np.ndarray, "n"]

    def due(self, changed: Bool[np.ndarray, "nodes"]) -> Bool[np.ndarray, "n"]:
        """Whether a node that each depends on has changed."""
        return np.logical_or.reduceat(changed[self.reached], self.begins)


@dataclass(frozen=True)
class _Transitions:
    """What `sweep` reads: the pursuer's half of a period for every one of `nodes`, then the evader's, in
    pairs of node and control."""

    nodes: Int[np.ndarray, "n"]
    pursuer: _Reads
    spans: Int[np.ndarray, "n 2"]
    control: Int[np.ndarray, "p"]
    evader: _Reads


def _read(
    places: list[Place], headings: list[Any], ridge: Float[np.ndarray, "n"], own: list[Int[np.ndarray, "_"]]
) -> _Reads:
    """`headings` (rad) of the pursuer then; `own` says to which node each place belongs."""
    parts, reached, sizes = [], [], []
    for place, heading, node in zip(places, headings, own, strict=True):
        corners, weights = place.corners(np)
        offset = math.pi * place.turns - place.sign * heading - np.sum(weights * ridge[corners], -1)
        parts.append(
            (
                place.node.astype(np.int32),
                np.stack([place.up, place.along], -1).astype(np.float32),
                np.stack([place.sign, offset], -1).astype(np.float32),
            )
        )
        first = np.searchsorted(node, np.arange(node[-1] + 1))
        each = [np.unique(some) for some in np.split(corners.reshape(len(corners), -1), first[1:])]
        reached += each
        sizes += [len(some) for some in each]
    place, share, turned = (np.concatenate(part) for part in zip(*parts, strict=True))
    return _Reads(place, share, turned, np.concatenate(reached), np.concatenate([[0], np.cumsum(sizes)[:-1]]))


def _transitions(
    game: ClearanceGame, grid: Grid, resolution: Resolution, ridge: Float[np.ndarray, "n"]
) -> _Transitions:
    moves = game.velocities(resolution.headings) * game.control_period
    motions = game.motions(resolution.turns, resolution.drives)
    count = grid.heights.count
    left, right = np.divmod(np.arange(grid.first_committed), count)
    # By the mirror the others are never read, but for the first beyond the axis.
    nodes = np.concatenate([np.flatnonzero(left >= right - 1), np.arange(grid.first_committed, grid.size)])
    points = grid.points[nodes]
    driven: tuple[list[Any], ...] = ([], [], [])
    held: tuple[list[Any], ...] = ([], [], [])
    controls, counts = [], []
    for begin in range(0, len(nodes), _BLOCK):
        z = points[begin : begin + _BLOCK]
        before = np.stack([grid.farther(z[:, 0]), z[:, 1]], -1)
        seen = seen_from(before[:, None], motions[None])
        driven[0].append(grid.place(np, seen[..., 0], seen[..., 1]))
        driven[1].append(motions[:, 2])
        driven[2].append(np.arange(len(z)))
        moved = z[:, None] + moves
        allowed = np.min(_heights(grid, moved, motions), -1) >= -1e-9
        node, control = np.nonzero(allowed)
        held[0].append(grid.place(np, grid.nearer(np, moved[allowed][:, 0]), moved[allowed][:, 1]))
        held[1].append(0.0)
        held[2].append(node)
        controls.append(control)
        counts.append(np.sum(allowed, -1))
    each = np.concatenate(counts)
    if (each == 0).any():
        raise ValueError(
            f"with the design angle {math.degrees(game.angle):.4g} deg no velocity keeps the pursuit barrier "
            f"for a period of {game.control_period:g} s at {np.mean(each == 0):.1%} of the nodes; take "
            "another angle, a smaller capture distance or a shorter period"
        )
    ends = np.cumsum(each)
    return _Transitions(
        nodes,
        _read(*driven[:2], ridge, driven[2]),
        np.stack([ends - each, ends], -1),
        np.concatenate(controls),
        _read(*held[:2], ridge, held[2]),
    )


def _heights(grid: Grid, moved: Float[np.ndarray, "... 2"], motions: Float[np.ndarray, "m 3"]) -> Any:
    """h' (m) after every motion."""
    seen = seen_from(moved[..., None, :], motions)
    return grid.height(np, seen[..., 0], seen[..., 1])


def _settle(
    game: ClearanceGame,
    begun: Solution,
    resolution: Resolution,
    most: float,
    tolerance: float,
    periods: int | None,
) -> Iterator[Solution]:
    """Sweep after sweep until nothing changes by more than `tolerance`, or for so many periods."""
    from sidestep.safety.clearance.sweep import evader_moves, pursuer_moves

    grid, directions, ridge, table, after, stage, sweeps, change = begun
    transitions = _transitions(game, grid, resolution, ridge)
    nodes, driven, held = transitions.nodes, transitions.pursuer, transitions.evader
    angles, moves = directions.nodes, game.velocities(resolution.headings) * game.control_period
    drift = game.obstacle_speed * game.control_period
    # A wall grown by its drift is a wall so much nearer.
    grown, spare = (0.0, game.spare + drift) if game.wall else (drift, game.spare)
    strides = np.array([grid.heights.count, grid.committed, grid.first_committed])
    changed = np.ones(grid.size, bool)
    table, after, choice = table.copy(), after.copy(), np.zeros(table.shape, np.int16)
    while True:
        due = driven.due(changed)
        was = after[nodes[due]]
        after[nodes[due]] = pursuer_moves(
            table,
            nodes[due],
            driven.place[due],
            strides,
            driven.share[due],
            driven.turned[due],
            angles,
            ridge,
            grown,
            spare,
        )
        if change <= tolerance or (periods is not None and sweeps >= periods):
            break
        changed[:] = False
        changed[nodes[due]] = np.any(after[nodes[due]] != was, axis=1)
        due = held.due(changed) if sweeps else np.ones(len(nodes), bool)
        new = evader_moves(
            table,
            after,
            nodes[due],
            transitions.spans[due],
            transitions.control,
            held.place,
            strides,
            held.share,
            held.turned,
            angles,
            ridge,
            moves,
            game.wall,
            most,
            choice,
        )
        rise = np.max(new - table[nodes[due]], axis=1, initial=0.0)
        table[nodes[due]] = new
        changed[:] = False
        changed[nodes[due]] = rise > 0.0
        sweeps, change = sweeps + 1, float(np.max(rise, initial=0.0))
        yield Solution(grid, directions, ridge, table, after, stage, sweeps, change)
    yield Solution(grid, directions, ridge, table, after, stage, sweeps, change)


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
    solution = _start(game, ROUGH.grid(game), ROUGH.directions(even=True)) if begun is None else begun
    for stage, (how, least) in enumerate(((ROUGH, 1e-4), (resolution, 1e-4), (resolution, tolerance))):
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
    return Solution(grid, directions, np.zeros(grid.size), clearance, clearance.copy(), 0, 0, math.inf)


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
