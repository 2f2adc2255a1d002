"""The filter to the last digit: against exact enumeration, in both precisions, on ill-conditioned rows."""

import functools
import itertools
from decimal import Decimal, localcontext

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import sidestep.safety
from sidestep.safety import Status, project, tolerance

# With the instructions that users' programs have: other tests are compiled more quickly, see conftest.py.
as_users = functools.partial(jax.jit, compiler_options={"xla_cpu_use_fusion_emitters": True})


def _exact_distance(nominal, normals, offsets, limit):
    """Distance from `nominal` to the feasible set in 60-digit arithmetic; None where that is empty.

    All candidates of THEORY's list: the nominal action, its projections on disc and lines, intersections of
    two lines, of line and circle. Exact enough to need no care.
    """
    with localcontext() as context:
        context.prec = 60
        px, py = (Decimal(float(v)) for v in nominal)
        rows = [
            tuple(Decimal(float(v)) for v in (*normal, c)) for normal, c in zip(normals, offsets, strict=True)
        ]
        s = Decimal(float(limit))
        candidates = [(px, py)]
        norm = (px * px + py * py).sqrt()
        if norm > 0:
            candidates.append((px * s / norm, py * s / norm))
        for x, y, c in rows:
            square = x * x + y * y
            if square == 0:
                continue
            step = (c - x * px - y * py) / square
            candidates.append((px + step * x, py + step * y))
            half = s * s - c * c / square
            if half >= 0:
                reach = (half / square).sqrt()
                candidates += [
                    (c * x / square - sign * reach * y, c * y / square + sign * reach * x) for sign in (1, -1)
                ]
        for (x, y, c), (u, v, d) in itertools.combinations(rows, 2):
            cross = x * v - y * u
            if cross != 0:
                candidates.append(((c * v - d * y) / cross, (x * d - u * c) / cross))
        fine = Decimal(10) ** -40
        feasible = [
            ((a - px) ** 2 + (b - py) ** 2).sqrt()
            for a, b in candidates
            if a * a + b * b <= s * s * (1 + fine) and all(x * a + y * b >= c - fine for x, y, c in rows)
        ]
        return float(min(feasible)) if feasible else None


@pytest.mark.parametrize("k", [pytest.param(2, marks=pytest.mark.slow), 3])
@pytest.mark.parametrize("family", ["nearly parallel", "equality", "duplicate", "boundary", "random"])
def test_an_answer_is_exact_up_to_moving_each_row_by_rounding(precision, problems, family, k):
    dtype = np.dtype(np.float64 if precision else np.float32)
    batch = problems(250, k, seed=5, families=(family,)).cast(dtype)
    answer = as_users(jax.vmap(project, in_axes=(0, 0, 0, None)))(
        batch.nominal, batch.normals, batch.offsets, dtype.type(batch.limit)
    )
    assert answer.action.dtype == dtype
    action, status = np.asarray(answer.action, np.float64), np.asarray(answer.status)
    distance = np.linalg.norm(action - batch.nominal, axis=1)
    limit = float(dtype.type(batch.limit))
    margin = 3.0 * tolerance(dtype) * limit
    seen = set()
    for i in range(len(batch)):
        rows = batch.normals[i].astype(np.float64), batch.offsets[i].astype(np.float64)
        size = np.linalg.norm(rows[0], axis=1)
        looser = _exact_distance(batch.nominal[i], rows[0], rows[1] - margin * size, limit + margin)
        tighter = _exact_distance(batch.nominal[i], rows[0], rows[1] + margin * size, limit - margin)
        fine = 1e-3 * margin
        if looser is None:
            assert status[i] == Status.INFEASIBLE
            seen.add("empty")
        elif status[i] != Status.INFEASIBLE:
            assert distance[i] >= looser - fine
        if tighter is not None:
            seen.add("feasible")
            assert status[i] in (Status.OK, Status.CORRECTED)
            assert distance[i] <= tighter + fine
    assert "feasible" in seen or family == "equality"
    assert "empty" in seen or family == "duplicate"


