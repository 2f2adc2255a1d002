"""Resets: may every episode be won, is every start legal, and is the same seed the same start?"""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from sidestep.world import Scenario, load_scenario
from sidestep.world.capture_geometry import capture_set_distance, to_pursuer_frame

COUNTS = [(1, 1), (1, 0), (1, 8), (3, 1)]


@eqx.filter_jit
def many(scenario, seed, count=2000):
    return jax.vmap(scenario.reset)(jax.random.split(jax.random.key(seed), count))


def gaps(points, others):
    """Distances (n, k) from points (n, 2) to others (n, k, 2)."""
    return np.linalg.norm(np.asarray(others) - np.asarray(points)[:, None, :], axis=-1)


@pytest.mark.parametrize("pursuers, obstacles", COUNTS)
def test_no_start_is_lost_or_illegal(pursuers, obstacles):
    scenario = Scenario(pursuer_count=pursuers, obstacle_count=obstacles)
    worlds = many(scenario, 3)
    assert worlds.pursuers.shape == (2000, pursuers, 3)
    assert worlds.obstacles.shape == (2000, obstacles, 4)
    bound = 1.5 + 1e-6
    for places in (worlds.evader, worlds.target, worlds.pursuers[..., :2], worlds.obstacles[..., :2]):
        assert np.all(np.abs(places) <= bound)
    assert np.all(np.abs(worlds.pursuers[..., 2]) <= np.pi + 1e-6)
    assert np.all(gaps(worlds.evader, worlds.pursuers[..., :2]) >= 0.6 - 1e-6)
    assert np.all(gaps(worlds.evader, worlds.target[:, None]) >= 0.5 - 1e-6)
    if obstacles:
        assert np.all(gaps(worlds.evader, worlds.obstacles[..., :2]) >= 0.3 - 1e-6)
        assert np.all(gaps(worlds.target, worlds.obstacles[..., :2]) > 0.2 - 1e-6)
        np.testing.assert_allclose(
            worlds.obstacles[..., 2:], np.broadcast_to([0.02, 0.0], (2000, obstacles, 2))
        )
    for start in (worlds.time, worlds.evader_velocity, worlds.wheel_speeds):
        assert not np.any(start)


def test_nobody_starts_inside_the_capture_set():
    # So small a separation that only the rule against instant capture keeps starts apart.
    scenario = Scenario(initial_separation=0.0, arena_side=1.2, target_separation=0.1)
    worlds = many(scenario, 5)
    z = jax.vmap(to_pursuer_frame)(worlds.evader, worlds.pursuers[:, 0])
    h = jax.vmap(capture_set_distance, in_axes=(0, None, None))(
        z, scenario.usable_angle, scenario.capture_distance
    )
    assert np.all(np.asarray(h) > 0.0)
    distances = np.hypot(*np.asarray(z).T)
    assert np.min(distances) < 0.24
    # K reaches l/rho = 0.254 m ahead of the pursuer, farther than the capture distance 0.2 m.
    ahead = np.abs(np.asarray(z)[:, 1]) < 0.01
    assert np.all(distances[ahead] > 0.23)


def test_capture_set_is_the_hull_of_disc_and_tips(precision):
    usable = jnp.arccos(jnp.array(0.787))
    for z, expected in (
        ((0.2 / 0.787, 0.0), 0.0),
        ((-0.2 / 0.787, 0.0), 0.0),
        ((0.0, 0.2), 0.0),
        ((0.0, -0.3), 0.1),
        ((0.0, 0.0), -0.2),
        ((0.5, 0.0), 0.5 * 0.787 - 0.2),
    ):
        h = capture_set_distance(jnp.array(z), usable, jnp.array(0.2))
        np.testing.assert_allclose(h, expected, atol=1e-6)


def test_capture_set_of_a_faster_evader_is_the_disc(precision):
    scenario = Scenario(evader_speed=0.5)
    assert float(scenario.usable_angle) == 0.0
    for z in ([0.21, 0.0], [0.0, 0.21], [-0.15, 0.15]):
        h = capture_set_distance(jnp.array(z), scenario.usable_angle, scenario.capture_distance)
        np.testing.assert_allclose(h, np.hypot(*z) - 0.2, atol=1e-6)


