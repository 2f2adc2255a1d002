"""The exact filter for one hard row and one soft row, in fewer nodes than the general filter.

Once the rows are feasible (see `levels_graph`), the answer is the nearest velocity in the disc that keeps the
soft row if it keeps the hard row too; else it lies on the hard row's line. Velocities are given in a row's
axes: d along n = -N, and t along T, perpendicular to it.
"""

from __future__ import annotations

import numpy as np

from sidestep.bridges.export.filter_graph import CORRECTED, INFEASIBLE, ROUNDING, TOLERANCE, Verdict
from sidestep.bridges.export.graph import Graph, Tensor
from sidestep.bridges.export.levels_graph import Row
from sidestep.bridges.export.scene import picks

_STEEP = 1e12


def closest_of_pair(
    graph: Graph, start: Tensor, hard: Row, soft: Row, speed: float, nominal: Tensor | None = None
) -> tuple[Tensor, Verdict]:
    """As `filter_graph.closest`, for these two rows."""
    vectors = graph.join(hard[0], soft[0], start, *([] if nominal is None else [nominal]))
    size = 6 if nominal is None else 8
    products = _products(graph, vectors, size)
    dot, cross, _, d_soft, t_hard, t_soft = graph.split(products, *[1] * 6)

    kept = graph.least(hard[1], 1.0)
    # The largest offset that the soft row can have beside the hard one.
    reach = graph.largest(kept, dot)
    most = reach * dot + cross.apply("Abs") * _other_leg(graph, reach)
    eased = graph.least(soft[1], most)

    # The nearest that keeps the soft row, and by how much it misses the hard one.
    along = graph.largest(d_soft, eased)
    aside = _within(graph, t_soft, _other_leg(graph, along))
    short = kept - (along * dot + aside * cross)
    # On the hard row's line the soft one allows K t <= B, with K = cross.
    over = eased - kept * dot + t_hard * cross
    over = graph.linear(over, np.eye(1), -ROUNDING).apply("Relu")
    steep = graph.largest(cross * cross, ROUNDING**2)
    on_line = _within(graph, t_hard - over * cross / steep, _other_leg(graph, kept))

    # 1 where the answer is on the hard row's line, else 0, with a steep transition.
    on_hard = graph.op("Clip", graph.linear(short, _STEEP * np.eye(1), -_STEEP * TOLERANCE), 0.0, 1.0)
    parts = graph.join(along, aside, kept, on_line) * graph.linear(
        on_hard, np.array([[-1.0, -1.0, 1.0, 1.0]]), [1.0, 1.0, 0.0, 0.0]
    )
    # n = (-x, -y) and T = (y, -x) of N = (x, y).
    axes = graph.linear(
        vectors,
        picks(size, {2: -1.0}, {3: -1.0}, {3: 1.0}, {2: -1.0}, {0: -1.0}, {1: -1.0}, {1: 1.0}, {0: -1.0}),
    )
    twice = graph.linear(parts, picks(4, *({i: 1.0} for i in (0, 0, 1, 1, 2, 2, 3, 3))))
    velocity = graph.linear(axes * twice, picks(8, *(dict.fromkeys(range(j, 8, 2), speed) for j in (0, 1))))
    return velocity, _verdict([hard[1], soft[1], kept, eased, products])


def _verdict(parts: list[Tensor]) -> Verdict:
    """Corrected where the nominal action violates a row, infeasible where a row was relaxed."""
    weights = picks(10, {0: 1.0, 4 + 2: -1.0}, {1: 1.0, 4 + 3: -1.0}, {0: 1.0, 2: -1.0}, {1: 1.0, 3: -1.0})
    return Verdict(parts, weights, (CORRECTED, CORRECTED, INFEASIBLE, INFEASIBLE))


def _products(graph: Graph, vectors: Tensor, size: int) -> Tensor:
    """n_hard.n_soft, n_hard.T_soft, and d and t of the nominal action along the axes of both rows, `(batch,
    6)`; d is that of its projection on the disc if they differ."""
    x, y = size - 2, size - 1
    pairs = [
        (0, 2, {0: 1.0}), (1, 3, {0: 1.0}), (1, 2, {1: 1.0}), (0, 3, {1: -1.0}),
        (0, 4, {2: -1.0}), (1, 5, {2: -1.0}), (2, 4, {3: -1.0}), (3, 5, {3: -1.0}),
        (1, x, {4: 1.0}), (0, y, {4: -1.0}), (3, x, {5: 1.0}), (2, y, {5: -1.0}),
    ]  # fmt: skip
    left = graph.linear(vectors, picks(size, *({a: 1.0} for a, _, _ in pairs)))
    right = graph.linear(vectors, picks(size, *({b: 1.0} for _, b, _ in pairs)))
    signs = np.zeros((len(pairs), 6))
    for row, (_, _, terms) in enumerate(pairs):
        for column, sign in terms.items():
            signs[row, column] = sign
    return graph.linear(left * right, signs)


def _other_leg(graph: Graph, leg: Tensor) -> Tensor:
    """sqrt(1 - leg^2), 0 beyond 1."""
    return graph.linear(leg * leg, -np.eye(1), 1.0).apply("Relu").apply("Sqrt")


def _within(graph: Graph, value: Tensor, limit: Tensor) -> Tensor:
    return graph.largest(graph.least(value, limit), -limit)
