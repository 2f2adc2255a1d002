"""What a held velocity leaves after a period at least, from every state of a small set, for `check`.

The bounds are rigorous but for the rounding of double precision. They rest on this:

- *Pursuer.* It ends turned by theta, and drives D <= V T - b W, where W >= |theta| is all its turning. Its
  headings are within W/2 of theta/2. So along e(theta/2) it comes x, |x| <= V T - b |theta|, and across it at
  most D (V T - D)/(2 b) with some D >= |x|. The pairs (x + b theta, x - b theta) fill a square.
- *Evader.* n.z' is linear in x, in z and in what is across; in theta its second derivative is bounded. h' is
  the largest n.z' - l of all unit vectors n that are at least S' from the pursuer's axis.
- *Obstacle.* It moves within a disc of radius r = v_c T. In the direction delta off that of q = p + u T it is
  at least |q| cos(delta) - sqrt(r^2 - |q|^2 sin^2(delta)) away.
- *|p|.* d|p'|/d|p| is cos(alpha), and |d phi'/d|p|| = sin(alpha)/|p'|, alpha the angle between p and p'. So
  |p'| - R(z', phi') grows with |p| where cos(alpha) > L sin(alpha)/|p'|, with L the largest slope of R in
  phi. That is checked where |p'| >= d, and there what is once at least 0 remains so: |p| = R is the worst.

The square times the obstacle's directions is halved, the widest side first, until every piece holds.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np

from sidestep.safety.clearance.stored import ARC, COMMITTED, OPEN, StoredTable

_ROOTS, _HALVINGS, _PIECES, _LOOKED_AT = (12, 12, 2), 18, 10_000, 64
_UNKNOWN = 1.0
"""Shortfall (m) that stands for a piece too large to tell."""


class Start(NamedTuple):
    """States z in `centre` + s `first` + t `second`, |s|, |t| <= 1, and up to `rest` (m) off; R is at least
    `least` (m); phi within `spread` (rad) of `phi`."""

    centre: Any
    first: Any
    second: Any
    rest: float
    least: float
    phi: float
    spread: float


class _Offset(NamedTuple):
    """q = p + u T with |p| the least: at least `far` (m), directed within `spread` (rad) of `towards`; the
    obstacle's drift turns it by up to `widest` (rad); R may rise by up to `slope` (m/rad)."""

    far: float
    towards: float
    spread: float
    widest: float
    slope: float


def unit(angle: Any) -> Any:
    """e(angle), on a last axis."""
    return np.stack([np.cos(angle), np.sin(angle)], -1)


