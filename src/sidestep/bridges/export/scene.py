"""The robots as inputs of a graph.

Rows of four numbers relative to the evader: pursuers (x, y, heading, 0), obstacles (x, y, vx, vy), and the
target (x, y, 0, 0) if a policy needs it. A robot with non-finite input is replaced by one so far away that it
has no effect; the status reports it.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from sidestep.bridges.export.graph import Graph, Tensor
from sidestep.world import Scenario

NO_NUMBER = 1e15
"""If the absolute coordinates sum to this (m) or more they count as not finite: their squares overflow."""
_FAR = 1e6
TINY = 1e-20
"""A distance (m) that has an effect only where all others are 0."""


def picks(inputs: int, *columns: Mapping[int, float]) -> np.ndarray:
    """Weights for `Graph.linear`: one mapping from input index to factor per column."""
    weights = np.zeros((inputs, len(columns)))
    for column, terms in enumerate(columns):
        for index, weight in terms.items():
            weights[index, column] = weight
    return weights


def for_each(count: int, weights: Sequence[Sequence[float]] | np.ndarray) -> np.ndarray:
    """Block-diagonal weights: the same block for each of `count` robots."""
    return np.kron(np.eye(count), np.asarray(weights))


@dataclass(frozen=True)
class Scene:
    """The robots of a batch of worlds, in world axes relative to the evader.

    **Attributes:** `rows (batch, robots, 4)`, all finite: m `pursuers`, k `obstacles`, and the target if
    `has_target`; `valid (batch, 1)`, 1.0 where all inputs were finite, else 0.0.
    """

    graph: Graph
    rows: Tensor
    pursuers: int
    obstacles: int
    has_target: bool
    valid: Tensor

    @property
    def count(self) -> int:
        """Number of pursuers and obstacles."""
        return self.pursuers + self.obstacles

    @property
    def robots(self) -> int:
        """Number of rows: pursuers, obstacles, and the target if there is one."""
        return self.count + self.has_target

    @property
    def flat(self) -> Tensor:
        """The rows concatenated, `(batch, 4 robots)`."""
        return self.rows.reshape(0, 4 * self.robots)

    @property
    def distances(self) -> Tensor:
        """Distances from the evader, `(batch, robots)` in m."""
        squares = self.flat * self.flat
        return self.graph.linear(squares, for_each(self.robots, [[1.0], [1.0], [0.0], [0.0]])).apply("Sqrt")

    @property
    def headings(self) -> Tensor:
        """Cosines of the pursuers' headings, then the sines, `(batch, 2 m)`."""
        angles = self.flat.take([4 * i + 2 for i in range(self.pursuers)])
        return self.graph.join(angles.apply("Cos"), angles.apply("Sin"))

    def shortened(self) -> Tensor:
        """Vectors from the evader, `(batch, 2 robots + 2 k)`: to pursuers and obstacles p/(1 + |p|), then
        unit vectors to the target (if there is one) and to the obstacles.

        At distance 0 the direction is +x to the target and -x to an obstacle, as in observation and barrier.
        """
        n, m, t = self.count, self.pursuers, int(self.has_target)
        whole = list(range(n, n + t)) + list(range(m, n))
        places = [*range(n), *whole]
        offsets = picks(4 * self.robots, *({4 * i + axis: 1.0} for i in places for axis in (0, 1)))
        nudge = np.zeros((len(places), 2))
        nudge[n : n + t, 0], nudge[n + t :, 0] = TINY, -TINY
        lengths = picks(self.robots, *({i: 1.0} for i in places for _ in (0, 1)))
        more = np.repeat([1.0] * n + [TINY] * len(whole), 2)
        graph = self.graph
        return graph.linear(self.flat, offsets, nudge.reshape(-1)) / graph.linear(
            self.distances, lengths, more
        )


def read_scene(graph: Graph, scenario: Scenario, *, target: bool) -> Scene:
    """The inputs `evader (batch, 2)`, `pursuers (batch, m, 3)`, `obstacles (batch, k, 4)` unless k = 0, and
    `target (batch, 2)` if asked for, as a `Scene`."""
    m, k = scenario.pursuer_count, scenario.obstacle_count
    robots = m + k + target
    padded = np.eye(2, 4)
    evader = graph.linear(graph.input("evader", "batch", 2), np.tile(padded, robots)).reshape(0, robots, 4)
    rows = [graph.op("Pad", graph.input("pursuers", "batch", m, 3), np.array([0, 0, 0, 0, 0, 1]))]
    # A replaced obstacle moves away faster (m/s) than it is far (m): its row is inactive for any gain.
    nowhere = [[0.0, -_FAR, 0.0, 0.0]] * m + [[_FAR, 0.0, _FAR, 0.0]] * k
    if k:
        rows.append(graph.input("obstacles", "batch", k, 4))
    if target:
        rows.append(graph.linear(graph.input("target", "batch", 2), padded).reshape(0, 1, 4))
        nowhere.append([1.0, 0.0, 0.0, 0.0])
    seen = graph.join(*rows, axis=1) - evader
    known = seen.over("ReduceL1") < NO_NUMBER
    valid = graph.op("ReduceMin", graph.op("Cast", known, to=1), axes=[1], keepdims=0)
    kept = graph.where(known, seen, np.array(nowhere))
    return Scene(graph, kept, m, k, target, valid)
