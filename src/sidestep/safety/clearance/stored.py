"""A clearance table as its file has it, and bounds of R over boxes, for `check`.

Written from the table's definition (see `grid`), without the solver's code. On a grid cell, at one angle
from the ridge, R is bilinear. So its largest and least values over a part of some cells are each at a corner
of the part in one of the cells, and at an end of the range of angles or at a node between.
"""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np

from sidestep.store.checkpoints import read_named

OPEN, COMMITTED, ARC = range(3)
"""Regions: b >= 0; b < 0; beside the tip, where the bearing takes the place of b."""
_STEP, _FORMAT = 2e-5, 3


def _index(spacing: Any, value: Any) -> Any:
    """Number of the node at a value, linear between nodes, for nodes first (g^i - 1)/(g - 1)."""
    first, growth, count = spacing
    value = np.maximum(value, 0.0)
    cell = np.clip(np.floor(np.log1p(value * (growth - 1.0) / first) / math.log(growth)), 0, count - 2)
    low = first * (growth**cell - 1.0) / (growth - 1.0)
    return cell + np.clip((value - low) / (first * growth**cell), 0.0, 1.0)


def _hats(at: Any, low: Any, nodes: Any) -> Any:
    """Weights of the nodes low, low + 1 ... at some numbers, (n, numbers, nodes)."""
    return np.maximum(0.0, 1.0 - np.abs(at[:, :, None] - low[:, None, None] - nodes))