class WorstCase:
    """Against the pursuer of a table's game and an obstacle of up to `drift` m/s. `moves` are u T in m."""

    def __init__(self, table: StoredTable, drift: float):
        self.table, self.drifts = table, drift * table.period
        self.reach = table.speed * table.period

    def sampled(self, start: Start, moves: Any, motions: Any) -> Any:
        """What each of `moves` leaves (m) at the centre with |p| = R, after some motions (n, 3): x + b theta,
        x - b theta, and the obstacle's direction as a share of the widest. An upper bound of the least."""
        x, theta = motions[:, :2].sum(1) / 2.0, (motions[:, 0] - motions[:, 1]) / (2.0 * self.table.axle)
        _, clearance = self.table.lookup(start.centre[None], np.array([start.phi]))
        moved = start.centre + moves[:, None] - x[:, None] * unit(theta / 2.0)
        seen = np.stack([np.sum(moved * unit(theta + turn), -1) for turn in (0.0, math.pi / 2.0)], -1)
        offset = clearance[0] * unit(start.phi) + moves
        far = np.hypot(*offset.T)[:, None]
        off = motions[:, 2] * np.arcsin(self.drifts / far)
        phi = np.arctan2(offset[:, 1], offset[:, 0])[:, None] + off - theta
        height, needed = self.table.lookup(seen.reshape(-1, 2), phi.ravel())
        return np.min(np.minimum(height, self._near(far, off).ravel() - needed).reshape(phi.shape), 1)

    def margin(self, start: Start, move: Any) -> float:
        """A lower bound (m) of what a move leaves for h' and |p'| - R, 0 where it is at least that.

        It is below 0 also where a motion from the centre is found that breaks the set: then it is what that
        leaves, which is no bound.
        """
        after = self._offset(start, move)
        scale = np.array([1.0, 1.0, after.widest * after.far])
        half = np.array([self.reach, self.reach, 1.0]) / _ROOTS
        axes = [size * (2.0 * np.arange(n) + 1.0 - n) for size, n in zip(half, _ROOTS, strict=True)]
        pieces = np.stack(np.meshgrid(*axes, indexing="ij"), -1).reshape(-1, 3)
        for halving in range(_HALVINGS + 1):
            margin = self._bound(start, move, after, pieces, half)
            undecided = ~(margin >= 0.0)
            if not undecided.any():
                return 0.0
            pieces, margin = pieces[undecided], np.nan_to_num(margin[undecided], nan=-_UNKNOWN)
            broken = float(np.min(self.sampled(start, move[None], pieces[np.argsort(margin)[:_LOOKED_AT]])))
            if broken < 0.0:
                return broken
            if halving == _HALVINGS or len(pieces) > _PIECES:
                break
            side = int(np.argmax(half * scale))
            half[side] /= 2.0
            step = half * (np.arange(3) == side)
            pieces = np.concatenate([pieces - step, pieces + step])
        return float(np.min(margin))

    def dip(self, start: Start, move: Any) -> float:
        """How much nearer (m) than l or d the robots may be within the period.

        Let the pursuer be turned by theta then. Along any unit vector n it comes at most A(s), where
        s = V t - b |theta| >= 0 is left for driving: s C, with C the cosine to the nearest heading on the
        way, or (s + 2 b C)^2/(8 b) where a detour pays, s > 2 b C. A is convex in t. So n.(z + u t) - A,
        which bounds the distance, is least at s = 0 or t = T. For the obstacle, |p + u t| - v_c t is least
        where its rate is 0.
        """
        table, collision = self.table, self.table.game["collision_distance"]
        angle = math.atan2(start.centre[1], start.centre[0]) + np.linspace(-1.2, 1.2, 481)
        n = unit(np.append(angle, [table.angle, -table.angle]))
        z = n @ start.centre - np.abs(n @ start.first) - np.abs(n @ start.second) - start.rest
        pursuer = -math.inf
        turns = np.linspace(0.0, self.reach / table.axle, 17)
        for ends in np.stack([turns[:-1], turns[1:]], -1):
            for way in (1.0, -1.0):
                passed = unit(way * np.linspace(0.0, ends[1], 9))
                # Between two headings it is larger than at both only where it is 1, and by less than this.
                cosine = np.minimum(np.max(np.abs(n @ passed.T), 1) + (ends[1] / 8.0) ** 2 / 8.0, 1.0)
                budget, twice = self.reach - table.axle * ends[0], 2.0 * table.axle * cosine
                comes = np.where(budget > twice, (budget + twice) ** 2 / (8.0 * table.axle), budget * cosine)
                turned = table.axle * ends / self.reach
                begun = np.min(z[:, None] + turned * (n @ move)[:, None], 1)
                pursuer = max(pursuer, table.level - float(np.max(np.minimum(begun, z + n @ move - comes))))
        p, long = start.least * unit(start.phi), math.hypot(*move)
        if long <= self.drifts:
            return max(pursuer, collision - start.least + long + self.drifts, 0.0)
        aside, before = abs(p[0] * move[1] - p[1] * move[0]) / long, p @ move / long
        rate = self.drifts / long
        place = float(np.clip(rate * aside / math.sqrt(1.0 - rate**2), before, before + long))
        least = math.hypot(aside, place) - rate * (place - before) - long * start.spread
        return max(pursuer, collision - least, 0.0)

    def _near(self, far: Any, off: Any) -> Any:
        """How far (m) the obstacle is at least, in a direction `off` (rad) its first, `far` (m) away."""
        return far * np.cos(off) - np.sqrt(np.maximum(self.drifts**2 - (far * np.sin(off)) ** 2, 0.0))

    def _offset(self, start: Start, move: Any) -> _Offset:
        offset, long = start.least * unit(start.phi) + move, math.hypot(*move)
        spread = start.spread * start.least / (start.least - long)
        far = math.hypot(*offset) - long * spread
        kept = max(start.least - long - self.drifts, self.table.game["collision_distance"])
        sine = (long + self.drifts) / kept
        slope = math.sqrt(1.0 - sine**2) * kept / max(sine, 1e-12)
        return _Offset(far, math.atan2(offset[1], offset[0]), spread, math.asin(self.drifts / far), slope)

    def _bound(self, start: Start, move: Any, after: _Offset, pieces: Any, half: Any) -> Any:
        """Lower bounds (m) of the margin over `pieces` (n, 3), `half` as wide as they; NaN where one is too
        large to tell."""
        table, axle = self.table, self.table.axle
        x, theta = (pieces[:, 0] + pieces[:, 1]) / 2.0, (pieces[:, 0] - pieces[:, 1]) / (2.0 * axle)
        dx, dtheta = (half[0] + half[1]) / 2.0, (half[0] + half[1]) / (2.0 * axle)
        driven = np.clip(np.abs(x) - dx, self.reach / 2.0, self.reach)
        across = driven * (self.reach - driven) / (2.0 * axle)
        v = start.centre + move
        bend = (math.hypot(*v) + self.reach / 4.0) * dtheta**2 / 2.0 + dx * dtheta / 2.0

        def along(angle: Any, mine: Any = slice(None)) -> tuple[Any, Any]:
            """n.z' in the middle of the pieces, and how far it is from that elsewhere."""
            turn, half_turn = angle + theta[mine], angle + theta[mine] / 2.0
            n = unit(turn)
            rate = (unit(turn + math.pi / 2.0) @ v + x[mine] / 2.0 * np.sin(half_turn)) / axle
            cosine = np.cos(half_turn)
            far = (half[0] * np.abs(rate - cosine) + half[1] * np.abs(rate + cosine)) / 2.0
            far = far + (np.abs(np.sin(half_turn)) + dtheta / 2.0) * across[mine] + bend + start.rest
            for side in (start.first, start.second):
                far = far + np.abs(n @ side) + math.hypot(*side) * dtheta
            return n @ v - x[mine] * cosine, far

        (ahead, ahead_far), (left, left_far) = along(0.0), along(math.pi / 2.0)
        bearing = np.arctan2(left, ahead)
        value, far = along(np.copysign(np.clip(np.abs(bearing), table.angle, math.pi - table.angle), bearing))
        margin = value - far - table.level
        near = self._near(after.far, np.maximum(np.abs(pieces[:, 2]) - half[2], 0.0) * after.widest)
        direction = after.towards + pieces[:, 2] * after.widest - theta
        wide = after.spread + half[2] * after.widest + dtheta
        # As in the table, z' is turned into the first quadrant: by each of the ways that some piece needs.
        for front, side in ((1, 1), (1, -1), (-1, 1), (-1, -1)):
            mine = np.flatnonzero((front * ahead + ahead_far >= 0.0) & (side * left + left_far >= 0.0))
            if not len(mine):
                continue
            phi = (direction[mine] if front == side else -direction[mine]) + math.pi * (front < 0)
            for region, some, ranges in _parts(table, along, mine, bearing[mine], front, side):
                if not some.any():
                    continue
                some_ranges = [one[some] for one in (*ranges, phi - wide, phi + wide)]
                _, needed, steep = table.bounds(region, *some_ranges)
                spare = np.where(steep < after.slope, near[mine[some]] - needed, np.nan)
                margin[mine[some]] = np.minimum(margin[mine[some]], spare)
        return margin


