"""One sweep of the fixed point over the nodes of a clearance table, compiled by Numba.

For a node (z, phi) and a velocity u that keeps the pursuit barrier whatever the pursuer does in a period, the
obstacle must be at least rho away, the root along the ray phi of

    |rho e_phi + u T| - v_c T = max over motions w of R(z_w, direction of (rho e_phi + u T) seen from there),

and the node's new clearance is the least rho over all such u, or the old one if that is larger.
"""

from __future__ import annotations

import math
from typing import no_type_check

import numpy as np
from numba import njit, prange


@njit(cache=True)
@no_type_check
def _cell(angles, angle):
    """Node at or below an angle, the angle within a turn of it, and the cell's width."""
    angle = angle - 2.0 * math.pi * math.floor((angle + math.pi) / (2.0 * math.pi))
    node = max(np.searchsorted(angles, angle, side="right") - 1, 0)
    end = angles[node + 1] if node + 1 < len(angles) else math.pi
    return node, angle - angles[node], end - angles[node]


@njit(cache=True, fastmath=True)
@no_type_check
def _rotated(row, angles, sign, start, least):
    """Raise `least` to what `row` is at the angles start + sign (angles - angles[0])."""
    count = len(angles)
    node, past, width = _cell(angles, start)
    for k in range(count):
        if k > 0:
            past += sign * (angles[k] - angles[k - 1])
        while past >= width:
            past -= width
            node = node + 1 if node + 1 < count else 0
            width = (angles[node + 1] if node + 1 < count else math.pi) - angles[node]
        while past < 0.0:
            node = node - 1 if node > 0 else count - 1
            width = (angles[node + 1] if node + 1 < count else math.pi) - angles[node]
            past += width
        value = row[node] + np.float32(past / width) * (row[node + 1] - row[node])
        least[k] = max(least[k], value)


@njit(cache=True, parallel=True, fastmath=True)
@no_type_check
def sweep(table, nodes, spans, control, place, strides, share, turned, angles, ridge, moves, drift, most):
    """New rows for `nodes`, (n, angles).

    **Arguments:** `table` (nodes, angles) m; pairs `spans[i, 0]` to `spans[i, 1]` are the velocities
    `control` that node `nodes[i]` may choose, `moves` (controls, 2) m each in one period; for every pair and
    motion `place` (pairs, motions) the first node of the cell it leads to, `share` (pairs, motions, 2) its
    weights upwards and along, and `turned` (pairs, motions, 2) the sign of phi there and its offset, less the
    ridge's angle; `strides`, upwards, in the open region and the other, and the first node of that;
    `angles` of a row, rad; `ridge` of every node, rad; `drift` v_c T, m; `most`, m, stands for every larger
    clearance.
    """
    count, one = len(angles), np.float32(1.0)
    result = np.empty((len(nodes), count), np.float32)
    for i in prange(len(nodes)):
        old = table[nodes[i]]
        best = np.full(count, most, np.float32)
        row = np.empty(count + 1, np.float32)
        needed = np.empty(count + 1, np.float32)
        direction = angles + ridge[nodes[i]]
        cosine, sine = np.cos(direction), np.sin(direction)
        for pair in range(spans[i, 0], spans[i, 1]):
            needed[:] = 0.0
            for motion in range(place.shape[1]):
                low = place[pair, motion]
                high = low + (strides[0] if low < strides[2] else strides[1])
                up, along = share[pair, motion]
                a, b = (one - up) * (one - along), (one - up) * along
                c, d = up * (one - along), up * along
                for k in range(count):
                    lower = a * table[low, k] + b * table[low + 1, k]
                    row[k] = lower + c * table[high, k] + d * table[high + 1, k]
                row[count] = row[0]
                sign = turned[pair, motion, 0]
                _rotated(row, angles, sign, sign * direction[0] + turned[pair, motion, 1], needed)
            needed[count] = needed[0]
            x, y = moves[control[pair], 0], moves[control[pair], 1]
            for k in range(count):
                if best[k] <= old[k]:
                    continue
                ahead = cosine[k] * x + sine[k] * y
                aside = cosine[k] * y - sine[k] * x
                distance = best[k]
                # From above, so that the largest root is found; `aside` is small beside the distance.
                for _ in range(5):
                    node, past, width = _cell(angles, angles[k] + math.atan2(aside, distance + ahead))
                    wanted = needed[node] + past / width * (needed[node + 1] - needed[node]) + drift
                    if wanted >= most:
                        distance = most
                        break
                    distance = math.sqrt(max(wanted * wanted - aside * aside, 0.0)) - ahead
                best[k] = min(best[k], np.float32(distance))
        for k in range(count):
            result[i, k] = max(best[k], old[k])
    return result
