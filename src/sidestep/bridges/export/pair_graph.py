"""The exact filter for one hard row and one soft one, in fewer nodes than the general one takes.

Once both rows can hold (see `levels_graph`), the nearest velocity in the disc that keeps the soft row is the
answer if it keeps the hard row too; else the answer lies on the hard row's line. A velocity is told by a
row's axes: d along n = -N, and t along T, a quarter turn from it.
"""

from __future__ import annotations

import numpy as np

from sidestep.bridges.export.filter_graph import CORRECTED, INFEASIBLE, ROUNDING, TOLERANCE, Verdict
from sidestep.bridges.export.graph import Graph, Tensor
from sidestep.bridges.export.levels_graph import Row
from sidestep.bridges.export.scene import picks

_STEEP = 1e12


def closest_of_pair(
    graph: Graph, start: Tensor, hard: Row, soft: Row, speed: float, wish: Tensor | None = None
) -> tuple[Tensor, Verdict]:
    """As `closest`, for these two rows."""
    vectors = graph.join(hard[0], soft[0], start, *([] if wish is None else [wish]))
    size = 6 if wish is None else 8
    products = _products(graph, vectors, size)
    dot, cross, _, d_soft, t_hard, t_soft = graph.split(products, *[1] * 6)

    kept = graph.least(hard[1], 1.0)
    # The most that the soft row can ask beside the hard one.
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

    # 1 where the answer is on the hard row's line, else 0: steep between.
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
    """Corrected where the wish misses a row, infeasible where one had to give way."""
    weights = picks(10, {0: 1.0, 4 + 2: -1.0}, {1: 1.0, 4 + 3: -1.0}, {0: 1.0, 2: -1.0}, {1: 1.0, 3: -1.0})
    return Verdict(parts, weights, (CORRECTED, CORRECTED, INFEASIBLE, INFEASIBLE))


def _products(graph: Graph, vectors: Tensor, size: int) -> Tensor:
    """n_hard.n_soft, n_hard.T_soft, and d and t of the wish along the axes of both rows, `(batch, 6)`; where
    wish and projection differ t is the wish's, and d the projection's."""
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
