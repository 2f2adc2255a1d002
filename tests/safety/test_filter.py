"""What can go wrong between a nominal action and a safe one."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from sidestep.safety import Projection, Status, project, tolerance

LIMIT = 0.1574
RIGHT, UP = [1.0, 0.0], [0.0, 1.0]


@functools.cache
def _batched(hard=0, circle=False):
    return jax.jit(jax.vmap(functools.partial(project, hard=hard, circle=circle), in_axes=(0, 0, 0, None)))


def _solve(batch, hard=0, circle=False):
    answer = _batched(hard, circle)(
        jnp.asarray(batch.nominal), jnp.asarray(batch.normals), jnp.asarray(batch.offsets), batch.limit
    )
    return jax.tree.map(np.asarray, answer)


@functools.cache
def _compiled(**options):
    return jax.jit(functools.partial(project, **options))


def _one(nominal, normals, offsets, limit=LIMIT, **options) -> Projection:
    return _compiled(**options)(
        jnp.asarray(nominal, float),
        jnp.asarray(normals, float).reshape(-1, 2),
        jnp.asarray(offsets, float).reshape(-1),
        jnp.asarray(limit, float),
    )


def test_a_safe_nominal_action_is_not_touched(precision):
    nominal = jnp.array([0.03, -0.07])
    result = _one(nominal, [RIGHT, UP], [0.0, -0.1], hard=1)
    assert np.array_equal(result.action, nominal)
    assert result.status == Status.OK
    np.testing.assert_allclose(result.slack, 0.03, atol=1e-7)


def test_full_speed_is_no_correction(precision):
    """Rounding of a nominal action on the limit itself must not count as an intervention."""
    angles = jnp.linspace(-3.0, 3.0, 500)
    nominal = LIMIT * jnp.stack([jnp.cos(angles), jnp.sin(angles)], axis=-1)
    answer = jax.jit(jax.vmap(project, in_axes=(0, None, None, None)))(
        nominal, jnp.zeros((0, 2)), jnp.zeros(0), LIMIT
    )
    assert np.all(answer.status == Status.OK)
    assert np.array_equal(answer.action, nominal)


def test_status_is_ok_exactly_when_the_action_is_the_nominal_one(precision, problems):
    for circle in (False, True):
        batch = problems(4000, 2, seed=11)
        if circle:
            batch.nominal *= batch.limit / np.linalg.norm(batch.nominal, axis=1, keepdims=True)
        batch = batch.cast(jnp.zeros(()).dtype)
        answer = _solve(batch, hard=1, circle=circle)
        same = np.all(answer.action == batch.nominal, axis=1)
        assert np.array_equal(same & (answer.status != Status.INFEASIBLE), answer.status == Status.OK)
        assert np.all(np.bincount(answer.status, minlength=3)[:3] > 0)


def test_no_rows_leave_only_the_speed_limit(precision):
    result = _one([3.0, 4.0], [], [])
    np.testing.assert_allclose(result.action, [0.6 * LIMIT, 0.8 * LIMIT], rtol=1e-6)
    assert result.status == Status.CORRECTED
    assert result.slack == np.inf
    result = _one([0.0, 0.01], [], [], circle=True)
    np.testing.assert_allclose(result.action, [0.0, LIMIT], atol=1e-8)


def test_slack_is_in_the_units_of_the_rows_given(precision):
    result = _one([0.0, 0.0], [[2.0, 0.0], [0.0, 0.5]], [0.1, -0.02])
    np.testing.assert_allclose(result.action, [0.05, 0.0], atol=1e-7)
    np.testing.assert_allclose(result.slack, 0.0, atol=1e-7)
    result = _one([0.0, 0.0], [[2.0, 0.0]], [1.0])
    np.testing.assert_allclose(result.slack, 2.0 * LIMIT - 1.0, atol=1e-7)


def test_a_zero_row_that_cannot_hold_is_told_and_spoils_nothing_else(precision):
    result = _one([-0.1, 0.0], [[0.0, 0.0], RIGHT], [0.5, 0.03], hard=1)
    np.testing.assert_allclose(result.action, [0.03, 0.0], atol=1e-7)
    assert result.status == Status.INFEASIBLE
    result = _one([-0.1, 0.0], [[0.0, 0.0], RIGHT], [0.0, 0.03], hard=1)
    assert result.status == Status.CORRECTED


def test_never_the_nominal_action_when_rows_cannot_hold(precision, problems):
    batch = problems(4000, 3, seed=12, families=("crowded", "random", "opposed")).cast(jnp.zeros(()).dtype)
    answer = _solve(batch, hard=1)
    lost = answer.status == Status.INFEASIBLE
    assert lost.sum() > 500
    inside = np.linalg.norm(batch.nominal, axis=1) < batch.limit
    moved = np.linalg.norm(answer.action - batch.nominal, axis=1)
    normals, offsets = batch.unit_rows()
    worst = lambda u: (offsets - np.einsum("nki,ni->nk", normals, u)).max(axis=1)  # noqa: E731
    leading = lambda u: (offsets - np.einsum("nki,ni->nk", normals, u))[:, 0]  # noqa: E731
    # Where it happens to stay, nothing could be gained by moving.
    gain = np.maximum(
        worst(batch.nominal) - worst(answer.action), leading(batch.nominal) - leading(answer.action)
    )
    stayed = lost & inside & (moved < 1e-6)
    assert np.mean(stayed[lost]) < 0.01
    assert np.all(gain[stayed] < 1e-5)


def test_the_leading_row_wins_over_the_others(precision):
    """A pursuer ahead and an obstacle behind ask for opposite motions: the pursuer's row is the hard one."""
    result = _one([0.0, 0.05], [RIGHT, [-1.0, 0.0]], [0.1, 0.1], hard=1)
    assert result.status == Status.INFEASIBLE
    # The pursuer's row just holds, and of all such actions the nominal one's nearest is taken.
    np.testing.assert_allclose(result.action, [0.1, 0.05], atol=2e-6)
    result = _one([0.0, 0.05], [RIGHT, [-1.0, 0.0]], [0.1, 0.1])
    np.testing.assert_allclose(result.action, [0.0, 0.05], atol=2e-6)


