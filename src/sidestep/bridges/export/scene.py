"""How do the robots come into a graph?

As rows of four numbers, seen from the evader: pursuers (x, y, heading, 0), then obstacles (x, y, vx, vy),
then the target (x, y, 0, 0) where a policy asks for it. What comes in and is no number is replaced here,
once, by a robot so far off that it matters to nobody; the status tells of it in the end.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from sidestep.bridges.export.graph import Graph, Tensor
from sidestep.world import Scenario

NO_NUMBER = 1e15
"""Coordinates whose absolute values sum up to this (m) count as not finite: their squares would overflow."""
_FAR = 1e6
_TINY = 1e-20


@dataclass(frozen=True)
class Scene:
    """The robots of a batch of worlds, all in world axes relative to the evader.

    **Attributes:** `rows (batch, robots, 4)`, all finite; `pursuers` m and `obstacles` k of them, the target
    behind if `has_target`; `valid (batch, 1, 1)` 1.0 where everything that came in was finite, else 0.0.
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
    def offsets(self) -> Tensor:
        """From the evader to each, `(batch, robots, 2)` in m."""
        return self.rows.part(0, 2)

    @property
    def distances(self) -> Tensor:
        """`(batch, robots, 1)` in m."""
        return self.offsets.over("ReduceL2")

    @property
    def directions(self) -> Tensor:
        """Unit vectors from the evader to each, `(batch, robots, 2)`; where it is upon it -x for an obstacle
        and +x for the target, as the barrier and the observation have it."""
        # So small that it decides only where there is nothing else.
        nudge = np.zeros((self.count + 1, 2))
        nudge[:, 0] = [-_TINY] * self.count + [_TINY]
        rows = nudge if self.has_target else nudge[:-1]
        return (self.offsets + rows) / self.graph.largest(self.distances, _TINY)

    @property
    def headings(self) -> Tensor:
        """Unit vectors along the pursuers' headings, `(batch, m, 2)`."""
        angle = self.rows.part(0, self.pursuers, axis=1).part(2, 3)
        return self.graph.join(angle.apply("Cos"), angle.apply("Sin"))

    @property
    def drifts(self) -> Tensor:
        """Velocities of the obstacles, `(batch, k, 2)` in m/s."""
        return self.rows.part(self.pursuers, self.count, axis=1).part(2, 4)


def read_scene(graph: Graph, scenario: Scenario, *, target: bool) -> Scene:
    """The inputs `evader (batch, 2)`, `pursuers (batch, m, 3)`, `obstacles (batch, k, 4)` unless k = 0, and
    `target (batch, 2)` if asked for, as a `Scene`."""
    m, k = scenario.pursuer_count, scenario.obstacle_count
    evader = _padded(graph, graph.input("evader", "batch", 2).reshape(0, 1, 2), 2)
    rows = [_padded(graph, graph.input("pursuers", "batch", m, 3), 1)]
    # Away from the evader faster than it is far: no gain makes a row out of that.
    nowhere = [[0.0, -_FAR, 0.0, 0.0]] * m + [[_FAR, 0.0, _FAR, 0.0]] * k
    if k:
        rows.append(graph.input("obstacles", "batch", k, 4))
    if target:
        rows.append(_padded(graph, graph.input("target", "batch", 2).reshape(0, 1, 2), 2))
        nowhere.append([1.0, 0.0, 0.0, 0.0])
    seen = graph.join(*rows, axis=1) - evader
    known = graph.op("ReduceL1", seen, axes=[2], keepdims=1) < NO_NUMBER
    everything = graph.op("ReduceL1", seen, axes=[1, 2], keepdims=1) < NO_NUMBER
    return Scene(
        graph,
        graph.where(known, seen, np.array(nowhere)),
        m,
        k,
        target,
        graph.op("Cast", everything, to=1),
    )


def _padded(graph: Graph, rows: Tensor, zeros: int) -> Tensor:
    return graph.op("Pad", rows, np.array([0, 0, 0, 0, 0, zeros]))
