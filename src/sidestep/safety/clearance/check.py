"""A second opinion on a clearance table: does some velocity keep its set from every state of a box?

It shares no code with the solver and reads only the table's file (see `stored`). A box is a range of z times
one of the direction phi of p, with every |p| >= R(z, phi). One held velocity u must serve all of it: after a
period, wherever the pursuer and the obstacle are, h' >= 0 and |p'| >= R(z', phi'). The bounds are rigorous
but for the rounding of double precision. They rest on this:

- *Pursuer.* It ends turned by theta, and drives D <= V T - b W, where W >= |theta| is all its turning. Its
  headings are within W/2 of theta/2. So along e(theta/2) it comes x, |x| <= V T - b |theta|, and across it at
  most D (V T - D)/(2 b) with some D >= |x|. The pairs (x + b theta, x - b theta) fill a square.
- *Evader.* n.z' is linear in x, in the box and in what is across; in theta its second derivative is bounded.
  h' is the largest n.z' - l of all unit vectors n that are at least S' from the pursuer's axis.
- *Obstacle.* It moves within a disc of radius r = v_c T. In the direction delta off that of q = p + u T it is
  at least |q| cos(delta) - sqrt(r^2 - |q|^2 sin^2(delta)) away.
- *|p|.* d|p'|/d|p| is cos(alpha), and |d phi'/d|p|| = sin(alpha)/|p'|, alpha the angle between p and p'. So
  |p'| - R(z', phi') grows with |p| where cos(alpha) > L sin(alpha)/|p'|, with L the largest slope of R in
  phi. That is checked, and then |p| = R is the worst.

The square times the obstacle's directions is halved, the widest side first, until every piece holds.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np

from sidestep.safety.clearance.stored import ARC, COMMITTED, OPEN, StoredTable

_ROOTS, _HALVINGS, _PIECES, _SAMPLES, _LOOKED_AT = 12, 18, 5_000, 13, 64


class Box(NamedTuple):
    """Ranges of height a (m), of b (m), or of the bearing (rad) in region `ARC`, and of phi (rad)."""

    region: int
    height: tuple[float, float]
    along: tuple[float, float]
    phi: tuple[float, float]

    def halves(self, table: StoredTable) -> tuple[Box, Box]:
        """Cut across the side along which R changes most."""
        middles = tuple((sum(part) / 2.0,) * 2 for part in self[1:])
        sides = [[*middles[:k], part, *middles[k + 1 :]] for k, part in enumerate(self[1:])]
        ranges = np.array(sides).reshape(3, 6).T
        least, most, _ = table.bounds(self.region, *ranges)
        side = int(np.argmax(most - least))
        name, (low, high), middle = self._fields[side + 1], self[side + 1], middles[side][0]
        return self._replace(**{name: (low, middle)}), self._replace(**{name: (middle, high)})


class Verdict(NamedTuple):
    """Whether a box is `verified`; else by how much the best bound is short (m), and whether its centre, or
    that of a part, is `refuted`: none of the velocities tried keeps the set from there. `dip` (m): how much
    nearer than l or d pursuer or obstacle may be within the period. `parts` of the box looked at."""

    verified: bool
    shortfall: float
    refuted: bool
    dip: float
    parts: int


class _Start(NamedTuple):
    """States z in `centre` + s `first` + t `second`, |s|, |t| <= 1, and up to `rest` (m) off; R is at least
    `least` (m); phi within `spread` (rad) of `phi`."""

    centre: Any
    first: Any
    second: Any
    rest: float
    least: float
    phi: float
    spread: float


def _unit(angle: Any) -> Any:
    return np.stack([np.cos(angle), np.sin(angle)], -1)


def _start(table: StoredTable, box: Box) -> _Start:
    (low, high), (first, last), (least, most) = box[1:]
    height, along, up, side = (low + high) / 2.0, (first + last) / 2.0, (high - low) / 2.0, (last - first) / 2.0
    level, ends = table.level, [np.array([end]) for part in box[1:] for end in part]
    clearance = float(table.bounds(box.region, *ends)[0][0])
    phi, spread = (least + most) / 2.0, (most - least) / 2.0
    if box.region == ARC:
        out, across = _unit(along), _unit(along + math.pi / 2.0)
        rest = (level + high) * side**2 / 2.0 + up * side
        return _Start((level + height) * out, up * out, (level + height) * side * across, rest, clearance, phi, spread)
    left, right = 0.5 / math.cos(table.angle), 0.5 / math.sin(table.angle)
    centre = np.array([left * (height + along + 2.0 * level), right * (height - along)])
    return _Start(centre, up * np.array([left, right]), side * np.array([left, -right]), 0.0, clearance, phi, spread)


class Checker:
    """Checks boxes of a table against an obstacle of up to `drift` m/s."""

    def __init__(self, table: StoredTable, drift: float, headings: int = 96, tried: int = 4):
        self.table, self.tried, self.r = table, tried, drift * table.period
        angle = 2.0 * math.pi * np.arange(headings) / headings
        normals = np.array([table.angle, math.pi - table.angle])
        full = table.evader * table.period * _unit(np.concatenate([angle, normals, -normals]))
        stop = np.zeros((int(bool(table.game["can_stop"])), 2))
        self.moves = np.concatenate([full, full / 2.0 if len(stop) else stop, stop])
        self.reach = table.speed * table.period
        ends = self.reach * np.linspace(-1.0, 1.0, _SAMPLES)
        self.samples = np.stack(np.meshgrid(ends, ends, [-0.9, -0.5, 0.0, 0.5, 0.9], indexing="ij"), -1).reshape(-1, 3)
        self.few = self.samples[(np.abs(self.samples[:, :2]).max(1) == self.reach) & (self.samples[:, 2] == 0.0)]

    def check(self, box: Box, depth: int = 9, most: int = 60) -> Verdict:
        """Checks a box, halved up to `depth` times where no velocity serves all of it, in at most `most`
        parts."""
        parts, dip, left = 0, 0.0, [(box, 0)]
        while left:
            part, halvings = left.pop()
            parts += 1
            start = _start(self.table, part)
            sampled = self._sampled(start, self.moves, self.few)
            order = np.argsort(-sampled)[: 3 * self.tried]
            sampled[order] = self._sampled(start, self.moves[order], self.samples)
            order = np.argsort(-sampled)[: self.tried]
            if sampled[order[0]] < 0.0:
                return Verdict(False, -float(sampled[order[0]]), True, dip, parts)
            best = -math.inf
            for move in self.moves[order]:
                margin = self._margin(start, move)
                if margin >= 0.0:
                    dip = max(dip, self._dip(start, move))
                    break
                best = max(best, margin)
            else:
                if halvings >= depth or parts + len(left) >= most:
                    return Verdict(False, -best, False, dip, parts)
                left += [(half, halvings + 1) for half in part.halves(self.table)]
        return Verdict(True, 0.0, False, dip, parts)

    def _sampled(self, start: _Start, moves: Any, motions: Any) -> Any:
        """What each velocity leaves (m) at the centre, after some motions of pursuer and obstacle."""
        x, theta = motions[:, :2].sum(1) / 2.0, (motions[:, 0] - motions[:, 1]) / (2.0 * self.table.axle)
        _, clearance = self.table.lookup(start.centre[None], np.array([start.phi]))
        moved = start.centre + moves[:, None] - x[:, None] * _unit(theta / 2.0)
        seen = np.stack([np.sum(moved * _unit(theta + turn), -1) for turn in (0.0, math.pi / 2.0)], -1)
        offset = clearance[0] * _unit(start.phi) + moves
        far = np.hypot(*offset.T)[:, None]
        off = motions[:, 2] * np.arcsin(self.r / far)
        phi = np.arctan2(offset[:, 1], offset[:, 0])[:, None] + off - theta
        height, needed = self.table.lookup(seen.reshape(-1, 2), phi.ravel())
        return np.min(np.minimum(height, self._near(far, off).ravel() - needed).reshape(phi.shape), 1)

    def _near(self, far: Any, off: Any) -> Any:
        """How far (m) the obstacle is at least, in a direction `off` (rad) its first, `far` (m) away."""
        return far * np.cos(off) - np.sqrt(np.maximum(self.r**2 - (far * np.sin(off)) ** 2, 0.0))

    def _margin(self, start: _Start, move: Any) -> float:
        """A lower bound (m) of what a velocity leaves for h' and |p'| - R; at least 0 where it serves."""
        offset = start.least * _unit(start.phi) + move
        far, speed = math.hypot(*offset), math.hypot(*move)
        nearest = far - speed * start.spread * start.least / (start.least - speed)
        towards = math.atan2(offset[1], offset[0])
        spread = start.spread * start.least / (start.least - speed)
        widest = math.asin(self.r / nearest)
        sine = (speed + self.r) / (start.least - speed - self.r)
        slope = math.sqrt(1.0 - sine**2) * (start.least - speed - self.r) / sine if sine > 0.0 else math.inf
        scale = np.array([1.0, 1.0, max(widest * nearest, 1e-12)])
        half = np.array([self.reach, self.reach, 1.0]) / [_ROOTS, _ROOTS, 2]
        axes = [size * (2.0 * np.arange(n) + 1.0) - n * size for size, n in zip(half, (_ROOTS, _ROOTS, 2), strict=True)]
        pieces = np.stack(np.meshgrid(*axes, indexing="ij"), -1).reshape(-1, 3)
        for halving in range(_HALVINGS + 1):
            margin = self._bound(start, move, pieces, half, nearest, towards, spread, widest, slope)
            open_ = ~(margin >= 0.0)
            if not open_.any():
                return 0.0
            pieces, margin = pieces[open_], margin[open_]
            worst = np.argsort(np.where(np.isnan(margin), -1.0, margin))[:_LOOKED_AT]
            real = float(np.min(self._sampled(start, move[None], pieces[worst])))
            if real < 0.0 or halving == _HALVINGS or len(pieces) > _PIECES:
                return min(real, -1e-9) if real < 0 else float(np.min(np.where(np.isnan(margin), -math.inf, margin)))
            side = int(np.argmax(half * scale))
            half[side] /= 2.0
            step = half * (np.arange(3) == side)
            pieces = np.concatenate([pieces - step, pieces + step])
        raise AssertionError

    def _bound(self, start, move, pieces, half, nearest, towards, spread, widest, slope) -> Any:
        """Lower bounds (m) of the margin over pieces (n, 3): x + b theta, x - b theta, and the obstacle's
        direction as a share of the `widest`; NaN where one is too large to tell."""
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
            n = _unit(turn)
            rate = _unit(turn + math.pi / 2.0) @ v + x[mine] / 2.0 * np.sin(half_turn)
            far = [np.abs(-np.cos(half_turn) + sign * rate / axle) / 2.0 * half[one] for one, sign in ((0, 1), (1, -1))]
            far += [(np.abs(np.sin(half_turn)) + dtheta / 2.0) * across[mine]]
            far += [np.abs(n @ g) + math.hypot(*g) * dtheta for g in (start.first, start.second)]
            return n @ v - x[mine] * np.cos(half_turn), sum(far) + bend + start.rest

        (ahead, ahead_far), (left, left_far) = along(0.0), along(math.pi / 2.0)
        bearing = np.arctan2(left, ahead)
        normal = np.copysign(np.clip(np.abs(bearing), table.angle, math.pi - table.angle), bearing)
        value, far = along(normal)
        margin = value - far - table.level
        off = np.maximum(np.abs(pieces[:, 2]) - half[2], 0.0) * widest
        near = self._near(nearest, off)
        direction, wide = towards + pieces[:, 2] * widest - theta, spread + half[2] * widest + dtheta
        for one, other in ((1, 1), (1, -1), (-1, 1), (-1, -1)):
            here = (one * ahead + ahead_far >= 0.0) & (other * left + left_far >= 0.0)
            if not here.any():
                continue
            phi = (direction if one == other else -direction) + math.pi * (one < 0)
            self._need(margin, near, slope, along, here, one, other, phi, wide, bearing)
        return margin

    def _need(self, margin, near, slope, along, here, one, other, phi, wide, bearing) -> None:
        """Lowers `margin` in place to |p'| - R where pieces are in a quadrant of z'."""
        table, mine = self.table, np.flatnonzero(here)
        cosine, sine = one * math.cos(table.angle), other * math.sin(table.angle)
        a, a_far = along(math.atan2(sine, cosine), mine)
        b, b_far = along(math.atan2(-sine, cosine), mine)
        k, k_far = along(math.atan2(other * math.cos(table.angle), -one * math.sin(table.angle)), mine)
        a, b = a - table.level, b - table.level
        beta = bearing[mine]
        out, out_far = along(beta, mine)
        _, side_far = along(beta + math.pi / 2.0, mine)
        swing = side_far / np.maximum(out - out_far, 1e-9)
        beta = np.arctan2(other * np.sin(beta), one * np.cos(beta))
        top = np.hypot(out + out_far, side_far)
        for region, low, high, first, last, some in (
            (OPEN, a - a_far, a + a_far, np.maximum(b - b_far, 0.0), b + b_far, (k < k_far) & (b + b_far >= 0.0)),
            (COMMITTED, a - a_far, a + a_far, b - b_far, np.minimum(b + b_far, 0.0), (k < k_far) & (b < b_far)),
            (ARC, out - out_far - table.level, top - table.level, beta - swing, beta + swing, k + k_far >= 0.0),
        ):
            if some.any():
                least, most = phi[mine] - wide, phi[mine] + wide
                ranges = [part[some] for part in (low, high, first, last, least, most)]
                _, needed, steep = table.bounds(region, *ranges)
                spare = np.where(steep < slope, near[mine[some]] - needed, np.nan)
                margin[mine[some]] = np.minimum(margin[mine[some]], spare)

    def _dip(self, start: _Start, move: Any) -> float:
        """How much nearer (m) than l or d the robots may be within the period; convexity does it.

        Along any unit vector n the pursuer comes at most A(s) in a time s/V, and A is convex: it is s C, C the
        cosine to n, or more where turning to n pays. So n.(z + u t) - A(V t) is least at an end of the period,
        and for any n it bounds the distance. The obstacle: |p + u t| - v_c t is least where its rate is 0.
        """
        table = self.table
        angle = math.atan2(start.centre[1], start.centre[0]) + np.linspace(-1.2, 1.2, 481)
        angle = np.append(angle, [table.angle, -table.angle])
        n, cosine, sine = _unit(angle), np.abs(np.cos(angle)), np.abs(np.sin(angle))
        turned = (sine * self.reach + table.axle * cosine) ** 2 / (4.0 * table.axle * np.maximum(sine, 1e-9))
        comes = np.where(sine * self.reach > table.axle * cosine, turned, self.reach * cosine)
        begun = n @ start.centre - np.abs(n @ start.first) - np.abs(n @ start.second) - start.rest
        pursuer = table.level - float(np.max(np.minimum(begun, begun + n @ move - comes)))
        p, long = start.least * _unit(start.phi), math.hypot(*move)
        if long <= self.r:
            return max(pursuer, table.game["collision_distance"] - start.least + long + self.r, 0.0)
        aside, before = abs(p[0] * move[1] - p[1] * move[0]) / long, p @ move / long
        rate = self.r / long
        place = float(np.clip(rate * aside / math.sqrt(1.0 - rate**2), before, before + long))
        least = math.hypot(aside, place) - rate * (place - before) - long * start.spread
        return max(pursuer, table.game["collision_distance"] - least, 0.0)