def test_rows_and_limit_are_kept_to_rounding(precision, problems):
    dtype = np.dtype(np.float64 if precision else np.float32)
    for k in (2, 8):
        batch = problems(3000, k, seed=6).cast(dtype)
        answer = as_users(jax.vmap(project, in_axes=(0, 0, 0, None)))(
            batch.nominal, batch.normals, batch.offsets, dtype.type(batch.limit)
        )
        action = np.asarray(answer.action, np.float64)
        normals, offsets = batch.unit_rows()
        shortfall = (offsets - np.einsum("nki,ni->nk", normals.astype(float), action)).max(axis=1)
        slack = 2.0 * tolerance(dtype) * batch.limit
        assert np.all(np.isfinite(action))
        assert np.all(np.linalg.norm(action, axis=1) <= batch.limit + slack)
        feasible = np.asarray(answer.status) <= Status.CORRECTED
        void = np.linalg.norm(batch.normals, axis=2) == 0.0
        shortfall = np.where((void & (offsets > 0.0)).any(axis=1), np.inf, shortfall)
        assert np.all(shortfall[feasible] <= slack)


def test_single_precision_tells_the_same_story_as_double(problems):
    for k, hard in ((2, 1), (5, 2)):
        batch = problems(3000, k, seed=7, families=("random", "scaled", "far nominal", "crowded"))
        single = batch.cast(np.dtype(np.float32))
        answers = []
        for wide, given in ((False, single), (True, single.cast(np.dtype(np.float64)))):
            with jax.enable_x64(wide):
                answer = as_users(jax.vmap(functools.partial(project, hard=hard), in_axes=(0, 0, 0, None)))(
                    given.nominal, given.normals, given.offsets, float(np.float32(batch.limit))
                )
                answers.append((np.asarray(answer.action, np.float64), np.asarray(answer.status)))
        (action, status), (exact_action, exact_status) = answers
        assert np.mean(status != exact_status) <= 1e-3
        # What is asked for first: the worst of the hard rows, given way to in the same measure.
        normals, offsets = single.cast(np.dtype(np.float64)).unit_rows()
        short = [
            np.max((offsets - np.einsum("nki,ni->nk", normals, u))[:, :hard], axis=1)
            for u in (action, exact_action)
        ]
        excess = np.maximum(short[0], 0.0) - np.maximum(short[1], 0.0)
        assert np.max(excess) <= 4.0 * tolerance(np.dtype(np.float32)) * batch.limit
        # The action itself is worse conditioned: square roots of rounding where a line touches the disc, and
        # rounding over the sine of the angle where two lines nearly coincide (here down to 0.002).
        distance = np.max(np.abs(action - exact_action), axis=1)
        assert np.max(distance) <= 5e-3 * batch.limit
        assert np.quantile(distance, 0.99) <= 1e-4 * batch.limit


def test_huge_and_tiny_numbers_cost_no_digits(precision):
    dtype = jnp.zeros(()).dtype
    project = as_users(sidestep.safety.project)
    far = jnp.array([3.0, 4.0]) * (1e30 if dtype == jnp.float32 else 1e200)
    result = project(far, jnp.array([[1.0, 0.0]]), jnp.array([-1.0]), jnp.asarray(0.1))
    np.testing.assert_allclose(result.action, [0.06, 0.08], rtol=1e-5)
    assert result.status == Status.CORRECTED

    # A row that asks for far too much still says which way is least bad.
    many = jnp.array([[1.0, 0.0], [0.0, 1.0]])
    result = project(jnp.zeros(2), many, jnp.array([1e12, 0.0]), jnp.asarray(0.1))
    np.testing.assert_allclose(result.action, [0.1, 0.0], atol=1e-6)
    assert result.status == Status.INFEASIBLE

    # The same half-plane, written with numbers near the ends of the range.
    for scale in (1e-30, 1e-6, 1e6, 1e30):
        result = project(jnp.zeros(2), scale * many[:1], scale * jnp.array([0.05]), jnp.asarray(0.1))
        np.testing.assert_allclose(result.action, [0.05, 0.0], atol=1e-7)
        assert result.status == Status.CORRECTED

    for limit in (1e-12, 1e12):
        result = project(
            jnp.array([limit, limit]), many[1:] * -1.0, jnp.array([-0.5 * limit]), jnp.asarray(limit)
        )
        np.testing.assert_allclose(result.action / limit, [np.sqrt(0.75), 0.5], rtol=1e-5)


def test_no_matrix_product_is_left_to_reduced_precision():
    """TF32 rounds products of a dot to 10 bits; the filter must not contain one."""
    text = str(
        jax.make_jaxpr(functools.partial(project, hard=1))(
            jnp.zeros(2), jnp.zeros((3, 2)), jnp.zeros(3), jnp.asarray(0.1)
        )
    )
    assert "dot_general" not in text
    assert "while" not in text
    assert "cond[" not in text
