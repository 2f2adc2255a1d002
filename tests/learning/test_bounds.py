"""Hazard: an actor that learns through a filter which is not the robot's: another world's, or one of NaNs."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from sidestep._arrays import real
from sidestep.learning.bounds import on_disc, through_shield
from sidestep.learning.networks import Actor, TwinCritic
from sidestep.learning.replay import mirror_world
from sidestep.learning.td3 import actor_loss
from sidestep.safety import GameShield, as_shield
from sidestep.safety.shields.joint import JointShield
from sidestep.world import World, load_scenario, observation_size, observe

KEY = jax.random.key(0)
FLIP = np.array([1.0, -1.0], np.float32)
COUNT = 256


def crowded_worlds(count, seed):
    """Worlds with pursuer and obstacle so close that many actions have to be corrected."""
    rng = np.random.default_rng(seed)

    def around(least, most):
        angle, distance = rng.uniform(-np.pi, np.pi, count), rng.uniform(least, most, count)
        return np.stack([distance * np.cos(angle), distance * np.sin(angle)], axis=-1)

    heading = rng.uniform(-np.pi, np.pi, (count, 1))
    drift = rng.uniform(-0.03, 0.03, (count, 2))
    return jax.vmap(World)(
        real(np.zeros((count, 2))),
        real(np.concatenate([around(0.26, 0.5), heading], axis=-1))[:, None],
        real(np.concatenate([around(0.22, 0.4), drift], axis=-1))[:, None],
        real(around(0.5, 2.0)),
    )


def actions_of(count, seed, largest=2.0):
    """Random actions in [-1, 1]^2, of norm at most `largest`."""
    actions = np.random.default_rng(seed).uniform(-1.0, 1.0, (count, 2))
    length = np.linalg.norm(actions, axis=-1, keepdims=True)
    return real(actions * np.minimum(1.0, largest / length))


def answer_and_slopes(worlds, actions):
    """Answers (n, 2) of the filter, and their derivatives (n, 2, 2), taken backwards as in training."""
    return _answer_and_slopes(load_scenario("paper"), worlds, actions)


@eqx.filter_jit
def _answer_and_slopes(scenario, worlds, actions):
    bound = through_shield(scenario, as_shield("game", scenario), worlds)
    answer, pull = jax.vjp(lambda a: bound(a, KEY), actions)
    units = jnp.broadcast_to(jnp.eye(2, dtype=actions.dtype)[:, None], (2, *actions.shape))
    return answer, jnp.moveaxis(jax.vmap(pull)(units)[0], 0, 1)


def test_filter_of_the_mirrored_world_is_the_filter_seen_in_a_mirror():
    worlds, actions = crowded_worlds(COUNT, 0), actions_of(COUNT, 1)
    plain, slopes = answer_and_slopes(worlds, actions)
    mirrored, slopes_mirrored = answer_and_slopes(jax.vmap(mirror_world)(worlds), actions * FLIP)
    np.testing.assert_allclose(mirrored, plain * FLIP, atol=1e-4)
    np.testing.assert_allclose(slopes_mirrored, slopes * FLIP * FLIP[:, None], atol=1e-3)
    unmoved = np.linalg.norm(plain - on_disc(actions, KEY), axis=-1) < 1e-3
    assert 0.1 < np.mean(unmoved) < 0.7


def test_derivative_passes_along_rows_and_not_across_them():
    """Inside the disc the answer is a projection: on all of the plane, on a line, or on a corner."""
    actions = actions_of(COUNT, 3, 0.999)
    answer, slopes = (np.asarray(x) for x in answer_and_slopes(crowded_worlds(COUNT, 2), actions))
    np.testing.assert_allclose(slopes, np.swapaxes(slopes, 1, 2), atol=1e-4)
    np.testing.assert_allclose(slopes @ slopes, slopes, atol=1e-4)
    rank = np.trace(slopes, axis1=1, axis2=2).round().astype(int)
    moved = np.linalg.norm(answer - actions, axis=-1) > 1e-5
    np.testing.assert_array_equal(rank < 2, moved)
    assert min(np.mean(rank == n) for n in (0, 1, 2)) > 0.05


def test_derivative_is_finite_wherever_the_robots_are():
    """One NaN in a batch of 256 would end the training."""
    here = (0.0, 0.0)
    places = [
        # pursuer, obstacle, target
        ((0.4, 0.0, np.pi), (0.0, 0.5), (1.0, 0.0)),  # straight ahead of the pursuer
        ((0.2, 0.0, np.pi), (0.0, 0.2), (1.0, 0.0)),  # at the tip of the capture set, touching
        ((0.25, 0.0, np.pi), (-0.21, 0.0), (1.0, 0.0)),  # between the two: nothing keeps both rows
        ((0.1, 0.0, 0.3), (0.05, 0.0), (1.0, 0.0)),  # captured and collided
        ((*here, 0.7), here, here),  # all in one place
        ((30.0, 0.0, 0.0), (-30.0, 0.0), (1.0, 0.0)),  # nobody near
    ]
    asked = [(0, 0), (1, 0), (0, -1), (1, 1), (-1, 1), (0.6, 0.8), (1e-30, 0), (1e-3, -0.9999999)]
    # To the width that is compiled already.
    pairs = [(place, action) for place in places for action in asked for _ in range(6)][:COUNT]
    worlds = [World(real(here), real([p]), real([[*o, 0.02, 0.0]]), real(t)) for (p, o, t), _ in pairs]
    worlds = jax.tree.map(lambda *leaves: jnp.stack(leaves), *worlds)
    answer, slopes = answer_and_slopes(worlds, real([action for _, action in pairs]))
    assert len(pairs) == COUNT
    assert np.all(np.isfinite(answer))
    assert np.all(np.isfinite(slopes))
    assert np.max(np.linalg.norm(answer, axis=-1)) <= 1.0 + 1e-5
    # A projection never moves the answer further than the action moved.
    assert np.max(np.linalg.norm(slopes, ord=2, axis=(1, 2))) <= 1.0 + 1e-4


def test_actor_gradient_through_the_filter_is_the_slope_of_the_actor_loss(x64):
    scenario = load_scenario("paper")
    worlds, size = crowded_worlds(64, 4), observation_size(scenario)
    actor = Actor(size, 2, (8,), jax.random.key(1), last_scale=3.0)
    critic = TwinCritic(size, 2, (8,), jax.random.key(2))
    seen = jax.vmap(lambda world: observe(scenario, world))(worlds)
    bound = through_shield(scenario, as_shield("game", scenario), worlds)
    value_and_slope = jax.jit(jax.value_and_grad(lambda x: actor_loss(x, critic, seen, bound, KEY)))
    unfiltered = jax.jit(jax.grad(lambda x: actor_loss(x, critic, seen, on_disc, KEY)))

    def flat(tree):
        return np.concatenate([np.ravel(leaf) for leaf in jax.tree.leaves(tree)])

    gradient, other = flat(value_and_slope(actor)[1]), flat(unfiltered(actor))
    assert np.linalg.norm(gradient - other) > 0.1 * np.linalg.norm(other), "the filter does nothing here"
    rng, step = np.random.default_rng(5), 1e-6
    for _ in range(4):
        way = jax.tree.map(lambda leaf: real(rng.normal(size=leaf.shape)), actor)
        ahead, back = (
            jax.tree.map(lambda leaf, d, s=sign: leaf + s * step * d, actor, way) for sign in (1.0, -1.0)
        )
        slope = float(value_and_slope(ahead)[0] - value_and_slope(back)[0]) / (2.0 * step)
        assert slope == pytest.approx(float(np.sum(gradient * flat(way))), rel=1e-5, abs=1e-8)


def test_joint_is_learned_through_by_its_rows_alone():
    """An imagined chase for every world of every batch would cost more than the whole training."""
    scenario = load_scenario("paper")
    joint = JointShield(scenario)
    faster = eqx.tree_at(lambda s: s.pursuer_gain, scenario, joint.pursuer_gain)
    rows = GameShield(faster, nominal_picks_side=True)
    worlds, actions = crowded_worlds(2, 6), actions_of(2, 7)
    ours, theirs = (
        jax.make_jaxpr(lambda w, a, s=shield: through_shield(scenario, s, w)(a, KEY))(worlds, actions)
        for shield in (joint, rows)
    )
    assert str(ours) == str(theirs)
    # The constants too, the pursuer gain of the look-ahead's rows among them.
    for one, other in zip(ours.consts, theirs.consts, strict=True):
        np.testing.assert_array_equal(one, other)
    assert float(joint.rows_only.scenario.pursuer_gain) == float(joint.pursuer_gain)
    assert float(joint.pursuer_gain) != float(scenario.pursuer_gain)
    assert as_shield("game", scenario).rows_only.scenario is scenario
