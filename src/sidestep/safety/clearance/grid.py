"""Where the clearance table has its nodes, and where a state lies between them.

The state is z, the evader in the pursuer's frame, and phi, the direction in that frame in which the evader
lies from the obstacle. By mirroring and reversing the pursuer z lies in the first quadrant. There, with the
normals n_l, n_r = (cos S', +-sin S') of the capture set's tip,

    a = max(n_l.z, |z| beyond the usable part) - l       how far the evader is outside on its own side,
    b = n_r.z - l                                        how far it is outside on the other side,

and the table has two regions, between which nothing is interpolated:

- *open*, b >= 0: the evader may still choose the side; nodes on a grid of (a, b);
- *committed*, b < 0 or beyond the usable part: it must pass on its own side; nodes on a grid of a and of the
  way along the capture set's edge, first the straight part, by b, then the arc, by bearing.

So the capture set's edge a = 0 and the surface b = 0, across which clearance jumps, are grid lines. Clearance
has a sharp ridge in phi, where passing the obstacle on either side costs the same. Rows of the table are
aligned by it: phi counts from `ridge`, an angle per node, and the nodes in phi are densest there.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

Reals = Float[np.ndarray, "..."]


class Spacing(NamedTuple):
    """Nodes first (g^i - 1)/(g - 1), i < count: `first` apart at 0, growing by `growth` g > 1."""

    first: float
    growth: float
    count: int

    @staticmethod
    def up_to(last: float, first: float, growth: float) -> Spacing:
        """With the last node at `last`."""
        steps = math.ceil(math.log1p(last * (growth - 1.0) / first) / math.log(growth))
        return Spacing(last * (growth - 1.0) / (growth**steps - 1.0), growth, steps + 1)

    @property
    def nodes(self) -> Float[np.ndarray, "n"]:
        """Every node."""
        return self.first * (self.growth ** np.arange(self.count) - 1.0) / (self.growth - 1.0)

    def place(self, xp: Any, value: Any) -> tuple[Any, Any]:
        """Cell and weight of its upper node; beyond the ends the weight is 0 or 1."""
        logarithm = math.log(self.growth)
        index = xp.log1p(xp.maximum(value, 0.0) * ((self.growth - 1.0) / self.first)) / logarithm
        cell = xp.clip(xp.floor(index), 0, self.count - 2)
        # What is left of the index, and so of value = first (growth^index - 1)/(growth - 1).
        weight = _expm1((index - cell) * logarithm) / (self.growth - 1.0)
        return cell.astype(xp.int32), xp.clip(weight, 0.0, 1.0)


class Angles(NamedTuple):
    """Directions f sinh(k (i - count/2)) from -pi up: densest, f k apart, at 0; `count` is even."""

    scale: float
    count: int

    @property
    def rate(self) -> float:
        """k, 1."""
        return 2.0 * math.asinh(math.pi / self.scale) / self.count

    @property
    def nodes(self) -> Float[np.ndarray, "n"]:
        """Every node, rad."""
        return self.scale * np.sinh(self.rate * (np.arange(self.count) - self.count // 2))

    def place(self, xp: Any, angle: Any) -> tuple[Any, Any]:
        """Node at or below an angle, and the weight of the next one, which is the first after the last."""
        angle = angle - 2.0 * math.pi * xp.floor((angle + math.pi) / (2.0 * math.pi))
        part = angle / self.scale
        index = self.count // 2 + xp.arcsinh(part) / self.rate
        node = xp.clip(xp.floor(index), 0, self.count - 1)
        # Both nodes from the angle between them, by sinh(x - y) and sinh(x + y).
        even, below, above = xp.sqrt(1.0 + part * part), index - node, node + 1.0 - index
        low = part * _cosh(self.rate * below) - even * _sinh(self.rate * below)
        high = part * _cosh(self.rate * above) + even * _sinh(self.rate * above)
        return node.astype(xp.int32), xp.clip((part - low) / (high - low), 0.0, 1.0)


def _expm1(x: Any) -> Any:
    """e^x - 1 for 0 <= x <= 0.7, to 1e-6 of it. Like the next two quicker than a library's."""
    return x * (1 + x / 2 * (1 + x / 3 * (1 + x / 4 * (1 + x / 5 * (1 + x / 6 * (1 + x / 7))))))


def _sinh(x: Any) -> Any:
    """sinh x for |x| <= 0.6, to 1e-6 of it."""
    return x * (1 + x * x / 6 * (1 + x * x / 20 * (1 + x * x / 42)))


def _cosh(x: Any) -> Any:
    """cosh x for |x| <= 0.6, to 1e-6 of it."""
    return 1 + x * x / 2 * (1 + x * x / 12 * (1 + x * x / 30))


class Place(NamedTuple):
    """Where states z lie.

    `height` a (m), below 0 in the capture set; the cell's nodes are `node`, `node` + 1, and `stride` further
    on the same two, the weights of the upper ones `along` and `up`. A direction phi of the pursuer's frame is
    `sign` phi + `turns` pi in that of the table.
    """

    height: Any
    node: Any
    stride: Any
    up: Any
    along: Any
    sign: Any
    turns: Any

    @property
    def each(self) -> list[tuple[Any, Any]]:
        """Node and weight of each of the cell's corners."""
        up, along = self.up, self.along
        return [
            (self.node, (1.0 - up) * (1.0 - along)),
            (self.node + 1, (1.0 - up) * along),
            (self.node + self.stride, up * (1.0 - along)),
            (self.node + self.stride + 1, up * along),
        ]

    def corners(self, xp: Any) -> tuple[Any, Any]:
        """Nodes and weights of the cell's corners, (..., 4)."""
        nodes, weights = zip(*self.each, strict=True)
        return xp.stack(nodes, -1), xp.stack(weights, -1)