@pytest.mark.slow_with(precision=True)
def test_jit_vmap_and_plain_calls_agree(precision, problems):
    dtype = jnp.zeros(()).dtype
    for k, hard, circle in ((6, 2, False), (2, 1, True)):
        batch = problems(33, k, seed=16).cast(dtype)
        batched = _solve(batch, hard=hard, circle=circle)
        single = _compiled(hard=hard, circle=circle)
        eps = 100 * float(jnp.finfo(dtype).eps)
        for i in range(0, len(batch), 4):
            arguments = [jnp.asarray(v[i]) for v in (batch.nominal, batch.normals, batch.offsets)]
            one = single(*arguments, batch.limit)
            assert one.status == batched.status[i]
            # Compilers may fuse multiply and add, which changes the last digits.
            np.testing.assert_allclose(one.action, batched.action[i], atol=eps**0.5 * 1e-2)
    plain = project(*arguments, batch.limit, hard=hard, circle=circle)
    assert plain.status == one.status
    np.testing.assert_allclose(plain.action, one.action, atol=eps**0.5 * 1e-2)


BAD = (np.nan, np.inf, -np.inf)


@pytest.mark.parametrize("circle", [False, True])
def test_never_nan_and_never_silent_on_input_that_is_no_number(precision, circle):
    rows, offsets = np.array([RIGHT, UP]), np.array([0.05, -0.02])
    options = {"hard": 1, "circle": circle}
    for bad in BAD:
        # A nominal action that is no number counts as a stop; the rows hold all the same.
        result = _one([bad, 0.1], rows, offsets, **options)
        assert result.status == Status.INVALID
        assert result.action[0] >= 0.05 - 1e-6
        np.testing.assert_allclose(result.action[0], LIMIT if circle else 0.05, atol=1e-6)
        for where in ((0, 0), (0, 1), (1, 0), (1, 1)):
            broken = rows.copy()
            broken[where] = bad
            result = _one([0.0, -0.1], broken, offsets, **options)
            assert result.status == Status.INVALID
            assert np.all(np.isfinite(result.action))
            assert np.isfinite(result.slack)
            other = 1 - where[0]
            assert rows[other] @ np.asarray(result.action) >= offsets[other] - 1e-6
        result = _one([0.0, -0.1], rows, [bad, -0.02], **options)
        assert result.status == Status.INVALID
        assert result.action[1] >= -0.02 - 1e-6
        for limit in (bad, -0.1):
            result = _one([0.0, -0.1], rows, offsets, limit=limit, **options)
            assert result.status == Status.INVALID
            assert np.array_equal(result.action, [0.0, 0.0])


