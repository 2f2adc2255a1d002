"""Events and reward: is every contact seen, counted once and called what it is?"""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from sidestep.world import Scenario, World


def still():
    return jnp.zeros(2)


FAR_PURSUER = [[50.0, 50.0, 0.0]]
FAR_OBSTACLE = [[-50.0, 50.0, 0.0, 0.0]]
step = eqx.filter_jit(Scenario.step)


def make_world(evader=(0.0, 0.0), pursuers=FAR_PURSUER, obstacles=FAR_OBSTACLE, target=(9.0, 0.0), time=0.0):
    return World(
        evader=jnp.array(evader),
        pursuers=jnp.array(pursuers).reshape(-1, 3),
        obstacles=jnp.array(obstacles).reshape(-1, 4),
        target=jnp.array(target),
        time=jnp.array(time),
    )


def distance(a, b):
    return float(np.hypot(*(np.asarray(a)[:2] - np.asarray(b)[:2])))


def test_pursuer_that_drives_through_within_a_hold_captures(precision):
    scenario = Scenario(pursuer_speed=4.0, control_period=0.5)
    world = make_world(evader=(0.0, 0.1), pursuers=[[-1.0, 0.0, 0.0]])
    moved, events = step(scenario, world, still(), jnp.array([4.0, 4.0]))
    assert distance(world.evader, world.pursuer) > 0.2
    assert distance(moved.evader, moved.pursuer) > 0.2
    assert bool(events.captured)
    assert bool(events.terminated)
    np.testing.assert_allclose(events.pursuer_clearance, 0.1 - 0.2, atol=1e-5)


def test_pursuer_that_grazes_at_paper_speed_within_a_hold_captures(precision):
    # Head-on at 0.3574 m/s the robots pass 17.9 mm in a period: a graze of 0.1 mm lies between the ends.
    offset = 0.1999
    world = make_world(evader=(0.009, offset), pursuers=[[0.0, 0.0, 0.0]])
    moved, events = step(Scenario(), world, jnp.array([-0.1574, 0.0]), jnp.array([0.2, 0.2]))
    assert distance(world.evader, world.pursuer) > 0.2
    assert distance(moved.evader, moved.pursuer) > 0.2
    assert bool(events.captured)
    np.testing.assert_allclose(events.pursuer_clearance, offset - 0.2, atol=1e-6)


def test_turning_pursuer_that_sweeps_past_within_a_hold_captures(precision):
    # The pursuer's arc bulges toward an evader that is clear of both its ends and of the chord.
    scenario = Scenario(control_period=1.5, pursuer_speed=1.0, pursuer_half_axle=0.1)
    wheels = jnp.array([0.1, 0.4])
    world = make_world(evader=(0.33, 0.1), pursuers=[[0.0, 0.0, 0.0]])
    _, events = step(scenario, world, still(), wheels)
    t = np.linspace(0.0, 1.5, 10001)
    radius, turn_rate = 0.25 / 1.5, 1.5
    x, y = radius * np.sin(turn_rate * t), radius * (1 - np.cos(turn_rate * t))
    gaps = np.hypot(0.33 - x, 0.1 - y)
    assert gaps[0] > 0.2
    assert gaps[-1] > 0.2
    assert np.min(gaps) < 0.2
    assert bool(events.captured)
    np.testing.assert_allclose(events.pursuer_clearance, np.min(gaps) - 0.2, atol=1e-5)


def test_near_miss_is_not_a_capture(precision):
    world = make_world(evader=(0.009, 0.2001), pursuers=[[0.0, 0.0, 0.0]])
    _, events = step(Scenario(), world, jnp.array([-0.1574, 0.0]), jnp.array([0.2, 0.2]))
    assert not bool(events.captured)
    assert float(events.pursuer_clearance) > 0.0


def test_fast_obstacle_does_not_tunnel_through_the_evader(precision):
    world = make_world(obstacles=[[-1.0, 0.05, 40.0, 0.0]])
    moved, events = step(Scenario(), world, still(), jnp.zeros((1, 2)))
    assert distance(moved.evader, moved.obstacles[0]) > 0.9
    assert bool(events.collided)
    np.testing.assert_allclose(events.obstacle_clearance, 0.05 - 0.2, atol=1e-5)


def test_obstacle_moving_away_is_no_collision():
    world = make_world(obstacles=[[0.201, 0.0, 5.0, 0.0]])
    _, events = step(Scenario(), world, still(), still())
    assert not bool(events.collided)


