"""Every preset in every mode: does one step work under jit, vmap and both precisions?"""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from sidestep.world import PRESETS, Scenario, World, load_scenario, observation_size, observe, to_velocity


@eqx.filter_jit
def episode(scenario, keys, steps=40):
    """Random actions and wheels in a batch of worlds: everything seen on the way."""

    def one(key):
        start_key, walk_key = jax.random.split(key)

        def period(world, key):
            action_key, wheel_key = jax.random.split(key)
            observation = observe(scenario, world)
            action = jax.random.uniform(action_key, (2,), dtype=float, minval=-1.0, maxval=1.0)
            wheels = 0.3 * jax.random.normal(wheel_key, (scenario.pursuer_count, 2), dtype=float)
            moved, events = scenario.step(world, to_velocity(scenario, world, action), wheels)
            return moved, (observation, moved, events)

        return jax.lax.scan(period, scenario.reset(start_key), jax.random.split(walk_key, steps))[1]

    return jax.vmap(one)(keys)


MODES = [
    {"action": "heading", "frame": "world", "obstacle_count": 0},
    {"pursuer_count": 3, "obstacle_count": 8, "obstacle_directions": "random"},
]


@pytest.mark.parametrize("preset", PRESETS)
def test_every_preset(preset):
    check_episodes(load_scenario(preset), np.float32)


def test_double_precision(x64):
    check_episodes(Scenario(), np.float64)


@pytest.mark.parametrize("mode", MODES, ids=lambda mode: "-".join(map(str, mode.values())))
def test_every_mode(mode):
    check_episodes(Scenario(**mode), np.float32)


def check_episodes(scenario, dtype):
    observations, worlds, events = episode(scenario, jax.random.split(jax.random.key(1), 30))
    assert observations.shape == (30, 40, observation_size(scenario))
    for leaf in jax.tree.leaves((observations, worlds, events.reward)):
        assert np.all(np.isfinite(leaf))
    for leaf in jax.tree.leaves((observations, worlds, events.reward, events.pursuer_clearance)):
        assert leaf.dtype == dtype
    speed = np.linalg.norm(worlds.evader_velocity, axis=-1)
    # One with mass has sums of exponentials to round.
    rounding = 3e-7 if scenario.evader_model is None else 3e-6
    assert np.all(speed <= float(scenario.evader_speed) * (1 + rounding))
    if scenario.action == "heading":
        np.testing.assert_allclose(speed, 0.1574, rtol=1e-6)
    if scenario.pursuer_model is None:
        assert np.all(np.abs(worlds.wheel_speeds) <= np.asarray(scenario.pursuer_speed))
    heading = np.asarray(worlds.pursuers[..., 2])
    assert np.all((heading >= -np.pi - 1e-6) & (heading < np.pi + 1e-6))
    np.testing.assert_allclose(worlds.time, np.broadcast_to(0.05 * np.arange(1, 41), (30, 40)), rtol=1e-5)
    # At most one of reached, timed out and contact; terminated and truncated never together.
    contact = events.captured | events.collided
    assert not np.any(events.reached & contact)
    assert not np.any(events.terminated & events.truncated)
    np.testing.assert_array_equal(events.terminated, contact | events.reached)
    np.testing.assert_array_equal(events.captured, events.pursuer_clearance <= 0.0)
    np.testing.assert_array_equal(events.collided, events.obstacle_clearance <= 0.0)
    assert np.all(np.asarray(events.reward)[~np.asarray(events.reached)] < 0.0)


def test_single_precision_follows_double():
    steps, runs = 40, []
    for wide in (False, True):
        with jax.enable_x64(wide):
            scenario = Scenario()

            @eqx.filter_jit
            def run(scenario, world):
                def period(world, index):
                    angle = 0.1 * index.astype(float)
                    action = 0.15 * jnp.stack([jnp.cos(angle), jnp.sin(angle)])
                    wheels = 0.2 * jnp.stack([jnp.sin(angle), jnp.cos(angle)])
                    moved, events = scenario.step(world, action, wheels)
                    return moved, (moved, events.pursuer_clearance)

                return jax.lax.scan(period, world, jnp.arange(steps))[1]

            start = World(
                evader=np.array([0.0, 0.1]),
                pursuers=np.array([[1.0, -0.5, 0.3]]),
                obstacles=np.array([[1.5, 0.0, 0.02, 0.0]]),
                target=np.array([2.5, 0.0]),
            )
            worlds, clearance = run(scenario, start)
            runs.append([np.asarray(part, float) for part in (worlds.evader, worlds.pursuers, clearance)])
    for narrow, wide in zip(*runs, strict=True):
        np.testing.assert_allclose(narrow, wide, atol=3e-6)


def test_scenarios_can_be_batched_over_their_constants():
    world = Scenario().reset(jax.random.key(0))
    speeds = jnp.array([0.1, 0.2, 0.3])
    scenarios = eqx.filter_vmap(lambda speed: Scenario(evader_speed=speed))(speeds)
    step = eqx.filter_vmap(
        lambda scenario: scenario.step(world, jnp.array([1.0, 0.0]), jnp.zeros(2)), in_axes=(eqx.if_array(0),)
    )
    moved, _ = eqx.filter_jit(step)(scenarios)
    np.testing.assert_allclose(
        moved.evader[:, 0] - world.evader[0], 0.05 * np.array([0.1, 0.2, 0.3]), rtol=1e-4
    )


def test_asking_for_another_pursuer_puts_it_first():
    world = load_scenario("paper", pursuer_count=3).reset(jax.random.key(0))
    for index in range(3):
        seen = world.seen_by(index)
        np.testing.assert_array_equal(seen.pursuer, world.pursuers[index])
        np.testing.assert_array_equal(np.sort(seen.pursuers, axis=0), np.sort(world.pursuers, axis=0))
        np.testing.assert_array_equal(seen.evader, world.evader)
