"""Batch axes behind the components must give what one world at a time gives."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from sidestep.pursuit import PURSUERS, make_pursuer, pursue
from sidestep.safety import SHIELDS, GameShield, Status, make_shield, project
from sidestep.safety.filter.projection import project_known
from sidestep.world import load_scenario

LANES = (3, 5)


def _in_lanes(tree):
    """A batch of 15 in front as lanes (3, 5) behind."""
    return jax.tree.map(lambda leaf: jnp.moveaxis(leaf, 0, -1).reshape(*leaf.shape[1:], *LANES), tree)


def _worlds(scenario):
    """Fifteen starts, each at another time."""
    worlds = jax.vmap(scenario.reset)(jax.random.split(jax.random.key(5), 15))
    return eqx.tree_at(lambda w: w.time, worlds, 0.3 * jnp.arange(15.0))


def _near(scenario):
    """Everything drawn closer to the evader, so that rows are active, and some cannot all be kept."""
    worlds = _worlds(scenario)
    closer = lambda group: group.at[..., :2].multiply(0.25)  # noqa: E731
    return eqx.tree_at(
        lambda w: (w.evader, w.pursuers, w.obstacles),
        worlds,
        (0.25 * worlds.evader, closer(worlds.pursuers), closer(worlds.obstacles)),
    )


def _close(one, other):
    for a, b in zip(jax.tree.leaves(one), jax.tree.leaves(other), strict=True):
        np.testing.assert_allclose(a, b, rtol=2e-5, atol=2e-6)


@pytest.mark.parametrize("name", [*(name for name, kind in PURSUERS.items() if kind.takes_lanes), "mixed"])
def test_pursuers_and_motion(name):
    scenario, key = load_scenario("paper", pursuer_count=2, obstacle_count=2), jax.random.key(0)
    worlds, pursuer = _worlds(scenario), make_pursuer(name)
    velocity = 0.1 * jax.random.normal(key, (15, 2))

    def move(world, velocity):
        return scenario.moved(world, velocity, pursue(scenario, pursuer, world, key))

    _close(
        jax.jit(move)(_in_lanes(worlds), _in_lanes(velocity)),
        _in_lanes(jax.jit(jax.vmap(move))(worlds, velocity)),
    )


@pytest.mark.parametrize("name", SHIELDS)
def test_every_shield_that_takes_lanes(name):
    scenario = load_scenario("paper", pursuer_count=2, obstacle_count=2)
    shield, worlds = make_shield(name, scenario), _near(scenario)
    if not shield.takes_lanes:
        pytest.skip("asked for each world in turn")
    wish = 0.2 * jax.random.normal(jax.random.key(1), (15, 2))

    def answer(world, wish):
        return shield(world, wish, shield.init(world))

    expected = _in_lanes(jax.jit(jax.vmap(answer))(worlds, wish))
    _close(jax.jit(answer)(_in_lanes(worlds), _in_lanes(wish)), expected)


@pytest.mark.parametrize("fields", [{}, {"action": "heading"}, {"pursuer_count": 2, "obstacle_count": 3}])
def test_shield_and_its_short_form(fields):
    scenario = load_scenario("paper", **fields)
    shield, worlds = GameShield(scenario), _near(scenario)
    wish = 0.11 * jax.random.normal(jax.random.key(1), (15, 2)).clip(-1.0, 1.0)
    memory = jax.vmap(shield.init)(worlds)
    expected = _in_lanes(eqx.filter_jit(jax.vmap(shield.__call__))(worlds, wish, memory))
    result = eqx.filter_jit(shield.__call__)(_in_lanes(worlds), _in_lanes(wish), _in_lanes(memory))
    _close(result, expected)
    assert np.sum(np.asarray(expected[0].status) == Status.CORRECTED) >= 2
    short = eqx.filter_jit(shield.filter_unchecked)(_in_lanes(worlds), _in_lanes(wish), _in_lanes(memory))
    _close(short, (expected[0].action, expected[1]))


@pytest.mark.parametrize("hard, circle", [(0, True), (1, False)])
def test_filter_with_more_rows_than_can_be_kept(hard, circle):
    count, lanes = 5, 200
    keys = jax.random.split(jax.random.key(2), 3)
    angles = jax.random.uniform(keys[0], (count, lanes), minval=-3.0, maxval=3.0)
    normals = jnp.stack([jnp.cos(angles), jnp.sin(angles)], axis=1)
    offsets = jax.random.uniform(keys[1], (count, lanes), minval=-0.9, maxval=0.5)
    wish = jax.random.uniform(keys[2], (2, lanes), minval=-0.7, maxval=0.7)
    solve = lambda *rows: project(*rows, 1.0, hard=hard, circle=circle)  # noqa: E731
    each = jax.jit(jax.vmap(solve, in_axes=-1))(wish, normals, offsets)
    together = jax.jit(solve)(wish, normals, offsets)
    _close(together, jax.tree.map(lambda leaf: jnp.moveaxis(leaf, 0, -1), each))
    assert 20 < np.sum(np.asarray(together.status) == Status.INFEASIBLE) < lanes - 20
    known = jax.jit(lambda *rows: project_known(*rows, jnp.ones(()), hard=hard, circle=circle))
    _close(known(wish, normals, offsets), together.action)
