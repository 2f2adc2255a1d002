"""The filter against a conic solver: nothing feasible is closer, nothing infeasible violates less."""

import functools

import clarabel
import jax
import numpy as np
import pytest
import scipy.sparse as sparse

from sidestep.safety import Status, project, tolerance

pytestmark = pytest.mark.usefixtures("x64")


def _settings():
    settings = clarabel.DefaultSettings()
    settings.verbose = False
    settings.max_threads = 1
    settings.tol_gap_abs = settings.tol_gap_rel = settings.tol_feas = 1e-10
    return settings


def _dense(matrix):
    """CSC with every entry stored: much faster to build than by searching for zeros."""
    rows, columns = matrix.shape
    pointer = np.arange(columns + 1) * rows
    return sparse.csc_matrix(
        (matrix.T.ravel(), np.tile(np.arange(rows), columns), pointer), shape=matrix.shape
    )


_IDENTITY, _NOTHING = sparse.csc_matrix(np.eye(2)), sparse.csc_matrix((3, 3))
_SETTINGS = _settings()


def _closest(nominal, normals, offsets, limit):
    """Status and point: minimise |u - nominal|^2 over the rows and the second-order cone |u| <= limit."""
    matrix = _dense(np.vstack([-normals, np.zeros((1, 2)), -np.eye(2)]))
    bound = np.concatenate([-offsets, [limit, 0.0, 0.0]])
    cones = [clarabel.NonnegativeConeT(len(offsets)), clarabel.SecondOrderConeT(3)]
    solution = clarabel.DefaultSolver(_IDENTITY, -nominal, matrix, bound, cones, _SETTINGS).solve()
    return str(solution.status), np.array(solution.x)


def _level(normals, offsets, limit, kept):
    """Smallest t >= 0 with c_i - n_i.u <= t for the rows from `kept` on, the others held as they are."""
    k = len(offsets)
    free = (np.arange(k) >= kept).astype(float)
    speed = np.c_[np.vstack([np.zeros((1, 2)), -np.eye(2)]), np.zeros(3)]
    matrix = _dense(np.vstack([np.c_[-normals, -free], [[0.0, 0.0, -1.0]], speed]))
    bound = np.concatenate([-offsets, [0.0, limit, 0.0, 0.0]])
    cones = [clarabel.NonnegativeConeT(k + 1), clarabel.SecondOrderConeT(3)]
    cost = np.array([0.0, 0.0, 1.0])
    solution = clarabel.DefaultSolver(_NOTHING, cost, matrix, bound, cones, _SETTINGS).solve()
    return str(solution.status), solution.x[2]


def _least_crossing(normals):
    """Smallest sine of the angle between two rows that are not exactly parallel."""
    x, y = normals[:, 0], normals[:, 1]
    sines = np.abs(np.outer(x, y) - np.outer(y, x))
    return np.min(sines[sines > 0.0], initial=1.0)


def _filter(batch, hard=0):
    answer = jax.jit(jax.vmap(functools.partial(project, hard=hard), in_axes=(0, 0, 0, None)))(
        batch.nominal, batch.normals, batch.offsets, batch.limit
    )
    return np.asarray(answer.action), np.asarray(answer.status)


