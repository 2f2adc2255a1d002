"""One sweep of the fixed point over the nodes of a clearance table, compiled by Numba.

A period has two halves. After the evader's move, z and the offset p given, the obstacle must be as far away
as the table says whatever the pursuer and the obstacle do. The pursuer's motions w ask for

    max over w of R(z_w, phi_w),   phi the direction of p,

and the obstacle, which drifts by up to v_c T in any direction, for so much more that p is outside that shape
grown by v_c T, and then by what is to spare: R'(z, phi). Before that, among the velocities u that keep the
pursuit barrier, one must lead to where R' is kept: the obstacle must be at least rho away, the root along the
ray phi of

    |rho e_phi + u T| = R'(z + u T, direction of rho e_phi + u T).

A node's new clearance R is the least such rho, or the old one if that is larger.

Beside a straight wall p = q n, with n its normal and q the evader's distance to it. Only n.u changes q, and
only the pursuer's turns change n: rho = R'(z + u T, direction of n) - n.u T.
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
def _cell_from(angles, node, past):
    """The same for the angle `past` (rad, of any sign) that of a node."""
    count = len(angles)
    width = (angles[node + 1] if node + 1 < count else math.pi) - angles[node]
    while past >= width:
        past -= width
        node = node + 1 if node + 1 < count else 0
        width = (angles[node + 1] if node + 1 < count else math.pi) - angles[node]
    while past < 0.0:
        node = node - 1 if node > 0 else count - 1
        width = (angles[node + 1] if node + 1 < count else math.pi) - angles[node]
        past += width
    return node, past, width


@njit(cache=True, fastmath=True)
@no_type_check
def _mixed(table, low, strides, up, along, row):
    """The table's row between the four nodes of a cell, and its first entry once more."""
    count, one = table.shape[1], np.float32(1.0)
    high = low + (strides[0] if low < strides[2] else strides[1])
    a, b = (one - up) * (one - along), (one - up) * along
    c, d = up * (one - along), up * along
    for k in range(count):
        lower = a * table[low, k] + b * table[low + 1, k]
        row[k] = lower + c * table[high, k] + d * table[high + 1, k]
    row[count] = row[0]


@njit(cache=True, fastmath=True)
@no_type_check
def _rotated(row, angles, sign, start, least):
    """Raise `least` to what `row` is at the angles start + sign (angles - angles[0])."""
    count = len(angles)
    node, past, width = _cell(angles, start)
    for k in range(count):
        if k > 0:
            past += sign * (angles[k] - angles[k - 1])
        node, past, width = _cell_from(angles, node, past)
        value = row[node] + np.float32(past / width) * (row[node + 1] - row[node])
        least[k] = max(least[k], value)


_PARTS = 6
"""Directions to each side in which a row is asked to grow it."""


@njit(cache=True, fastmath=True)
@no_type_check
def _grown(row, angles, drift, spare, grown):
    """The row of the shape |p| < row, grown by `drift` (m) in every direction and by `spare` outwards."""
    count = len(angles)
    for k in range(count):
        best = row[k] + drift
        # What grows into direction k lies at most so far aside, rad; to first order in it.
        step = drift / (row[k] * _PARTS)
        for way in (-1, 1):
            node, past = k, 0.0
            for _ in range(_PARTS):
                node, past, width = _cell_from(angles, node, past + way * step)
                radius = row[node] + past / width * (row[node + 1 if node + 1 < count else 0] - row[node])
                turn = angles[node] + past - angles[k]
                turn -= 2.0 * math.pi * math.floor((turn + math.pi) / (2.0 * math.pi))
                aside = radius * turn
                if abs(aside) < drift:
                    best = max(
                        best, radius * (1.0 - 0.5 * turn * turn) + math.sqrt(drift * drift - aside * aside)
                    )
        grown[k] = best + spare


