"""What an evader that decides once per control period can hold against a pursuer that reacts at any instant.

**Set.** For a design angle S' >= S and a side s (+1 left, -1 right of the pursuer's axis) let
g_s(z) = max n.z over the unit normals n on that side at least S' from the axis: the capture game's barrier
(plus l), with somewhat longer tips. An evader at g_s >= c is at least c away.

**Law.** Flee at full speed along the measured normal of the remembered side, u = v_e n; change sides once the
evader is measured to be on the other one beyond any doubt.

**Claim.** c is held for ever if from every z with g_s(z) >= c, for every measurement within the errors and
every motion of the pursuer in one period T (see `flow_map`), g_s(z(T)) >= c again. `slack` computes the least
of g_s(z(T)) - c over all of these, from below:

- z runs over the boundary g_s = c from the arc's middle to the tip, and as far past the axis as doubt about
  the side lets it; farther out nothing is lost, since every lower bound used grows with g_s;
- for each final heading the lower bound is n.R(-theta)(z + u T) - advance, for the best of some normals n;
- between the nodes that bound is linear along the boundary's straight part, concave in the direction of u,
  and smooth in theta and along the arc, with curvature bounds that are subtracted. So the result holds
  between the nodes too; a coarse grid costs sharpness, never truth.

A wider S' gives up tip for spare speed, v_e - V cos S', which pays for what the pursuer gains by turning and
driving within one period; `sampled_design` finds
the S' that holds the largest c.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float

from sidestep.safety.sampled.flow_map import (
    advance,
    bending,
    closest_alignment,
    seen_from,
    side_value,
    turn_nodes,
)

_LEAST_PERIOD = 1e-6
"""A period of 0 is computed as this one, s: the claims scale with the period, rounding does not."""
_SHARES = np.array([0.0, 0.25, 0.5, 0.75, 1.0])
_BLENDS = 12


@dataclass(frozen=True)
class SampledGame:
    """The game with everything a real controller has against it, in SI units.

    `position_error` and `heading_error` bound what each measurement is off by (m, rad), `delay` is how old
    it is (s). `own_motion_predicted`: whether the evader adds its own motion during the delay.
    `tracking_error` bounds how far (m/s) the velocity driven is from the one that the law asks for.
    """

    evader_speed: float
    pursuer_speed: float
    half_axle: float
    control_period: float
    position_error: float = 0.0
    heading_error: float = 0.0
    delay: float = 0.0
    own_motion_predicted: bool = True
    tracking_error: float = 0.0

    @property
    def usable_angle(self) -> float:
        """S = arccos(min(v_e/V, 1)), rad."""
        return math.acos(min(self.evader_speed / self.pursuer_speed, 1.0))

    @property
    def largest_capture_distance(self) -> float:
        """l_max = b rho^2/sqrt(1 - rho^2), m; infinite for an evader at least as fast."""
        ratio = self.evader_speed / self.pursuer_speed
        if ratio >= 1.0:
            return math.inf
        return self.half_axle * ratio**2 / math.sqrt((1.0 - ratio) * (1.0 + ratio))

    @property
    def period(self) -> float:
        """The control period used in computations, s."""
        return max(self.control_period, _LEAST_PERIOD)

    @property
    def offset_error(self) -> float:
        """How far the position used may be from the one at the decision, m.

        A delay leaves the *pursuer's* pose old, and the game between the evader now and the pursuer then is
        the same game; only an evader that does not add its own motion takes it for an error of position.
        """
        unseen = self.tracking_error if self.own_motion_predicted else self.evader_speed + self.tracking_error
        return self.position_error + unseen * self.delay

    @property
    def drift(self) -> float:
        """How far from where the law meant it to be the evader may end a period, m: g_s falls by no more."""
        return self.tracking_error * self.period


@dataclass(frozen=True)
class Design:
    """A set {g_s >= `level`} (m) with normals at least `angle` S' (rad) from the axis."""

    angle: float
    level: float

    @property
    def tip(self) -> float:
        """Where the set ends on the pursuer's axis, m."""
        return self.level / math.cos(self.angle)


@dataclass(frozen=True)
class Cells:
    """How finely the worst case is covered: cells along the straight part, along the arc, per turn side."""

    straight: int
    arc: int
    turn: int


