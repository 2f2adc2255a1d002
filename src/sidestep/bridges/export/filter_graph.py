"""The exact filter as a graph: see `sidestep.safety.project`.

Candidates are the nominal action and, on each row's line, the point nearest to it that the other rows and the
disc allow. The answer has the least cost: distance plus a much larger penalty on violation.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from sidestep.bridges.export.graph import Graph, Tensor
from sidestep.bridges.export.levels_graph import Row, relaxed

_EPS = float(np.finfo(np.float32).eps)
TOLERANCE = 16.0 * _EPS
"""A row counts as kept up to this violation, in units of the speed limit; as `sidestep.safety.tolerance`."""
ROUNDING = 8.0 * _EPS
_VOID = 1e30
_PRICE = 1e12
_FEASIBLE = 8.0
_HARDER = 16.0


CORRECTED, INFEASIBLE = 1.0, 2.0


@dataclass(frozen=True)
class Verdict:
    """Encodes a filter's status: a grade applies where its column of `parts @ weights` exceeds `TOLERANCE`;
    the status is the largest grade that applies."""

    parts: list[Tensor]
    weights: np.ndarray
    grades: tuple[float, ...]


def closest(
    graph: Graph, start: Tensor, rows: list[Row], hard: int, speed: float, nominal: Tensor | None = None
) -> tuple[Tensor, Verdict]:
    """The velocity nearest to the nominal action that keeps all rows, `(batch, 2)` in m/s.

    **Arguments:** `start (batch, 2)` the nominal action's projection on the unit disc, in units of the speed
    limit `speed` (m/s); `nominal` the action itself if they may differ; `rows`, the first `hard` of which
    have priority.
    """
    count = len(rows)
    rows = [(normal.reshape(0, 1, 2), offset.reshape(0, 1, 1)) for normal, offset in rows]
    begin = start.reshape(0, 1, 2)
    aim = None if nominal is None else nominal.reshape(0, 1, 2)
    normals = graph.join(*(normal for normal, _ in rows), axis=1)
    offsets = graph.join(*(offset for _, offset in rows), axis=1)
    kept = graph.join(*relaxed(graph, rows, hard), axis=1)
    given_way = (offsets - kept).over("ReduceMax", axis=1)
    columns, limits = normals.transpose(0, 2, 1), kept.reshape(0, 1, count)
    points = _on_lines(graph, begin if aim is None else aim, normals, columns, kept, limits)
    candidates = graph.join(begin, points, axis=1)

    missed = graph.join(candidates @ columns + limits, candidates.over("ReduceL2"))
    allowed = np.array([TOLERANCE] * count + [1.0 + TOLERANCE])
    price = _PRICE * np.array([_HARDER] * hard + [1.0] * (count - hard) + [_HARDER])
    broken = ((missed - allowed) * price).over("ReduceMax").apply("Relu")
    cost = broken + _distance(graph, candidates, begin, aim)
    best = graph.op("ArgMin", cost, axis=1, keepdims=0)
    infeasible = graph.largest(given_way, cost.over("ReduceMin", axis=1) - _FEASIBLE).reshape(-1, 1)
    moved = graph.op("Cast", best, to=1)
    velocity = graph.op("GatherND", candidates, best, batch_dims=1)
    return velocity * speed, Verdict([moved, infeasible], np.eye(2), (CORRECTED, INFEASIBLE))


def _distance(graph: Graph, candidates: Tensor, start: Tensor, nominal: Tensor | None) -> Tensor:
    """Squared distance up to a constant and a positive factor: |u - p|^2 + w (1 - |u|^2), w = 1 - 1/|q|, for
    the nominal action q and its projection p on the disc."""
    near = (candidates - start).over("ReduceSumSquare")
    if nominal is None:
        return near
    weight = 1.0 - 1.0 / graph.largest(nominal.over("ReduceL2"), 1.0)
    return near + weight * (1.0 - candidates.over("ReduceSumSquare"))


def _on_lines(
    graph: Graph, nominal: Tensor, normals: Tensor, columns: Tensor, kept: Tensor, limits: Tensor
) -> Tensor:
    """On the line of each row, u = t T - c N, the allowed point nearest to the nominal action: `(batch,
    count, 2)`.

    Row j allows K t <= B there, with K = T_i.N_j and B = c_i N_i.N_j - c_j.
    """
    along = normals @ np.array([[0.0, -1.0], [1.0, 0.0]])
    slope = along @ columns
    # NaN where K is 0, and not used there.
    end = (kept * (normals @ columns) - limits + ROUNDING) / slope
    high = graph.where(slope > ROUNDING, end, _VOID).over("ReduceMin")
    low = graph.where(slope < -ROUNDING, end, -_VOID).over("ReduceMax")
    half = (1.0 - kept * kept).apply("Relu").apply("Sqrt")
    t = graph.least(graph.largest((along * nominal).over("ReduceSum"), low), high)
    # The disc last: if the limits contradict each other, the violation shows it.
    t = graph.least(graph.largest(t, -half), half)
    return along * t - normals * kept