class StoredTable:
    """A table as its file has it. **Raises** `CheckpointError` (damaged) or `ValueError` (no such table)."""

    def __init__(self, path: str | Path):
        arrays, about = read_named(Path(path))
        try:
            if about["format"] != _FORMAT:
                raise ValueError(f"format {about['format']}, not {_FORMAT}")
            self.level, self.angle, self.heights, self.shares, self.bearings, self.gap, _ = about["grid"]
            (self.scale, self.count), self.game = about["directions"], dict(about["game"])
            self.rows = _STEP * arrays["['clearance']"].astype(float)
            self.ridge = arrays["['ridge']"].astype(float)
            self.width = self.shares[2] + self.bearings
            shape = (self.heights[2] * (self.heights[2] + self.width), self.count)
            if self.game.get("wall"):
                raise ValueError("it is of a wall; `check` has no bounds for one")
            if about.get("periods") is not None:
                raise ValueError("it is for some periods; `check` proves tables for ever")
            if self.rows.shape != shape or self.ridge.shape != shape[:1]:
                raise ValueError(f"{self.rows.shape} clearances, not {shape}")
            least = self.game["collision_distance"] - 1e-6
            if not (np.all(np.isfinite(self.ridge)) and np.min(self.rows) >= least):
                raise ValueError("a clearance is less than the collision distance")
        except (KeyError, TypeError) as error:
            raise ValueError(f"{path} is no clearance table: {error!r}") from None
        self.speed, self.axle = self.game["pursuer_speed"], self.game["half_axle"]
        self.period, self.evader = self.game["control_period"], self.game["evader_speed"]
        self.rate = 2.0 * math.asinh(math.pi / self.scale) / self.count
        self.nodes = nodes = self.scale * np.sinh(self.rate * (np.arange(self.count + 1) - self.count / 2))
        rises = np.diff(self.rows, axis=1, append=self.rows[:, :1])
        self.slopes = np.max(np.abs(rises) / np.diff(nodes), 1)

    def _turn(self, angle: Any) -> Any:
        """Number of the node at an angle, linear between nodes, unwrapped."""
        turns = np.floor((angle + math.pi) / (2.0 * math.pi))
        angle = angle - 2.0 * math.pi * turns
        node = np.clip(np.searchsorted(self.nodes, angle, side="right") - 1, 0, self.count - 1)
        low = self.nodes[node]
        return self.count * turns + node + np.clip((angle - low) / (self.nodes[node + 1] - low), 0.0, 1.0)

    def _places(self, region: int, height: Any, along: Any) -> tuple[Any, Any]:
        """Numbers of the nodes upwards and along, linear between nodes."""
        if region == OPEN:
            return _index(self.heights, height), _index(self.heights, along)
        if region == COMMITTED:
            distance = self.level + np.maximum(height, 0.0)
            length = self.level - distance * math.cos(2.0 * self.angle) - self.gap
            return _index(self.heights, height), _index(self.shares, (-self.gap - along) / length)
        bearing = (along - self.angle) / (math.pi / 2.0 - self.angle) * self.bearings
        return _index(self.heights, height), self.shares[2] - 1 + np.clip(bearing, 0.0, self.bearings)

    def lookup(self, z: Any, phi: Any) -> tuple[Any, Any]:
        """h' and R (m) at states z (n, 2) m and directions phi (n,) rad."""
        x, y = np.abs(z[:, 0]), np.abs(z[:, 1])
        behind, right = z[:, 0] < 0.0, z[:, 1] < 0.0
        phi = np.where(behind == right, phi, -phi) + math.pi * behind
        cosine, sine = math.cos(self.angle), math.sin(self.angle)
        arc, other = y * cosine >= x * sine, x * cosine - y * sine - self.level
        height = np.where(arc, np.hypot(x, y), x * cosine + y * sine) - self.level
        clearance = np.empty(len(z))
        for region, mine in enumerate((~arc & (other >= 0.0), ~arc & (other < 0.0), arc)):
            if mine.any():
                along = np.arctan2(y, x)[mine] if region == ARC else other[mine]
                up, side = self._places(region, height[mine], along)
                values, _ = self._values(region, up[:, None], side[:, None], phi[mine], phi[mine], 2)
                clearance[mine] = values[:, 0]
        return height, clearance

    def bounds(
        self, region: int, low: Any, high: Any, first: Any, last: Any, least: Any, most: Any
    ) -> tuple[Any, Any, Any]:
        """R (m) at least and at most, and its largest slope in phi (m/rad) in all of these rows, over heights
        `low` to `high`, b or bearings `first` to `last` and directions `least` to `most`, (n,) each, in one
        region; NaN where that is over too many nodes."""
        corners = self._places(region, low, last if region == COMMITTED else first)
        opposite = self._places(region, high, first if region == COMMITTED else last)
        ends = [np.stack(pair, -1) for pair in zip(corners, opposite, strict=True)]
        between = [np.clip(np.floor(part[:, :1]) + 1.0, part[:, :1], part[:, 1:]) for part in ends]
        up, side = (np.concatenate(pair, 1) for pair in zip(ends, between, strict=True))
        values, steepness = self._values(region, up, side, least, most, 3)
        found = np.stack([np.min(values, 1), np.max(values, 1)])
        wide = np.flatnonzero(np.isnan(found[0]))
        if len(wide):  # Where the ridge is steep, over more angles.
            values, _ = self._values(region, up[wide], side[wide], least[wide], most[wide], 3, 12)
            found[:, wide] = np.min(values, 1), np.max(values, 1)
        return found[0], found[1], steepness

    def _values(
        self, region: int, up: Any, side: Any, least: Any, most: Any, count: int, many: int = 4
    ) -> tuple[Any, Any]:
        """R (m) at every pair of `up` and `side` (n, numbers), node numbers with the least first, and at the
        ends of the angles and nodes between; NaN over more than `count` nodes a side or `many` angles. And
        the largest slope in these rows, m/rad."""
        nodes, angles = np.arange(count), np.arange(many if count > 2 else 2)
        size = self.heights[2] if region == OPEN else self.width
        i = np.minimum(np.floor(up[:, 0]), self.heights[2] - count)
        j = np.minimum(np.floor(side[:, 0]), size - count)
        node = (i[:, None, None] + nodes[:, None]) * size + j[:, None, None] + nodes
        node = node.astype(int) + (0 if region == OPEN else self.heights[2] ** 2)
        rise, run = _hats(up, i, nodes), _hats(side, j, nodes)
        ridge = np.einsum("nai,nij,nbj->nab", rise, self.ridge[node], run, optimize=True).reshape(len(i), -1)
        turned = np.stack([self._turn(least - np.max(ridge, 1)), self._turn(most - np.min(ridge, 1))])
        k = np.floor(turned[0])
        inner = [np.clip(k + one, *turned) for one in angles[1:-1]]
        at = np.stack([*turned, *inner] if count > 2 else [turned[0]], -1)
        column = (k[:, None].astype(int) + angles) % self.count
        values = self.rows[node[..., None], column[:, None, None]]
        values = np.einsum("nai,nijk->najk", rise, values)
        values = np.einsum("nbj,najk->nabk", run, values)
        values = np.einsum("nck,nabk->nabc", _hats(at, k, angles), values).reshape(len(i), -1)
        fits = (up.max(1) <= i + count - 1) & (side.max(1) <= j + count - 1) & (turned[1] <= k + angles[-1])
        return np.where(fits[:, None], values, np.nan), np.max(self.slopes[node], (1, 2))
