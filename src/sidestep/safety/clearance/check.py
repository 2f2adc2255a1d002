"""A second opinion on a clearance table: does some velocity keep its set from every state of a box?

It shares no code with the solver and reads only the table's file (see `stored`). A box is a range of z times
one of the direction phi of p, with every |p| >= R(z, phi). One held velocity u must serve all of it: after a
period, wherever the pursuer and the obstacle are, h' >= 0 and |p'| >= R(z', phi'). `worst_case` has the
bounds. Where none of the velocities tried serves, the box is halved.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from sidestep.safety.clearance.stored import ARC, StoredTable
from sidestep.safety.clearance.worst_case import Start, WorstCase, unit

_SAMPLES, _DIRECTIONS = 13, (-0.9, -0.5, 0.0, 0.5, 0.9)


class Box(NamedTuple):
    """States between both ends of each range, z in the first quadrant: height a (m), b (m) or in region `ARC`
    the bearing (rad), and phi (rad). Not across a = 0, b = 0 or the region's edge."""

    region: int
    height: tuple[float, float]
    along: tuple[float, float]
    phi: tuple[float, float]

    def halves(self, table: StoredTable) -> tuple[Box, Box]:
        """Cut across the side along which R changes most."""
        whole = self.height, self.along, self.phi
        middles = tuple((sum(part) / 2.0,) * 2 for part in whole)
        sides = [[*middles[:k], part, *middles[k + 1 :]] for k, part in enumerate(whole)]
        least, most, _ = table.bounds(self.region, *np.array(sides).reshape(3, 6).T)
        side = int(np.argmax(most - least))
        name, (low, high), middle = self._fields[side + 1], whole[side], middles[side][0]
        return self._replace(**{name: (low, middle)}), self._replace(**{name: (middle, high)})

    def start(self, table: StoredTable) -> Start:
        """Its states as `worst_case` takes them."""
        (low, high), (first, last), (least, most) = self[1:]
        height, along = (low + high) / 2.0, (first + last) / 2.0
        up, side = (high - low) / 2.0, (last - first) / 2.0
        ends = [np.array([end]) for part in self[1:] for end in part]
        directions = float(table.bounds(self.region, *ends)[0][0]), (least + most) / 2.0, (most - least) / 2.0
        if self.region == ARC:
            out, across, distance = unit(along), unit(along + math.pi / 2.0), table.level + height
            rest = (distance + up) * side**2 / 2.0 + up * side
            return Start(distance * out, up * out, distance * side * across, rest, *directions)
        ahead, left = 0.5 / math.cos(table.angle), 0.5 / math.sin(table.angle)
        centre = np.array([ahead * (height + along + 2.0 * table.level), left * (height - along)])
        sides = up * np.array([ahead, left]), side * np.array([ahead, -left])
        return Start(centre, *sides, 0.0, *directions)


class Verdict(NamedTuple):
    """Whether a box is `verified`; else by how much the best bound is short (m), and whether the centre of a
    part is `refuted`: none of the velocities tried keeps the set from there. `dip` (m): how much nearer than
    l or d pursuer or obstacle may be within the period. `parts` of the box looked at."""

    verified: bool
    shortfall: float
    refuted: bool
    dip: float
    parts: int


class Checker:
    """Checks boxes of a table against an obstacle of up to `drift` m/s.

    It tries the `tried` best of `headings` headings at full speed, of half of them at half speed, of the
    tip's normals and of a stop.
    """

    def __init__(self, table: StoredTable, drift: float, headings: int = 128, tried: int = 4):
        self.table, self.worst, self.tried = table, WorstCase(table, drift), tried
        angle = 2.0 * math.pi * np.arange(headings) / headings
        normals = np.array([table.angle, math.pi - table.angle])
        full = table.evader * table.period * unit(np.concatenate([angle, normals, -normals]))
        slower = np.concatenate([full[::2] / 2.0, np.zeros((1, 2))])
        self.moves = np.concatenate([full, slower]) if table.game["can_stop"] else full
        ends = self.worst.reach * np.linspace(-1.0, 1.0, _SAMPLES)
        self.samples = np.stack(np.meshgrid(ends, ends, _DIRECTIONS, indexing="ij"), -1).reshape(-1, 3)
        edge = np.abs(self.samples[:, :2]).max(1) == self.worst.reach
        self.few = self.samples[edge & (self.samples[:, 2] == 0.0)]

    def move(self, box: Box) -> tuple[Float[np.ndarray, "2"] | None, float, bool]:
        """A u T (m) that serves all of a box, or None; by how much the best is short (m); and whether from
        the centre each one falls out of the set."""
        start = box.start(self.table)
        sampled = self.worst.sampled(start, self.moves, self.few)
        better = np.argsort(-sampled)[: 3 * self.tried]
        sampled[better] = self.worst.sampled(start, self.moves[better], self.samples)
        if np.max(sampled) < 0.0:
            return None, -float(np.max(sampled)), True
        best = -math.inf
        for move in self.moves[np.argsort(-sampled)[: self.tried]]:
            margin = self.worst.margin(start, move)
            if margin >= 0.0:
                return move, 0.0, False
            best = max(best, margin)
        return None, -best, False

    def check(self, box: Box, depth: int = 9, most: int = 60) -> Verdict:
        """Checks a box, halved up to `depth` times where no velocity serves all of it, in at most `most`
        parts."""
        parts, dip, left = 0, 0.0, [(box, 0)]
        while left:
            part, halvings = left.pop()
            parts += 1
            move, shortfall, refuted = self.move(part)
            if move is not None:
                dip = max(dip, self.worst.dip(part.start(self.table), move))
            elif refuted or halvings >= depth or parts + len(left) >= most:
                return Verdict(False, shortfall, refuted, dip, parts)
            else:
                left += [(half, halvings + 1) for half in part.halves(self.table)]
        return Verdict(True, 0.0, False, dip, parts)