def overlap(game: SampledGame, angle: float) -> tuple[float, float]:
    """(w0, w1): at level c the law may follow a side w = w0 + w1 c past the axis, m; infinite for no bound.

    It changes sides once the measured y is w/2 past the axis, where w/2 is at least what y can be off at a
    range of up to (c + 3 w sin S')/cos S' + w. There the true y has passed the axis too, and by at most w
    before. Farther away, g on either side is at least c anyway.
    """
    error, turn = game.offset_error, game.heading_error
    remaining = 1.0 - 2.0 * turn * (1.0 + 3.0 * math.tan(angle))
    if remaining <= 0.0:
        return math.inf, math.inf
    return 2.0 * error * (1.0 + 2.0 * turn) / remaining, 2.0 * turn / math.cos(angle) / remaining


_Corners = list[tuple[Float[np.ndarray, "..."], Float[np.ndarray, "..."]]]


def _ends(game: SampledGame) -> list[tuple[int, int, int]]:
    """Ends (0 or 1) of a cell in place, in turn, and in the direction of u, which is known without errors."""
    exact = game.offset_error == 0.0 and game.heading_error == 0.0
    return [(i, j, k) for i in (0, 1) for j in (0, 1) for k in ((0,) if exact else (0, 1))]


def _least_in_cells(
    corners: _Corners,
    game: SampledGame,
    sine: Float[np.ndarray, "..."],
    detour: Bool[np.ndarray, "..."],
    far: float,
    width: float,
) -> Float[np.ndarray, "..."]:
    """Least value over each cell, from those at its corners less what it may dip between them.

    A corner is (value, the part n.R(-theta)p of it): in theta the value's second derivative is at most minus
    that part, plus that of -advance (see `flow_map`).
    """
    value = np.min([entry[0] for entry in corners], axis=0)
    place = np.min([entry[1] for entry in corners], axis=0) - far * width
    bend = bending(game.pursuer_speed * game.period, game.half_axle, sine, detour)
    return value - np.maximum(bend - place, 0.0) * width**2 / 8.0


@dataclass(frozen=True)
class _Normals:
    """Lower bounds `length` n.z - `toll` on the value, n at `offset` from S'; all (cells, turns, normals)."""

    offset: Float[np.ndarray, "..."]
    length: Float[np.ndarray, "..."]
    toll: Float[np.ndarray, "..."]


def _normals(design: Design, middle: Float[np.ndarray, "turns"], past: float) -> _Normals:
    """Normals that bound the value after the period from below, whichever side the evader is on by then.

    On the remembered side: those at least S' from the axis, turned back with the pursuer's heading by some
    share of it, so that they stay put in the world. And across the axis: for |mu| <= 1 and an overlap w
    (`past`), the value is at least |x| cos S' + mu y sin S' - (1 - mu) w sin S' both up to w past the axis,
    where it is g_s, and beyond, where it is that of the other side.
    """
    back = np.clip(-_SHARES[None, :] * middle[:, None], 0.0, math.pi - 2.0 * design.angle)
    # Near the axis the best mu differs from 1 by as little as the pursuer can turn.
    blends = 1.0 - np.geomspace(min(0.2 * middle[-1], 1.0), 2.0, _BLENDS)
    across = math.sin(design.angle) * np.broadcast_to(blends, (len(middle), _BLENDS))
    ahead = math.cos(design.angle)
    offset = np.concatenate([back, np.arctan2(across, ahead) - design.angle], axis=1)
    length = np.concatenate([np.ones_like(back), np.hypot(across, ahead)], axis=1)
    toll = np.concatenate([np.zeros_like(back), past * (math.sin(design.angle) - across)], axis=1)
    return _Normals(offset[None], length[None], toll[None])


