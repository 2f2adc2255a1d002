"""How do the robots come into a graph?

As rows of four numbers, seen from the evader: pursuers (x, y, heading, 0), then obstacles (x, y, vx, vy),
then the target (x, y, 0, 0) where a policy asks for it. What comes in and is no number is replaced here,
once, by a robot so far off that it matters to nobody; the status tells of it in the end.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from sidestep.bridges.export.graph import Graph, Tensor
from sidestep.world import Scenario

NO_NUMBER = 1e15
"""Coordinates whose absolute values sum up to this (m) count as not finite: their squares would overflow."""
_FAR = 1e6
TINY = 1e-20
"""A distance (m) that decides only where there is nothing else."""


def picks(inputs: int, *columns: Mapping[int, float]) -> np.ndarray:
    """Weights of `Graph.linear` by column: which of the `inputs` are added up, and how often."""
    weights = np.zeros((inputs, len(columns)))
    for column, terms in enumerate(columns):
        for index, weight in terms.items():
            weights[index, column] = weight
    return weights


def for_each(count: int, weights: Sequence[Sequence[float]] | np.ndarray) -> np.ndarray:
    """The same weights for each of `count` robots, whose numbers follow one another."""
    return np.kron(np.eye(count), np.asarray(weights))


@dataclass(frozen=True)
class Scene:
    """The robots of a batch of worlds, all in world axes relative to the evader.

    **Attributes:** `rows (batch, robots, 4)`, all finite; `pursuers` m and `obstacles` k of them, the target
    behind if `has_target`; `valid (batch, 1)` 1.0 where everything that came in was finite, else 0.0.
    """

    graph: Graph
    rows: Tensor
    pursuers: int
    obstacles: int
    has_target: bool
    valid: Tensor

    @property
    def count(self) -> int:
        """Pursuers and obstacles."""
        return self.pursuers + self.obstacles

    @property
    def robots(self) -> int:
        """Rows: those, and the target if there is one."""
        return self.count + self.has_target

    @property
    def flat(self) -> Tensor:
        """The rows one after the other, `(batch, 4 robots)`."""
        return self.rows.reshape(0, 4 * self.robots)

    @property
    def distances(self) -> Tensor:
        """From the evader to each, `(batch, robots)` in m."""
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

        Where the evader is upon it, the direction is +x to the target and -x to an obstacle, as observation
        and barrier have it.
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
    # Away from the evader faster than it is far: no gain makes a row out of that.
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
