"""Hazards of other people's pursuers: code JAX cannot trace, answers of the wrong shape, cheating wheels."""

import math

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from sidestep.pursuit import Pursuer, as_pursuer, make_pursuer
from sidestep.world import load_scenario


def in_numpy(scenario, world, key):
    offset = world.evader - world.pursuer[:2]
    if math.hypot(offset[0], offset[1]) < 0.1:
        return [0.0, 0.0]
    bearing = math.atan2(offset[1], offset[0]) - float(world.pursuer[2])
    speed = float(scenario.pursuer_speed)
    return np.array([-speed, speed]) if math.sin(bearing) > 0.0 else np.array([speed, -speed])


def in_jax(scenario, world, key):
    offset = world.evader - world.pursuer[:2]
    side = jnp.sin(jnp.arctan2(offset[1], offset[0]) - world.pursuer[2])
    return scenario.pursuer_speed * jnp.where(side > 0.0, jnp.array([-1.0, 1.0]), jnp.array([1.0, -1.0]))


class Learned(eqx.Module):
    weights: jax.Array

    def __call__(self, scenario, world, key):
        return self.weights


reset = jax.jit(jax.vmap(lambda scenario, key: scenario.reset(key), in_axes=(None, 0)))


def ask_many(pursuer, count=5):
    scenario, keys = load_scenario("paper"), jax.random.split(jax.random.key(0), count)
    ask = jax.jit(jax.vmap(lambda world, key: pursuer(scenario, world, key)))
    return np.asarray(ask(reset(scenario, keys), keys))


def one_world():
    scenario, key = load_scenario("paper"), jax.random.key(0)
    return scenario, jax.tree.map(lambda leaf: leaf[0], reset(scenario, key[None])), key


def test_numpy_code_works_under_jit_and_vmap_and_agrees_with_jax(precision):
    wheels = ask_many(as_pursuer(in_numpy))
    np.testing.assert_array_equal(wheels, ask_many(as_pursuer(in_jax)))
    assert wheels.dtype == (np.float64 if precision else np.float32)
    scenario, key = load_scenario("paper"), jax.random.key(0)
    np.testing.assert_array_equal(
        as_pursuer(in_numpy)(scenario, scenario.reset(key), key)[0] ** 2, wheels[0, 0] ** 2
    )


def test_numpy_code_sees_numpy_arrays_and_a_seed_that_differs_between_worlds():
    def draw(scenario, world, key):
        wheels = np.random.default_rng(key).uniform(-0.2, 0.2, 2)
        assert isinstance(world.pursuers, np.ndarray)
        assert isinstance(scenario.pursuer_speed, np.ndarray)
        return wheels

    wheels = ask_many(as_pursuer(draw))
    assert len(np.unique(wheels)) == wheels.size
    np.testing.assert_array_equal(ask_many(as_pursuer(draw)), wheels)


def test_randomness_that_ignores_the_world_is_not_frozen_by_compilation():
    draws = iter(np.linspace(-0.2, 0.2, 50))
    wheels = ask_many(as_pursuer(lambda scenario, world, key: [next(draws), 0.0]))
    assert len(np.unique(wheels[:, 0])) == len(wheels)


def test_wheels_that_cheat_are_clipped_and_nan_is_a_stop():
    np.testing.assert_array_equal(
        ask_many(as_pursuer(lambda scenario, world, key: np.array([9.0, np.nan])), 1),
        np.float32([[0.2, 0.0]]),
    )
    np.testing.assert_array_equal(
        ask_many(as_pursuer(lambda scenario, world, key: jnp.array([-jnp.inf, -9.0])), 1),
        np.float32([[0.0, -0.2]]),
    )


def test_a_learned_pursuers_weights_stay_data():
    scenario, world, key = one_world()

    @jax.jit
    @eqx.debug.assert_max_traces(max_traces=1)
    def ask(pursuer):
        return pursuer(scenario, world, key)

    for weights in ([0.1, -0.1], [0.0, 0.2]):
        np.testing.assert_array_equal(ask(as_pursuer(Learned(jnp.array(weights)))), np.float32(weights))


def test_names_and_pursuers_pass_through():
    nash = make_pursuer("nash")
    assert as_pursuer(nash) is nash
    assert isinstance(as_pursuer("interceptor"), Pursuer)
    with pytest.raises(ValueError, match="known pursuers"):
        as_pursuer("none")
    with pytest.raises(TypeError, match="pursuer"):
        as_pursuer(3)


def test_an_answer_of_the_wrong_shape_is_named():
    scenario, world, key = one_world()
    for answer in (lambda *_: jnp.zeros(3), lambda *_: np.zeros((1, 2)), lambda *_: 0.1):
        with pytest.raises(Exception, match=r"two wheel rim speeds \(left, right\), shape \(2,\); got shape"):
            as_pursuer(answer)(scenario, world, key)


def test_a_mistake_in_foreign_code_shows_itself():
    def broken(scenario, world, key):
        raise ZeroDivisionError("my own mistake")

    with pytest.raises(ZeroDivisionError, match="my own mistake"):
        as_pursuer(broken)(*one_world())
