"""Relaxation of infeasible rows as a graph: the levels in the disc of `safety.filter.least_violation`."""

from __future__ import annotations

from itertools import combinations
from typing import TypeAlias

import numpy as np

from sidestep.bridges.export.graph import Graph, Tensor

_NONE = -1e30
_EPS = float(np.finfo(np.float32).eps)

Row: TypeAlias = tuple[Tensor, Tensor]
"""N = -n, which points towards the other robot, `(batch, 2)`, and c in units of the evader's speed `(batch,
1)`; in this module with an axis in the middle for several of them."""


def relaxed(graph: Graph, rows: list[Row], hard: int) -> list[Tensor]:
    """Offsets of a feasible set of rows: the first `hard` rows are relaxed as little as possible, then the
    others."""
    kept = _give_way(graph, rows[:hard], 0)
    if hard < len(rows):
        both = [(normal, offset) for (normal, _), offset in zip(rows, kept, strict=False)] + rows[hard:]
        kept += _give_way(graph, both, hard)
    return kept


def _give_way(graph: Graph, rows: list[Row], first: int) -> list[Tensor]:
    """The offsets of the rows from `first` on, less their level."""
    if first == 0 and len(rows) == 1:
        return [graph.least(rows[0][1], 1.0)]
    if (first, len(rows)) == (1, 2):
        # The largest offset that one row can have beside one that is kept.
        return [graph.least(rows[1][1], _best_beside(graph, rows[0], rows[1]))]
    level = graph.join(*_levels(graph, rows, first), axis=1).over("ReduceMax", axis=1).apply("Relu")
    return [offset - level for _, offset in rows[first:]]


def _levels(graph: Graph, rows: list[Row], first: int) -> list[Tensor]:
    count = len(rows)
    levels = [offset - 1.0 for _, offset in rows[first:]]
    pairs = list(combinations(range(count), 2))
    if mixed := [pair for pair in pairs if pair[0] < first <= pair[1]]:
        kept, free = _take(graph, rows, mixed)
        levels.append(free[1] - _best_beside(graph, kept, free))
    if both := [pair for pair in pairs if pair[0] >= first]:
        levels.append(_free_pair(graph, *_take(graph, rows, both)))
    if triples := [three for three in combinations(range(count), 3) if three[2] >= first]:
        counts = np.array([[index >= first for index in three] for three in triples], float)
        levels.append(_triple(graph, counts, *_take(graph, rows, triples)))
    return levels


def _take(graph: Graph, rows: list[Row], groups: list[tuple[int, ...]]) -> list[Row]:
    """The first rows of all groups, the second ones, and so on."""
    return [
        (graph.join(*(rows[i][0] for i in index), axis=1), graph.join(*(rows[i][1] for i in index), axis=1))
        for index in zip(*groups, strict=True)
    ]


def _cross(a: Tensor, b: Tensor) -> Tensor:
    """a x b, `(batch, n, 1)`."""
    return ((a @ np.array([[0.0, 1.0], [-1.0, 0.0]])) * b).over("ReduceSum")


def _root(value: Tensor) -> Tensor:
    return value.apply("Relu").apply("Sqrt")


def _best_beside(graph: Graph, kept: Row, free: Row) -> Tensor:
    """The maximum of n_free.u over the disc where the other row holds: 1 if the row allows u = n_free, else
    the value where the row's line meets the circle."""
    along = (kept[0] * free[0]).over("ReduceSum")
    least = graph.largest(kept[1], along)
    return least * along + _cross(kept[0], free[0]).apply("Abs") * _root(1.0 - least * least)


def _free_pair(graph: Graph, p: Row, q: Row) -> Tensor:
    squared = (p[0] - q[0]).over("ReduceSumSquare")
    across = (p[0] + q[0]).over("ReduceSumSquare")
    gap = (p[1] - q[1]).apply("Abs")
    both = gap < squared * 0.5
    share = gap * gap / graph.where(both, squared, 1.0)
    return graph.where(both, (p[1] + q[1] - _root(across * (1.0 - share))) * 0.5, _NONE)


def _triple(graph: Graph, counts: np.ndarray, p: Row, q: Row, r: Row) -> Tensor:
    weights = graph.join(_cross(q[0], r[0]), _cross(r[0], p[0]), _cross(p[0], q[0]))
    weight = (weights * counts).over("ReduceSum")
    total = (weights * graph.join(p[1], q[1], r[1])).over("ReduceSum")
    least, most = weights.over("ReduceMin"), weights.over("ReduceMax")
    one_sign = graph.largest(least, -most)
    bounded = graph.least(one_sign, weight.apply("Abs") - 64.0 * _EPS) > 0.0
    safe = graph.where(bounded, weight, 1.0)
    level = graph.least(total / safe, 4.0) - (32.0 * _EPS) / safe.apply("Abs")
    return graph.where(bounded, level, _NONE)