class Grid(NamedTuple):
    """The nodes of a table, in SI units.

    `capture_distance` l, `angle` S'; spacings of `heights` (a, and b in the open region), of `shares` of the
    straight part, from its end at b = 0 (0) to the arc (1); `bearings` cells on the arc; `gap`, how far below
    0 the committed region's first node has its b; `reach`, how far the pursuer drives in a period.
    """

    capture_distance: float
    angle: float
    heights: Spacing
    shares: Spacing
    bearings: int
    gap: float
    reach: float

    @property
    def committed(self) -> int:
        """Nodes of the committed region at each height."""
        return self.shares.count + self.bearings

    @property
    def first_committed(self) -> int:
        """Number of the first node of the committed region."""
        return self.heights.count**2

    @property
    def size(self) -> int:
        """Nodes in both regions."""
        return self.first_committed + self.heights.count * self.committed

    @property
    def points(self) -> Float[np.ndarray, "n 2"]:
        """z at every node, m."""
        cosine, sine = math.cos(self.angle), math.sin(self.angle)
        heights = self.heights.nodes
        left, right = np.meshgrid(heights, heights, indexing="ij")
        height, share = np.meshgrid(heights, self.shares.nodes, indexing="ij")
        other = -self.gap - share * self._straight(np, height)
        arc = np.linspace(self.angle, math.pi / 2.0, self.bearings + 1)[1:]
        distance, bearing = np.meshgrid(self.capture_distance + heights, arc, indexing="ij")

        def meeting(a: Reals, b: Reals) -> Reals:
            ahead = (a + b + 2.0 * self.capture_distance) / (2.0 * cosine)
            return np.stack([ahead, (a - b) / (2.0 * sine)], -1)

        round_ = np.stack([distance * np.cos(bearing), distance * np.sin(bearing)], -1)
        edge = np.concatenate([meeting(height, other), round_], 1)
        return np.concatenate([meeting(left, right).reshape(-1, 2), edge.reshape(-1, 2)])

    @property
    def _ahead(self) -> float:
        """Where on the axis (m) `nearer` begins to move states by all of `reach`."""
        return 0.9 * self.capture_distance * math.cos(self.angle)

    def nearer(self, xp: Any, ahead: Any) -> Any:
        """`ahead` (m) after the pursuer has driven for a period, at either end; less close beside it, so that
        no two states meet. The pursuer's best against the capture set's tip is to drive, so this moves the
        surface at which it can take a side from the evader onto b = 0."""
        return ahead - self.reach * xp.clip(ahead / self._ahead, -1.0, 1.0)

    def farther(self, ahead: Float[np.ndarray, "n"]) -> Float[np.ndarray, "n"]:
        """The inverse of `nearer`."""
        near = self._ahead - self.reach
        return ahead + self.reach * np.clip(ahead / near, -1.0, 1.0)

    def _straight(self, xp: Any, height: Any) -> Any:
        """How far b falls along the straight part at this height, m."""
        level = self.capture_distance
        return level - (level + xp.maximum(height, 0.0)) * math.cos(2.0 * self.angle) - self.gap

    def height(self, xp: Any, ahead: Any, left: Any) -> Any:
        """a (m) at z = (ahead, left) (m)."""
        x, y = xp.abs(ahead), xp.abs(left)
        cosine, sine = math.cos(self.angle), math.sin(self.angle)
        arc = y * cosine >= x * sine
        return xp.where(arc, xp.sqrt(x * x + y * y), x * cosine + y * sine) - self.capture_distance

    def place(self, xp: Any, ahead: Any, left: Any) -> Place:
        """Where states z = (ahead, left) (m) lie; `xp` is `numpy` or `jax.numpy`.

        Beyond the largest height the outermost nodes count.
        """
        level, cosine, sine = self.capture_distance, math.cos(self.angle), math.sin(self.angle)
        behind, right = ahead < 0.0, left < 0.0
        x, y = xp.abs(ahead), xp.abs(left)
        # Reversing the pursuer makes phi to pi - phi, the mirror then to -phi.
        sign = xp.where(behind == right, 1.0, -1.0)
        turns = xp.where(behind, xp.where(right, -1.0, 1.0), 0.0)
        arc = y * cosine >= x * sine
        distance = xp.sqrt(x * x + y * y)
        height = xp.where(arc, distance, x * cosine + y * sine) - level
        other = x * cosine - y * sine - level
        is_open = ~arc & (other >= 0.0)
        cell, up = self.heights.place(xp, height)
        beside, beside_along = self.heights.place(xp, other)
        share, share_along = self.shares.place(xp, (-self.gap - other) / self._straight(xp, height))
        turned = (xp.arctan2(y, x) - self.angle) / (math.pi / 2.0 - self.angle) * self.bearings
        bearing = xp.clip(xp.floor(turned), 0, self.bearings - 1)
        column = xp.where(arc, self.shares.count - 1 + bearing.astype(xp.int32), share)
        along = xp.where(arc, xp.clip(turned - bearing, 0.0, 1.0), share_along)
        count = self.heights.count
        return Place(
            height,
            xp.where(is_open, cell * count + beside, self.first_committed + cell * self.committed + column),
            xp.where(is_open, count, self.committed),
            up,
            xp.where(is_open, beside_along, along),
            sign,
            turns,
        )
