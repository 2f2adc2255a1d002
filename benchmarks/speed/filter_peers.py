"""The filter's problems in the words of other solvers, each used as its documentation advises."""

from __future__ import annotations

from typing import Any

import numpy as np

from speed.filter_problems import LIMIT, SINGLES, Problems, Side
from speed.peers import peer


def _jax_side(solve: Any, given: Problems) -> Side:
    """A JAX function of (nominal, normals, offsets), jitted, and jitted under `vmap`."""
    import jax
    import jax.numpy as jnp

    single, batched = jax.jit(solve), jax.jit(jax.vmap(solve))
    arrays = [jnp.asarray(entry, dtype=float) for entry in (given.nominal, given.normals, given.offsets)]
    singles = [tuple(entry[i] for entry in arrays) for i in range(min(SINGLES, len(given.nominal)))]
    return Side(
        lambda i: jax.block_until_ready(single(*singles[i])),
        lambda: jax.block_until_ready(batched(*arrays)),
        np.asarray,
        np.asarray,
    )


def qpax(given: Problems) -> Side:
    """qpax's `solve_qp` on minimise |u - nominal|^2 with rows and box, at its default tolerance."""
    import jax.numpy as jnp

    solver = peer("qpax")

    def solve(nominal: Any, normals: Any, offsets: Any) -> Any:
        eye = jnp.eye(2)
        inequalities = jnp.concatenate([-normals, eye, -eye])
        bounds = jnp.concatenate([-offsets, jnp.full(4, LIMIT)])
        return solver.solve_qp(
            eye, -nominal, jnp.zeros((0, 2)), jnp.zeros(0), inequalities, bounds
        )[0]  # fmt: skip

    return _jax_side(solve, given)


def cbfpy(given: Problems, backend: str) -> Side:
    """cbfpy's `safety_filter` of a robot z' = u with barriers h = n.z - c, asked at z = 0 with alpha(h) = h.

    Its row L_g h u >= -alpha(h) is then n.u >= c. Normals and offsets are arguments, so that nothing is
    compiled anew. qpax solves the strict problem; ElastiQP has the relaxed one only. Tolerances are what
    each advises.
    """
    import jax.numpy as jnp

    library = peer("cbfpy")
    if backend == "elastiqp":
        peer("elastiqp.jax")
    rows = given.offsets.shape[1]

    class Rows(library.CBFConfig):
        def __init__(self):
            example = (jnp.asarray(given.normals[0], dtype=float), jnp.asarray(given.offsets[0], dtype=float))
            super().__init__(
                n=2,
                m=2,
                u_min=-LIMIT * np.ones(2),
                u_max=LIMIT * np.ones(2),
                relax_qp=backend == "elastiqp",
                solver_tol=1e-6 if backend == "elastiqp" else 1e-3,
                backend=backend,
                init_args=example,
            )

        def f(self, z: Any, normals: Any, offsets: Any) -> Any:
            return jnp.zeros(2)

        def g(self, z: Any, normals: Any, offsets: Any) -> Any:
            return jnp.eye(2)

        def h_1(self, z: Any, normals: Any, offsets: Any) -> Any:
            return jnp.stack([normals[i, 0] * z[0] + normals[i, 1] * z[1] - offsets[i] for i in range(rows)])

        def alpha(self, h: Any, *arguments: Any) -> Any:
            return h

    barrier = library.CBF.from_config(Rows())
    return _jax_side(
        lambda nominal, normals, offsets: barrier.safety_filter(jnp.zeros(2), nominal, normals, offsets),
        given,
    )


def osqp(given: Problems) -> Side:
    """OSQP, set up once, updated for each problem, which starts from the last answer."""
    solver, sparse = peer("osqp"), peer("scipy.sparse")
    rows = given.offsets.shape[1]
    box = np.full(2, LIMIT)
    stack = lambda normals: np.concatenate([normals, np.eye(2)])  # noqa: E731
    # Every entry is stored, zeros too, so that the pattern of the matrix never changes.
    pattern = sparse.csc_matrix(np.ones((rows + 2, 2)))
    upper = np.concatenate([np.full(rows, np.inf), box])
    pattern.data = stack(given.normals[0]).T.ravel().copy()
    problem = solver.OSQP()
    problem.setup(
        sparse.identity(2, format="csc"),
        -given.nominal[0],
        pattern,
        np.concatenate([given.offsets[0], -box]),
        upper,
        verbose=False,
    )
    matrices = [stack(normals).T.ravel() for normals in given.normals]
    lower = [np.concatenate([offsets, -box]) for offsets in given.offsets]

    def single(i: int) -> np.ndarray:
        problem.update(q=-given.nominal[i], l=lower[i], u=upper, Ax=matrices[i])
        return problem.solve(raise_error=False).x.copy()

    return _loop(single, given)


def clarabel(given: Problems) -> Side:
    """Clarabel, set up once and updated; it keeps the disc |u| <= s itself, as a second-order cone."""
    solver, sparse = peer("clarabel"), peer("scipy.sparse")
    rows = given.offsets.shape[1]
    settings = solver.DefaultSettings()
    settings.verbose = False
    settings.presolve_enable = False  # as updates need
    # Rows: -n.u + slack = -c in the nonnegative cone; (s, u_x, u_y) in the cone |(u_x, u_y)| <= s.
    entries = np.concatenate([np.arange(rows), [rows + 1], np.arange(rows), [rows + 2]])
    matrices = [np.concatenate([-normals[:, 0], [-1.0], -normals[:, 1], [-1.0]]) for normals in given.normals]
    right = [np.concatenate([-offsets, [LIMIT, 0.0, 0.0]]) for offsets in given.offsets]
    matrix = sparse.csc_matrix(
        (matrices[0], entries, np.array([0, rows + 1, 2 * rows + 2])), shape=(rows + 3, 2)
    )
    cones = [solver.NonnegativeConeT(rows), solver.SecondOrderConeT(3)]
    problem = solver.DefaultSolver(
        sparse.identity(2, format="csc"), -given.nominal[0], matrix, right[0], cones, settings
    )

    def single(i: int) -> np.ndarray:
        problem.update(q=-given.nominal[i], A=matrices[i], b=right[i])
        return np.asarray(problem.solve().x)

    return _loop(single, given)


def _loop(single: Any, given: Problems) -> Side:
    return Side(
        single, lambda: np.stack([single(i) for i in range(len(given.nominal))]), np.asarray, np.asarray
    )