@njit(cache=True, parallel=True, fastmath=True)
@no_type_check
def pursuer_moves(table, nodes, place, strides, share, turned, angles, ridge, drift, spare):
    """R' in rows for `nodes`, (n, angles).

    **Arguments:** `table` (nodes, angles) R, m; for every one of `nodes` and motion `place` (n, motions) the
    first node of the cell it leads to, `share` (n, motions, 2) its weights upwards and along, and `turned`
    (n, motions, 2) the sign of phi there and its offset, less the ridge's angle; `strides`, upwards, in the
    open region and the other, and the first node of that; `angles` of a row, rad; `ridge` of every node, rad;
    `drift` v_c T and what is to `spare`, m.
    """
    count = len(angles)
    result = np.zeros((len(nodes), count), np.float32)
    for i in prange(len(nodes)):
        needed = np.zeros(count, np.float32)
        row = np.empty(count + 1, np.float32)
        first = angles[0] + ridge[nodes[i]]
        for motion in range(place.shape[1]):
            up, along = share[i, motion]
            _mixed(table, place[i, motion], strides, up, along, row)
            sign = turned[i, motion, 0]
            _rotated(row, angles, sign, sign * first + turned[i, motion, 1], needed)
        _grown(needed, angles, drift, spare, result[i])
    return result


@njit(cache=True, fastmath=True)
@no_type_check
def _root(needed, angles, sign, offset, direction, ahead, aside, most):
    """The largest root rho, at most `most`."""
    distance = most
    # From above, so that the largest root is found; `aside` is small beside the distance.
    for _ in range(6):
        turned = sign * (direction + math.atan2(aside, distance + ahead)) + offset
        node, past, width = _cell(angles, turned)
        wanted = needed[node] + past / width * (needed[node + 1] - needed[node])
        if wanted >= most:
            return most
        distance = math.sqrt(max(wanted * wanted - aside * aside, 0.0)) - ahead
    return distance


@njit(cache=True, parallel=True, fastmath=True)
@no_type_check
def evader_moves(
    table,
    after,
    nodes,
    spans,
    control,
    place,
    strides,
    share,
    turned,
    angles,
    ridge,
    moves,
    straight,
    most,
    choice,
):
    """New rows of R for `nodes`, (n, angles).

    **Arguments:** `after` (nodes, angles) R', m; pairs `spans[i, 0]` to `spans[i, 1]` are the velocities
    `control` that node `nodes[i]` may choose, `moves` (controls, 2) m each in one period; `place`, `share`
    and `turned` as for `pursuer_moves`, for every pair where R' has it; whether the obstacle is a
    `straight` wall; `most`, m, stands for every larger clearance; `choice` (nodes, angles), changed in
    place, the pair last found best.
    """
    count = len(angles)
    result = np.empty((len(nodes), count), np.float32)
    for i in prange(len(nodes)):
        begin, pairs = spans[i, 0], spans[i, 1] - spans[i, 0]
        rows = np.empty((pairs, count + 1), np.float32)
        known = np.zeros(pairs, np.bool_)
        for k in range(count):
            old = table[nodes[i], k]
            direction = angles[k] + ridge[nodes[i]]
            cosine, sine = math.cos(direction), math.sin(direction)
            best, chosen = most, choice[nodes[i], k]
            # The one last found best comes first: mostly it will do still.
            for turn in range(pairs):
                one = turn if turn != 0 else chosen
                if turn == chosen and turn != 0:
                    one = 0
                pair = begin + one
                if not known[one]:
                    _mixed(after, place[pair], strides, share[pair, 0], share[pair, 1], rows[one])
                    known[one] = True
                x, y = moves[control[pair], 0], moves[control[pair], 1]
                ahead, aside = cosine * x + sine * y, 0.0 if straight else cosine * y - sine * x
                root = _root(
                    rows[one], angles, turned[pair, 0], turned[pair, 1], direction, ahead, aside, most
                )
                if root < best:
                    best, choice[nodes[i], k] = root, one
                if best <= old:
                    break
            result[i, k] = max(np.float32(best), old)
    return result
