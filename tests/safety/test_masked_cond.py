"""A computation run only where needed must not answer for the wrong robot, nor run for all of them."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from sidestep.safety.shields.masked_cond import masked_cond


def _work(place, pair):
    return {"sum": place[0] + pair["a"] * 2.0, "which": jnp.argmax(pair["b"])}


def _ask(need, place, pair, width=4):
    otherwise = {"sum": jnp.full((), -1.0), "which": jnp.full((), -1, jnp.int32)}
    return masked_cond(_work, need, otherwise, place, pair, width=width)


def _batch(size, seed=0):
    rng = np.random.default_rng(seed)
    need = rng.uniform(size=size) < 0.4
    place = rng.normal(size=(size, 2))
    pair = {"a": rng.normal(size=size), "b": rng.normal(size=(size, 3))}
    real = lambda leaf: jnp.asarray(leaf, float)  # noqa: E731
    return jnp.asarray(need), real(place), jax.tree.map(real, pair)


@pytest.mark.parametrize("need", [True, False])
def test_alone_it_is_a_conditional(need):
    _, place, pair = jax.tree.map(lambda leaf: leaf[0], _batch(1))
    answer = jax.jit(_ask)(jnp.asarray(need), place, pair)
    if need:
        np.testing.assert_allclose(answer["sum"], place[0] + 2.0 * pair["a"], rtol=1e-6)
        assert answer["which"] == np.argmax(pair["b"])
    else:
        assert answer["sum"] == -1.0
        assert answer["which"] == -1


@pytest.mark.parametrize("size, width", [(1, 4), (3, 4), (33, 4), (40, 64)])
def test_in_a_batch_everyone_gets_their_own_answer(size, width):
    need, place, pair = _batch(size, seed=size)
    answer = jax.jit(jax.vmap(lambda *a: _ask(*a, width=width)))(need, place, pair)
    expected = np.where(need, place[:, 0] + 2.0 * pair["a"], -1.0)
    np.testing.assert_allclose(answer["sum"], expected, rtol=1e-6)
    np.testing.assert_array_equal(answer["which"], np.where(need, np.argmax(pair["b"], axis=1), -1))


def test_arguments_and_needs_shared_by_the_batch_are_understood():
    need, place, pair = _batch(9)
    shared = jax.tree.map(lambda leaf: leaf[0], pair)
    answer = jax.vmap(_ask, in_axes=(0, 0, None))(need, place, shared)
    np.testing.assert_allclose(
        answer["sum"], np.where(need, place[:, 0] + 2.0 * shared["a"], -1.0), rtol=1e-6
    )
    for flag in (True, False):
        answer = jax.vmap(_ask, in_axes=(None, 0, None))(jnp.asarray(flag), place, shared)
        expected = place[:, 0] + 2.0 * shared["a"] if flag else np.full(9, -1.0)
        np.testing.assert_allclose(answer["sum"], expected, rtol=1e-6)


def test_batches_of_batches_come_out_in_order():
    need, place, pair = _batch(24, seed=5)
    fold = lambda leaf: leaf.reshape(4, 6, *leaf.shape[1:])  # noqa: E731
    answer = jax.jit(jax.vmap(jax.vmap(_ask)))(fold(need), fold(place), jax.tree.map(fold, pair))
    flat = jax.jit(jax.vmap(_ask))(need, place, pair)
    np.testing.assert_allclose(answer["sum"].reshape(-1), flat["sum"], rtol=1e-6)


@pytest.mark.parametrize("needed", [0, 1, 4, 5, 40])
def test_the_cost_follows_the_number_in_need(needed):
    """Counted where it runs: in lots of four, as many as the needy fill."""
    runs = []

    def work(value):
        jax.debug.callback(lambda _: runs.append(1), value)
        return value * 2.0

    def ask(need, value):
        return masked_cond(work, need, jnp.zeros_like(value), value, width=4)

    need = jnp.arange(40) < needed
    answer = jax.jit(jax.vmap(ask))(need, jnp.arange(40.0))
    np.testing.assert_array_equal(answer, np.where(need, 2.0 * np.arange(40.0), 0.0))
    jax.effects_barrier()
    assert len(runs) == 4 * -(-needed // 4)