def test_evader_that_passes_over_the_target_within_a_hold_reached_it(precision):
    scenario = Scenario(evader_speed=2.0, control_period=0.2)
    world = make_world(target=(0.2, 0.03))
    moved, events = step(scenario, world, jnp.array([2.0, 0.0]), still())
    assert distance(moved.evader, moved.target) > 0.05
    assert bool(events.reached)
    assert float(events.reward) == 1000.0


def test_any_of_several_pursuers_captures(precision):
    scenario = Scenario(pursuer_count=3)
    pursuers = [[5.0, 0.0, 0.0], [-5.0, 0.0, 0.0], [0.0, 0.205, -np.pi / 2]]
    _, events = step(scenario, make_world(pursuers=pursuers), still(), jnp.full((3, 2), 0.2))
    assert bool(events.captured)
    for third in (0, 1):
        wheels = jnp.full((3, 2), 0.2).at[2].set(-0.2)
        _, events = step(scenario, make_world(pursuers=pursuers), still(), wheels)
        assert not bool(events.captured), third


def test_each_pursuer_obeys_its_own_wheels():
    scenario = Scenario(pursuer_count=2)
    world = make_world(pursuers=[[1.0, 0.0, 0.0], [2.0, 0.0, 0.0]])
    moved, _ = step(scenario, world, still(), jnp.array([[0.2, 0.2], [0.0, 0.0]]))
    np.testing.assert_allclose(moved.pursuers, [[1.01, 0.0, 0.0], [2.0, 0.0, 0.0]], atol=1e-6)
    np.testing.assert_allclose(moved.wheel_speeds, [[0.2, 0.2], [0.0, 0.0]], atol=1e-7)


def test_any_of_several_obstacles_collides():
    scenario = Scenario(obstacle_count=3)
    obstacles = np.array([[5.0, 0, 0, 0], [0.0, 0.19, 0, 0], [3.0, 0, 0, 0]])
    _, events = step(scenario, make_world(obstacles=obstacles), still(), still())
    assert bool(events.collided)
    assert not bool(events.captured)


def test_no_obstacle_means_infinite_clearance():
    _, events = step(Scenario(obstacle_count=0), make_world(obstacles=[]), still(), still())
    assert np.isposinf(float(events.obstacle_clearance))
    assert not bool(events.collided)


def test_reward_is_the_papers(precision):
    world = make_world(target=(1.0, 0.0))
    _, events = step(Scenario(), world, jnp.array([0.1, 0.0]), still())
    np.testing.assert_allclose(events.reward, -0.01 * (1.0 - 0.1 * 0.05), rtol=1e-6)
    assert not bool(events.reached)
    _, events = step(Scenario(), make_world(target=(0.055, 0.0)), jnp.array([0.1574, 0.0]), still())
    assert bool(events.reached)
    assert float(events.reward) == 1000.0


def test_reward_of_a_capture_has_no_bonus():
    world = make_world(target=(0.01, 0.0), pursuers=[[0.1, 0.0, 0.0]])
    _, events = step(Scenario(), world, still(), still())
    assert bool(events.captured)
    assert not bool(events.reached)
    assert float(events.reward) <= 0.0


def test_capture_and_collision_at_once_are_both_reported():
    world = make_world(pursuers=[[0.1, 0.0, 0.0]], obstacles=[[-0.1, 0.0, 0.0, 0.0]])
    _, events = step(Scenario(), world, still(), still())
    assert bool(events.captured)
    assert bool(events.collided)
    assert not bool(events.reached)
    assert not bool(events.timed_out)


@pytest.mark.parametrize("what", ["captured", "reached", "collided"])
def test_last_period_is_no_timeout_when_something_happened(what):
    world = make_world(
        time=0.05 * 4999,
        target=(0.01, 0.0) if what == "reached" else (9.0, 0.0),
        pursuers=[[0.1, 0.0, 0.0]] if what == "captured" else FAR_PURSUER,
        obstacles=[[0.1 if what == "collided" else 9.0, 0.0, 0.0, 0.0]],
    )
    _, events = step(Scenario(), world, still(), still())
    assert bool(getattr(events, what))
    assert bool(events.terminated)
    assert not bool(events.timed_out)
    assert not bool(events.truncated)


def test_time_limit_truncates_and_never_terminates():
    _, events = step(Scenario(), make_world(time=0.05 * 4999), still(), still())
    assert bool(events.timed_out)
    assert bool(events.truncated)
    assert not bool(events.terminated)


@eqx.filter_jit
def run_to_the_limit(scenario, world):
    def one(world, _):
        moved, events = scenario.step(world, still(), still())
        return moved, (events.timed_out, moved.time)

    return jax.lax.scan(one, world, None, length=scenario.episode_steps + 1)[1]


