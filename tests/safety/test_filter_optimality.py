"""The filter's answers are the best there are, and change as its input does: no solver, no oracle."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from sidestep.safety import Status, project

# Derivatives are looked at as users have them compiled; the test run itself compiles at the lowest level.
AS_USUAL = functools.partial(jax.jit, compiler_options={"xla_backend_optimization_level": 3})


def _solve(batch, hard=0, circle=False):
    batched = jax.vmap(functools.partial(project, hard=hard, circle=circle), in_axes=(0, 0, 0, None))
    return jax.tree.map(
        np.asarray, jax.jit(batched)(batch.nominal, batch.normals, batch.offsets, batch.limit)
    )


def _tiers(batch, hard, action):
    """Largest violation of hard and of other rows, and distance, of actions (n, ..., 2)."""
    normals, offsets = batch.unit_rows()
    live = np.linalg.norm(normals, axis=2) > 0.0
    shape = (len(batch),) + (1,) * (action.ndim - 2)
    violation = offsets.reshape(*shape, -1) - np.einsum("nki,n...i->n...k", normals, action)
    violation = np.where(live.reshape(*shape, -1), violation, -np.inf)
    first = np.maximum(np.max(violation[..., :hard], axis=-1, initial=0.0), 0.0)
    second = np.maximum(np.max(violation[..., hard:], axis=-1, initial=0.0), 0.0)
    return first, second, np.linalg.norm(action - batch.nominal.reshape(*shape, 2), axis=-1)


def _assert_undominated(batch, hard, action, others):
    """No other action is better in the order: hard rows, other rows, distance."""
    # Where a row just touches the disc, rounding of its level opens a gap of the root of that.
    fine = 1e-7
    first, second, distance = (entry[:, None] for entry in _tiers(batch, hard, action))
    first_o, second_o, distance_o = _tiers(batch, hard, others)
    tight_first, tight_second = first_o <= first, second_o <= second
    better = (first_o < first - fine) | (tight_first & (second_o < second - fine))
    better |= tight_first & tight_second & (distance_o < distance - 1e-6 * (1.0 + distance))
    assert not np.any(better), np.argwhere(better)[:5]


@pytest.mark.parametrize("k, hard", [(2, 1), (4, 2), (6, 1), (12, 3)])
def test_no_action_near_or_far_is_better(x64, problems, k, hard):
    """Independent of any solver: the problem is convex, so an answer no neighbour beats is the best."""
    batch = problems(600, k, seed=13)
    action = _solve(batch, hard=hard).action
    rng = np.random.default_rng(0)
    angle = rng.uniform(-np.pi, np.pi, (len(batch), 400))
    radius = batch.limit * 10.0 ** rng.uniform(-7, 0.3, angle.shape)
    near = action[:, None] + radius[..., None] * np.stack([np.cos(angle), np.sin(angle)], axis=-1)
    speed = np.linalg.norm(near, axis=-1, keepdims=True)
    _assert_undominated(batch, hard, action, near * np.minimum(1.0, batch.limit / speed))


@pytest.mark.parametrize(
    "k, hard", [(2, 1), (4, 2), *(pytest.param(*p, marks=pytest.mark.slow) for p in ((1, 1), (6, 0)))]
)
def test_on_the_circle_no_heading_of_a_dense_scan_is_better(x64, problems, k, hard):
    batch = problems(110, k, seed=14)
    answer = _solve(batch, hard=hard, circle=True)
    np.testing.assert_allclose(np.linalg.norm(answer.action, axis=1), batch.limit, rtol=1e-12)
    angle = np.linspace(-np.pi, np.pi, 100_001)
    scan = batch.limit * np.stack([np.cos(angle), np.sin(angle)], axis=-1)
    for chunk in np.array_split(np.arange(len(batch)), 11):
        part = type(batch)(batch.nominal[chunk], batch.normals[chunk], batch.offsets[chunk])
        headings = np.broadcast_to(scan, (len(chunk), *scan.shape))
        _assert_undominated(part, hard, answer.action[chunk], headings)
        first, second, _ = _tiers(part, hard, headings)
        some_hold = np.any(np.maximum(first, second) <= 0.0, axis=1)
        void = np.linalg.norm(part.normals, axis=2) == 0.0
        never = np.any(void & (part.offsets > 0.0), axis=1)
        assert np.all((answer.status[chunk] == Status.INFEASIBLE)[some_hold] == never[some_hold])


def test_the_correction_is_a_combination_of_active_rows(x64, problems):
    """Karush-Kuhn-Tucker: action - nominal = sum l_i n_i - mu action with l, mu >= 0."""
    from scipy.optimize import nnls

    batch = problems(3000, 4, seed=15, families=("random", "parallel", "opposed", "scaled"))
    answer = _solve(batch)
    normals, offsets = batch.unit_rows()
    checked = 0
    for i in np.flatnonzero(answer.status == Status.CORRECTED)[:1000]:
        action = answer.action[i]
        active = np.abs(normals[i] @ action - offsets[i]) < 1e-9
        directions = list(normals[i][active])
        if np.linalg.norm(action) > batch.limit - 1e-9:
            directions.append(-action / np.linalg.norm(action))
        _, residual = nnls(np.array(directions).T, action - batch.nominal[i])
        assert residual <= 1e-9
        checked += 1
    assert checked >= 500


@pytest.mark.parametrize("circle", [False, pytest.param(True, marks=pytest.mark.slow)])
def test_gradients_are_true_where_they_exist(x64, problems, circle):
    """Against central differences; at the seams between cases, where there is none, differences disagree."""
    batch = problems(1500, 3, seed=17, families=("random", "scaled", "far nominal", "crowded"))
    rng = np.random.default_rng(1)
    point = tuple(jnp.asarray(v) for v in (batch.nominal, batch.normals, batch.offsets))
    length = np.linalg.norm(batch.normals, axis=2)
    size = (np.full((len(batch), 1), batch.limit), length[..., None], batch.limit * length)
    tangent = tuple(jnp.asarray(rng.normal(size=p.shape) * s) for p, s in zip(point, size, strict=True))
    f = lambda *a: project(*a, batch.limit, hard=1, circle=circle).action  # noqa: E731

    @AS_USUAL
    @jax.vmap
    def both(point, tangent):
        forward = jax.jvp(f, point, tangent)[1]
        step = lambda h: f(*(p + h * t for p, t in zip(point, tangent, strict=True)))  # noqa: E731
        h = jnp.array([1e-6, 0.5e-6])
        # All four steps in one: a program with the filter in it once is compiled sooner.
        ahead, behind = jax.vmap(jax.vmap(step))(jnp.stack([h, -h]))
        differences = (ahead - behind) / (2.0 * h[:, None])
        _, back = jax.vjp(f, *point)
        cotangent = back(forward)
        return (
            forward,
            differences,
            sum(jnp.sum(a * b) for a, b in zip(cotangent, tangent, strict=True)),
            jnp.sum(forward**2),
        )

    forward, differences, reverse, square = both(point, tangent)
    wide, narrow = differences[:, 0], differences[:, 1]
    assert np.all(np.isfinite(forward))
    np.testing.assert_allclose(reverse, square, rtol=1e-6, atol=1e-12)
    scale = 1.0 + np.abs(np.asarray(forward)).max(axis=1)
    smooth = np.abs(np.asarray(wide - narrow)).max(axis=1) <= 1e-6 * scale
    assert smooth.mean() >= 0.9
    wrong = np.abs(np.asarray(forward - wide)).max(axis=1) > 1e-4 * scale
    assert not np.any(wrong & smooth), np.flatnonzero(wrong & smooth)[:5]


@pytest.mark.parametrize("circle", [False, pytest.param(True, marks=pytest.mark.slow)])
@pytest.mark.slow_with(precision=True)
def test_gradients_stay_finite_on_every_awkward_row(precision, problems, circle):
    batch = problems(3000, 3, seed=18).cast(jnp.zeros(()).dtype)
    batch.nominal[::7] = 0.0

    def total(nominal, normals, offsets):
        answer = project(nominal, normals, offsets, batch.limit, hard=1, circle=circle)
        return jnp.sum(answer.action) + jnp.where(jnp.isfinite(answer.slack), answer.slack, 0.0)

    gradients = AS_USUAL(jax.vmap(jax.grad(total, argnums=(0, 1, 2))))(
        *(jnp.asarray(v) for v in (batch.nominal, batch.normals, batch.offsets))
    )
    assert all(np.all(np.isfinite(g)) for g in gradients)