def _share_nodes(game: SampledGame, design: Design, cells: int) -> Float[np.ndarray, "n"]:
    """Nodes from the arc (0) to the tip (1): half of them evenly, half ever finer toward the tip.

    There it matters whether the pursuer turns past the evader, and both move on the scale of one period.
    """
    step = game.pursuer_speed * game.period / (design.level * math.tan(design.angle) + 1e-12)
    finest = min(0.02 * step * 32.0 / cells, 0.5)
    graded = 1.0 - np.geomspace(finest, 1.0, cells // 2 + 1)[:-1]
    return np.union1d(np.linspace(0.0, 1.0, cells - cells // 2 + 1), graded)


def _straight_bound(
    game: SampledGame, design: Design, cells: Cells, bearing_error: float
) -> Float[np.ndarray, "cells turns"]:
    """Lower bound on the value after T from every cell of the straight part, for every cell of headings."""
    angle, level, period = design.angle, design.level, game.period
    constant, growth = overlap(game, angle)
    turn = turn_nodes(period, game.pursuer_speed, game.half_axle, cells.turn)
    share = _share_nodes(game, design, cells.straight)
    # Along the line from where it touches the disc, to the tip and past the axis by the overlap.
    slope = share * (math.tan(angle) + growth / math.cos(angle))
    along = slope * level + share * constant / math.cos(angle)
    far = math.hypot(level, along[-1]) + game.evader_speed * period
    # Where the bearing may be taken for one on the arc, the law flees at that bearing.
    bearing = angle - np.arctan(share * math.tan(angle)) + bearing_error
    count = len(share) - 1
    low = np.full(count, angle - game.heading_error)
    high = np.maximum(bearing[:-1], angle + game.heading_error)
    normals = _normals(design, (turn[:-1] + turn[1:]) / 2.0, constant + growth * level)

    corners: _Corners = []
    for i, j, k in _ends(game):
        theta = turn[j : len(turn) - 1 + j][None, :, None]
        place = slice(i, count + i)
        fled = (low if k == 0 else high)[:, None, None]
        rotated = normals.offset + theta
        cosine, sine = np.cos(rotated), np.sin(rotated)
        grows = cosine - slope[place][:, None, None] * sine
        reached = level * cosine - along[place][:, None, None] * sine
        reached = reached + game.evader_speed * period * np.cos(angle + rotated - fled)
        value = normals.length * (reached - _advance(game, angle + normals.offset, turn, j)) - normals.toll
        corners.append((np.where(grows >= 0.0, value, -np.inf), normals.length * reached))
    sine, detour = _aim(game, angle + normals.offset, turn)
    least = _least_in_cells(corners, game, normals.length * sine, detour, far, float(turn[1] - turn[0]))
    return np.max(least, axis=-1) - _direction_error(game, float(np.max(high - low)), float(turn[-1]))


def _aim(
    game: SampledGame, angle: Float[np.ndarray, "..."], turn: Float[np.ndarray, "n"]
) -> tuple[Float[np.ndarray, "..."], Bool[np.ndarray, "..."]]:
    """Largest |sin| between n and the headings on the way, and whether a detour in heading may ever pay."""
    sine = np.minimum(np.abs(np.sin(angle)) + turn[-1], 1.0)
    least = np.maximum(np.abs(np.cos(angle)) - turn[-1], 0.0)
    return sine, 2.0 * game.half_axle * least < game.pursuer_speed * game.period


def _advance(
    game: SampledGame, angle: Float[np.ndarray, "..."], turn: Float[np.ndarray, "n"], corner: int
) -> Float[np.ndarray, "..."]:
    """`advance` at one end of each cell of headings, aimed perfectly if it is so anywhere in the cell."""
    ends = [turn[:-1][None, :, None], turn[1:][None, :, None]]
    aims = [closest_alignment(angle, end) for end in ends]
    aim = np.where((aims[0] == 1.0) | (aims[1] == 1.0), 1.0, aims[corner])
    budget = game.pursuer_speed * game.period - game.half_axle * np.abs(ends[corner])
    return advance(budget, aim, game.half_axle)


def _direction_error(game: SampledGame, width: float, turn: float) -> float:
    """Interpolation error in the direction of u: 0 as long as its cosine is concave, m."""
    if width + 2.0 * turn <= math.pi / 2.0:
        return 0.0
    return game.evader_speed * game.period * width**2 / 8.0


def _arc_bound(
    game: SampledGame, design: Design, cells: Cells, bearing_error: float
) -> Float[np.ndarray, "cells turns"]:
    """Lower bound on g_s(z(T)) from every cell of the arc, with normals that go round with the bearing."""
    level, period = design.level, game.period
    turn = turn_nodes(period, game.pursuer_speed, game.half_axle, cells.turn)
    # Finest near S', where the evader has no speed to spare.
    node = design.angle + (math.pi / 2.0 - design.angle) * np.linspace(0.0, 1.0, cells.arc + 1) ** 2
    astray = max(bearing_error, game.heading_error)
    middle = (turn[:-1] + turn[1:]) / 2.0
    first = node[:-1][:, None, None]
    offset = np.maximum(-_SHARES[None, None, :] * middle[None, :, None], design.angle - first)
    offset = np.minimum(offset, math.pi - design.angle - node[1:][:, None, None])
    reach = game.pursuer_speed * period
    width = (node[1:] - node[:-1])[:, None, None]

    corners: _Corners = []
    for i, j, k in _ends(game):
        rotated = offset + turn[j : len(turn) - 1 + j][None, :, None]
        cosine = np.cos(rotated)
        fled = np.cos(rotated - (astray if k == 1 else -astray))
        reached = level * cosine + game.evader_speed * period * fled
        place = node[i : cells.arc + i][:, None, None]
        value = reached - _advance(game, place + offset, turn, j)
        corners.append((np.where(cosine >= 0.0, value, -np.inf), np.broadcast_to(reached, value.shape)))
    sine, detour = _aim(game, first + width + offset, turn)
    # Where no detour pays the bound is smooth along the arc, elsewhere only as steep as the pursuer is fast.
    along_error = np.where(detour, reach * width / 2.0, reach * width**2 / 8.0)
    far = level + game.evader_speed * period
    least = _least_in_cells(corners, game, sine, detour, far, float(turn[1] - turn[0])) - along_error
    return np.max(least, axis=-1) - _direction_error(game, 2.0 * astray, float(turn[-1]))


def bearing_error(game: SampledGame, level: float) -> float:
    """The most that a position error can turn the bearing of an evader at least `level` away, rad."""
    return math.asin(game.offset_error / level) if game.offset_error < level else math.pi


def slack(game: SampledGame, design: Design, cells: Cells) -> float:
    """The least of g_s(z(T)) - c over everything that can happen in one period, from below, m.

    0 or more: the evader holds the level for ever. -inf where the law cannot tell the sides apart.
    """
    error = bearing_error(game, design.level)
    if not math.isfinite(overlap(game, design.angle)[0]) or error >= math.pi / 2.0:
        return -math.inf
    bounds = (_straight_bound(game, design, cells, error), _arc_bound(game, design, cells, error))
    return min(float(np.min(bound)) for bound in bounds) - game.drift - design.level


def found_slack(game: SampledGame, design: Design, turns: int = 401) -> float:
    """The least of g_s(z(T)) - c found among real motions, m: an upper bound, where `slack` is a lower one.

    From points all along the straight part, for the extreme directions that the errors lead the law to, the
    pursuer first turning on the spot for any of `turns` shares of the period, then driving, either way. The
    evader's own drift is along the normal that counts.
    """
    angle, level = design.angle, design.level
    constant, growth = overlap(game, angle)
    past = constant + growth * level
    share = _share_nodes(game, design, 16)
    along = share * (level * math.tan(angle) + past / math.cos(angle))
    line = level * np.array([math.cos(angle), math.sin(angle)])
    points = line + along[:, None] * np.array([math.sin(angle), -math.cos(angle)])
    turn = turn_nodes(game.period, game.pursuer_speed, game.half_axle, turns // 2)
    drive = game.pursuer_speed * game.period - game.half_axle * np.abs(turn)
    drive, turn = np.concatenate([drive, -drive]), np.concatenate([turn, turn])
    poses = np.stack([drive * np.cos(turn), drive * np.sin(turn), turn], -1)
    worst = math.inf
    for error in (-game.heading_error, game.heading_error):
        fled = game.evader_speed * game.period * np.array([math.cos(angle + error), math.sin(angle + error)])
        after = seen_from((points + fled)[:, None], poses[None])
        here, there = side_value(after, angle, 1.0), side_value(after, angle, -1.0)
        value = np.where(after[..., 1] >= -past, here, there)
        worst = min(worst, float(np.min(value)))
    return worst - game.drift - level