def _parts(table: StoredTable, along: Any, mine: Any, bearing: Any, front: int, side: int) -> Any:
    """For each region: which of the pieces `mine` touch it, turned into the first quadrant, and the ranges
    there of their heights and of b or their bearings."""
    cosine, sine = math.cos(table.angle), math.sin(table.angle)
    a, a_far = along(math.atan2(side * sine, front * cosine), mine)
    b, b_far = along(math.atan2(-side * sine, front * cosine), mine)
    beyond, beyond_far = along(math.atan2(side * cosine, -front * sine), mine)
    out, out_far = along(bearing, mine)
    _, across = along(bearing + math.pi / 2.0, mine)
    heights = a - a_far - table.level, a + a_far - table.level
    low, high = b - b_far - table.level, b + b_far - table.level
    straight = beyond <= beyond_far
    yield OPEN, straight & (high >= 0.0), (*heights, np.maximum(low, 0.0), high)
    yield COMMITTED, straight & (low <= 0.0), (*heights, low, np.minimum(high, 0.0))
    swing = across / np.maximum(out - out_far, 1e-9)
    turned = np.arctan2(side * np.sin(bearing), front * np.cos(bearing))
    rounds = out - out_far - table.level, np.hypot(out + out_far, across) - table.level
    yield ARC, beyond + beyond_far >= 0.0, (*rounds, turned - swing, turned + swing)