def test_a_robot_that_cannot_move_says_whether_standing_still_will_do(precision):
    for circle in (False, True):
        still = _one([0.0, 0.0], [RIGHT], [-0.1], limit=0.0, circle=circle)
        assert still.status == Status.OK
        pushed = _one([0.1, 0.0], [RIGHT], [-0.1], limit=0.0, circle=circle)
        assert pushed.status == Status.CORRECTED
        doomed = _one([0.1, 0.0], [RIGHT], [0.1], limit=0.0, circle=circle)
        assert doomed.status == Status.INFEASIBLE
        for result in (still, pushed, doomed):
            assert np.array_equal(result.action, [0.0, 0.0])


def test_statuses_of_a_batch_are_each_their_own(precision):
    nominal = jnp.array([[0.1, 0.0], [-0.1, 0.0], [0.0, 0.0], [np.nan, 0.0]])
    offsets = jnp.array([[0.05], [0.05], [0.5], [0.05]])
    normals = jnp.broadcast_to(jnp.array([RIGHT]), (4, 1, 2))
    answer = _batched()(nominal, normals, offsets, LIMIT)
    assert list(answer.status) == [Status.OK, Status.CORRECTED, Status.INFEASIBLE, Status.INVALID]
    assert Status.NAMES[int(answer.status[2])] == "infeasible"


def test_many_rows_are_handled_like_few(x64, problems):
    """64 rows, and the same answer when rows that cannot matter are added to a few."""
    few = problems(50, 3, seed=19, families=("random",))
    idle = np.random.default_rng(3).normal(size=(len(few), 61, 2))
    many = type(few)(
        few.nominal,
        np.concatenate([few.normals, idle], axis=1),
        np.concatenate([few.offsets, -10.0 * np.linalg.norm(idle, axis=2)], axis=1),
    )
    a, b = _solve(few, hard=1), _solve(many, hard=1)
    np.testing.assert_array_equal(a.status, b.status)
    np.testing.assert_allclose(a.action, b.action, atol=1e-9)


def test_a_wrong_number_of_hard_rows_is_refused():
    for hard in (-1, 2):
        with pytest.raises(
            ValueError, match=f"hard = {hard}: it must be between 0 and the number of rows, 1"
        ):
            project(jnp.zeros(2), jnp.array([RIGHT]), jnp.zeros(1), 0.1, hard=hard)


def test_another_limit_row_or_action_never_recompiles():
    traces = 0

    @jax.jit
    def counted(*arguments):
        nonlocal traces
        traces += 1
        return project(*arguments, hard=1)

    for value in (0.1, 0.2, 0.0, np.nan):
        counted(value * jnp.ones(2), value * jnp.ones((2, 2)), value * jnp.ones(2), jnp.asarray(value))
    assert traces == 1


def test_tolerance_is_a_few_rounding_units():
    assert tolerance(np.float32) < 2e-6
    assert tolerance(np.float64) < 4e-15