@pytest.mark.parametrize("period", [0.05, 0.01, 1 / 30, 0.1, 0.5, 0.0007])
def test_time_limit_falls_on_the_very_step(period, precision):
    timed_out, time = run_to_the_limit(Scenario(control_period=period), make_world())
    assert np.flatnonzero(timed_out)[0] == 5000 - 1
    np.testing.assert_allclose(time[4999], 5000 * period, rtol=1e-6)


@pytest.mark.parametrize("steps", [1, 2_000_000])
def test_time_limit_of_short_and_very_long_episodes(steps):
    scenario = Scenario(episode_steps=steps)
    for before, expected in ((1, True), (2, False)):
        if steps >= before:
            world = make_world(time=np.float32(0.05) * np.float32(steps - before))
            _, events = step(scenario, world, still(), still())
            assert bool(events.timed_out) == expected


@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf])
def test_non_finite_commands_never_enter_the_state(bad, precision):
    world = make_world(obstacles=[[1.0, 0.0, 0.02, 0.0]], pursuers=[[1.0, 1.0, 0.0]])
    for action, wheels in (([bad, 0.1], [0.1, 0.1]), ([0.1, 0.1], [bad, 0.1]), ([bad, bad], [bad, bad])):
        moved, events = step(Scenario(), world, jnp.array(action), jnp.array(wheels))
        for leaf in jax.tree.leaves((moved, events)):
            assert np.all(np.isfinite(np.asarray(leaf, float)))


@pytest.mark.parametrize("action", ["velocity", "heading"])
def test_robot_never_exceeds_its_speed(action, precision):
    commands = np.random.default_rng(1).normal(size=(500, 2)) * 10.0 ** np.linspace(-25, 14, 500)[:, None]
    driven = eqx.filter_jit(eqx.filter_vmap(Scenario.executable, in_axes=(None, 0)))(
        Scenario(action=action), jnp.asarray(commands, dtype=float)
    )
    speeds = np.hypot(*np.asarray(driven, float).T)
    assert np.max(speeds) <= 0.1574 * (1 + 3e-7)
    if action == "heading":
        np.testing.assert_allclose(speeds, 0.1574, rtol=1e-6)
        turn = np.arctan2(*np.asarray(driven).T) - np.arctan2(*commands.T)
        np.testing.assert_allclose(np.cos(turn), 1.0, atol=1e-6)


def test_heading_mode_keeps_its_speed_when_told_to_stop(precision):
    scenario = Scenario(action="heading")
    np.testing.assert_allclose(scenario.executable(still()), [0.1574, 0.0], rtol=1e-6)
    np.testing.assert_allclose(scenario.executable(jnp.array([np.nan, 0.1])), [0.1574, 0.0], rtol=1e-6)


def test_world_records_what_was_executed_not_what_was_asked():
    moved, _ = step(Scenario(), make_world(), jnp.array([3.0, 4.0]), jnp.array([5.0, -5.0]))
    np.testing.assert_allclose(moved.evader_velocity, 0.1574 * np.array([0.6, 0.8]), rtol=1e-6)
    np.testing.assert_allclose(moved.wheel_speeds, [[0.2, -0.2]], rtol=1e-6)
    np.testing.assert_allclose(moved.evader, 0.05 * 0.1574 * np.array([0.6, 0.8]), rtol=1e-5)


def test_obstacle_drifts_at_its_velocity_and_target_stays():
    world = make_world(obstacles=[[1.0, 2.0, 0.02, -0.01]])
    moved, _ = step(Scenario(), world, still(), still())
    np.testing.assert_allclose(moved.obstacles, [[1.001, 1.9995, 0.02, -0.01]], rtol=1e-6)
    np.testing.assert_array_equal(moved.target, world.target)


@eqx.filter_jit
def slopes(scenario, world, action, wheels):
    def total(parts):
        scenario, action, wheels = parts
        moved, events = scenario.step(world, action, wheels)
        return events.reward + events.pursuer_clearance + events.obstacle_clearance + jnp.sum(moved.evader)

    return eqx.filter_grad(total)((scenario, action, wheels))


def test_gradient_of_a_step_is_never_nan(precision):
    for evader in ((0.0, 0.0), (2.0, 2.0), (1.0, 1.0)):  # apart, on the target, in contact
        world = make_world(
            evader=evader, target=(2.0, 2.0), pursuers=[[1.0, 1.0, 0.3]], obstacles=[[1.0, 1.0, 0.0, 0.0]]
        )
        for action in ([0.0, 0.0], [0.1, 0.05]):
            for leaf in jax.tree.leaves(slopes(Scenario(), world, jnp.array(action), jnp.array([0.1, 0.1]))):
                assert np.all(np.isfinite(leaf))