@pytest.mark.parametrize(
    "k, count",
    [
        (2, 8000),
        (3, 5000),
        (8, 2000),
        *(pytest.param(*p, marks=pytest.mark.slow) for p in ((1, 2000), (5, 3000))),
    ],
)
def test_no_feasible_action_is_closer_than_the_filters(problems, k, count):
    batch = problems(count, k)
    normals, offsets = batch.unit_rows()
    action, status = _filter(batch)
    shortfall = (offsets - np.einsum("nki,ni->nk", normals, action)).max(axis=1)
    speed = np.linalg.norm(action, axis=1)
    distance = np.linalg.norm(action - batch.nominal, axis=1)

    feasible = status <= Status.CORRECTED
    slack = 2.0 * tolerance(np.float64) * batch.limit
    assert np.all(shortfall[feasible] <= slack)
    assert np.all(speed <= batch.limit + slack)

    solved = refused = 0
    for i in range(len(batch)):
        # Zero rows that cannot hold are no cone Clarabel could say more about than the filter does.
        void = np.linalg.norm(batch.normals[i], axis=1) == 0.0
        if np.any(void & (offsets[i] > 0.0)):
            assert status[i] == Status.INFEASIBLE
            continue
        verdict, point = _closest(batch.nominal[i], normals[i][~void], offsets[i][~void], batch.limit)
        if verdict == "Solved":
            theirs = np.linalg.norm(point - batch.nominal[i])
            if feasible[i]:
                solved += 1
                # Ours is feasible to rounding, so it is the closest if it is no farther than theirs. They
                # may overstep rows by 1e-10, and gain as much by it as the rows are close to parallel.
                gain = 1e-6 * (1.0 + theirs) + 1e-9 / _least_crossing(normals[i])
                assert distance[i] <= theirs + gain
            else:
                # They allow themselves 1e-10; the violation that the filter saw must be of that size.
                assert shortfall[i] <= 1e-7
        elif verdict == "PrimalInfeasible":
            refused += 1
            assert not feasible[i] or shortfall[i] >= -1e-9
    assert solved + refused >= 0.9 * len(batch)
    assert min(solved, refused) >= 0.02 * len(batch)


@pytest.mark.parametrize("k", [2, 5])
def test_well_conditioned_answers_agree_in_position(problems, k):
    batch = problems(1000, k, seed=1, families=("random",))
    action, status = _filter(batch)
    compared = 0
    for i in np.flatnonzero(status <= Status.CORRECTED):
        verdict, point = _closest(batch.nominal[i], batch.normals[i], batch.offsets[i], batch.limit)
        if verdict == "Solved":
            compared += 1
            np.testing.assert_allclose(action[i], point, atol=2e-5)
    assert compared >= 100


@pytest.mark.parametrize("k", [2, 3, 5])
def test_when_nothing_is_feasible_the_largest_violation_is_least(problems, k):
    batch = problems(1500, k, seed=2, families=("random", "crowded", "opposed", "nearly parallel"))
    normals, offsets = batch.unit_rows()
    action, status = _filter(batch)
    violation = (offsets - np.einsum("nki,ni->nk", normals, action)).max(axis=1)
    compared = 0
    for i in np.flatnonzero(status == Status.INFEASIBLE)[:250]:
        verdict, level = _level(normals[i], offsets[i], batch.limit, kept=0)
        if verdict == "Solved":
            compared += 1
            assert abs(violation[i] - level) <= 1e-7
    assert compared >= 150


@pytest.mark.parametrize("k, hard", [(2, 1), (4, 1), (4, 2), (5, 3)])
def test_leading_rows_are_kept_first_and_the_others_then_violated_least(problems, k, hard):
    batch = problems(1500, k, seed=3, families=("random", "crowded", "opposed"))
    normals, offsets = batch.unit_rows()
    action, status = _filter(batch, hard=hard)
    violation = offsets - np.einsum("nki,ni->nk", normals, action)
    leading, others = violation[:, :hard].max(axis=1), violation[:, hard:].max(axis=1)
    kept = lost = 0
    for i in np.flatnonzero(status == Status.INFEASIBLE)[:300]:
        verdict, level = _level(normals[i, :hard], offsets[i, :hard], batch.limit, kept=0)
        if verdict != "Solved":
            continue
        assert abs(max(leading[i], 0.0) - level) <= 1e-7
        if level > 1e-6:
            lost += 1
            continue
        verdict, level = _level(normals[i], offsets[i], batch.limit, kept=hard)
        if verdict == "Solved":
            kept += 1
            assert abs(others[i] - level) <= 1e-6
    assert kept >= 30
    assert lost >= 30