def test_starts_spread_over_the_square():
    worlds = many(Scenario(), 11)
    for places in (worlds.evader, worlds.target, worlds.pursuers[:, 0, :2], worlds.obstacles[:, 0, :2]):
        places = np.asarray(places)
        quadrant = (places[:, 0] > 0) * 2 + (places[:, 1] > 0)
        assert np.min(np.bincount(quadrant, minlength=4)) > 350
    headings = np.asarray(worlds.pursuers[:, 0, 2])
    assert np.min(np.histogram(headings, bins=8, range=(-np.pi, np.pi))[0]) > 150


def test_same_key_same_start_and_other_key_other_start():
    first, again, other = (many(Scenario(), seed) for seed in (3, 3, 4))
    for a, b in zip(jax.tree.leaves(first), jax.tree.leaves(again), strict=True):
        np.testing.assert_array_equal(a, b)
    assert not np.any(np.all(np.asarray(first.evader) == np.asarray(other.evader), axis=-1))
    assert len(np.unique(np.asarray(first.evader), axis=0)) == 2000


def test_a_start_does_not_depend_on_the_batch_it_is_drawn_in():
    key = jax.random.split(jax.random.key(3), 2000)[7]
    alone = eqx.filter_jit(Scenario.reset)(Scenario(), key)
    batched = jax.tree.map(lambda leaf: leaf[7], many(Scenario(), 3))
    for a, b in zip(jax.tree.leaves(alone), jax.tree.leaves(batched), strict=True):
        np.testing.assert_array_equal(a, b)


def test_fixed_scene_starts_where_it_says():
    world = load_scenario("paper-test").reset(jax.random.key(0))
    np.testing.assert_allclose(world.evader, [0.0, 0.0])
    np.testing.assert_allclose(world.obstacles, [[1.5, 0.0, 0.02, 0.0]], rtol=1e-6)
    np.testing.assert_allclose(world.pursuers, [[1.0, -0.5, 0.0]])
    np.testing.assert_allclose(world.target, [2.5, 0.0])


def test_fixed_evader_draws_the_rest_around_it():
    scenario = Scenario(evader_start=jnp.array([1.0, -1.0]))
    worlds = many(scenario, 9, 200)
    np.testing.assert_array_equal(np.unique(worlds.evader, axis=0), [[1.0, -1.0]])
    assert np.all(gaps(worlds.evader, worlds.pursuers[..., :2]) >= 0.6 - 1e-6)
    assert len(np.unique(worlds.pursuers[:, 0, 0])) == 200


def test_random_drift_keeps_its_speed_and_turns_every_way():
    scenario = Scenario(obstacle_directions="random", obstacle_velocity=(0.03, 0.04))
    drift = np.asarray(many(scenario, 2).obstacles[:, 0, 2:])
    np.testing.assert_allclose(np.hypot(*drift.T), 0.05, rtol=1e-5)
    assert np.min(np.histogram(np.arctan2(*drift.T), bins=8, range=(-np.pi, np.pi))[0]) > 150


def test_an_adversarial_obstacle_heads_for_where_the_evader_will_be():
    scenario = Scenario(obstacle_motion="adversarial", obstacle_velocity=(0.03, 0.04), obstacle_count=2)
    worlds, velocity = many(scenario, 20), jnp.array([0.1, -0.05])
    wheels = jnp.zeros((1, 2))
    moved, _ = eqx.filter_jit(jax.vmap(lambda world: scenario.step(world, velocity, wheels)))(worlds)
    aim = np.asarray(moved.evader[:, None] - worlds.obstacles[..., :2])
    expected = 0.05 * aim / np.linalg.norm(aim, axis=-1, keepdims=True)
    np.testing.assert_allclose(moved.obstacles[..., 2:], expected, atol=1e-6)
    step = np.asarray(moved.obstacles[..., :2] - worlds.obstacles[..., :2])
    np.testing.assert_allclose(step, 0.05 * expected, atol=1e-6)
    # Where it already is at that place it does not move, and nothing is divided by zero.
    there = jax.tree.map(lambda leaf: leaf[0], worlds)
    there = eqx.tree_at(lambda w: w.obstacles, there, there.obstacles.at[:, :2].set(there.evader))
    still, _ = eqx.filter_jit(scenario.step)(there, jnp.zeros(2), wheels)
    np.testing.assert_array_equal(still.obstacles[:, :2], there.obstacles[:, :2])


def test_reset_ends_even_where_no_start_exists():
    impossible = eqx.tree_at(lambda s: s.initial_separation, Scenario(), jnp.array(100.0))
    world = eqx.filter_jit(Scenario.reset)(impossible, jax.random.key(0))
    assert np.all(np.isfinite(world.evader))
    assert not bool(impossible.accepts(world))
