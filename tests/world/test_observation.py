"""Observation: does the policy see what is there, in axes of its own, and mean what it says?"""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from sidestep.world import (
    Scenario,
    World,
    goal_seeking,
    goal_seeking_world,
    observation_names,
    observation_size,
    observe,
    to_action,
    to_velocity,
)

see = eqx.filter_jit(observe)
drive_at = eqx.filter_jit(to_velocity)


def random_world(seed, pursuers=2, obstacles=3):
    rng = np.random.default_rng(seed)
    return World(
        evader=jnp.asarray(rng.uniform(-1, 1, 2), dtype=float),
        pursuers=jnp.asarray(rng.uniform(-2, 2, (pursuers, 3)), dtype=float),
        obstacles=jnp.asarray(rng.uniform(-2, 2, (obstacles, 4)), dtype=float),
        target=jnp.asarray(rng.uniform(-2, 2, 2), dtype=float),
        wheel_speeds=jnp.asarray(rng.uniform(-0.2, 0.2, (pursuers, 2)), dtype=float),
    )


def rotation(angle):
    return np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])


def moved_world(world, angle, shift):
    """The same world seen by someone who stands elsewhere and looks another way."""
    turn = rotation(angle)
    place = lambda points: jnp.asarray(np.asarray(points) @ turn.T + shift, dtype=float)  # noqa: E731
    return World(
        evader=place(world.evader),
        pursuers=jnp.concatenate([place(world.pursuers[:, :2]), world.pursuers[:, 2:] + angle], axis=1),
        obstacles=jnp.concatenate(
            [
                place(world.obstacles[:, :2]),
                jnp.asarray(np.asarray(world.obstacles[:, 2:]) @ turn.T, dtype=float),
            ],
            axis=1,
        ),
        target=place(world.target),
        wheel_speeds=world.wheel_speeds,
    )


def test_rotated_and_shifted_world_is_the_same_problem(precision):
    scenario = Scenario(pursuer_count=2, obstacle_count=3, observation="motion")
    for seed in range(20):
        world = random_world(seed)
        angle, shift = 0.7 * seed + 0.3, np.array([3.0, -seed])
        other = moved_world(world, angle, shift)
        np.testing.assert_allclose(
            see(scenario, other), see(scenario, world), atol=1e-12 if precision else 2e-5
        )
        action = jnp.asarray(np.random.default_rng(seed).uniform(-1, 1, 2), dtype=float)
        np.testing.assert_allclose(
            drive_at(scenario, other, action),
            rotation(angle) @ np.asarray(drive_at(scenario, world, action)),
            atol=1e-12 if precision else 2e-6,
        )


def test_world_axes_are_shifted_but_not_rotated(precision):
    scenario = Scenario(pursuer_count=2, obstacle_count=3, frame="world")
    world = random_world(4)
    shifted = moved_world(world, 0.0, np.array([5.0, -3.0]))
    turned = moved_world(world, 1.0, np.zeros(2))
    np.testing.assert_allclose(see(scenario, shifted), see(scenario, world), atol=1e-5)
    assert np.max(np.abs(see(scenario, turned) - see(scenario, world))) > 0.1
    np.testing.assert_allclose(
        drive_at(scenario, world, jnp.array([0.6, 0.8])), 0.1574 * np.array([0.6, 0.8]), rtol=1e-6
    )


@pytest.mark.parametrize("frame", ["target", "world"])
def test_order_of_robots_in_the_world_does_not_matter(frame):
    scenario = Scenario(pursuer_count=2, obstacle_count=3, frame=frame, observation="motion")
    for seed in range(10):
        world = random_world(seed)
        shuffled = eqx.tree_at(
            lambda w: (w.pursuers, w.wheel_speeds, w.obstacles),
            world,
            (world.pursuers[::-1], world.wheel_speeds[::-1], world.obstacles[jnp.array([2, 0, 1])]),
        )
        np.testing.assert_array_equal(see(scenario, shuffled), see(scenario, world))


def test_nearest_robot_comes_first():
    scenario = Scenario(pursuer_count=2, obstacle_count=3)
    for seed in range(10):
        entries = dict(
            zip(observation_names(scenario), np.asarray(see(scenario, random_world(seed))), strict=True)
        )
        for kind, count in (("pursuer", 2), ("obstacle", 3)):
            reach = [np.hypot(entries[f"{kind}{i}_x"], entries[f"{kind}{i}_y"]) for i in range(count)]
            assert reach == sorted(reach)
            assert all(entry < 1.0 for entry in reach)


@pytest.mark.parametrize("observation", ["poses", "motion"])
def test_entries_are_what_their_names_say(observation, precision):
    scenario = Scenario(observation=observation)
    world = World(
        evader=jnp.array([1.0, 1.0]),
        pursuers=jnp.array([[1.0, 1.5, np.pi / 2]]),
        obstacles=jnp.array([[1.0, 0.0, 0.0, -0.1574]]),
        target=jnp.array([1.0, 3.0]),
        wheel_speeds=jnp.array([[0.1, -0.3]]),
    )
    # The target lies along world y, so the frame's x is world y and its y is world -x.
    entries = dict(zip(observation_names(scenario), np.asarray(see(scenario, world)), strict=True))
    expected = {
        "target_far": np.tanh(1.0), "target_near": np.exp(-8.0),
        "pursuer0_x": 1 / 3, "pursuer0_y": 0.0, "pursuer0_cos": 1.0, "pursuer0_sin": 0.0,
        "pursuer0_near": np.exp(-0.3 / 0.2),
        "obstacle0_x": -0.5, "obstacle0_y": 0.0, "obstacle0_vx": -1.0, "obstacle0_vy": 0.0,
        "obstacle0_near": np.exp(-0.8 / 0.2),
    }  # fmt: skip
    if observation == "motion":
        # Beyond the limit of 0.2 m/s: estimates on a robot may be.
        expected |= {"pursuer0_left": 0.5, "pursuer0_right": -1.0}
    assert set(entries) == set(expected)
    for name, value in expected.items():
        np.testing.assert_allclose(entries[name], value, atol=1e-6, err_msg=name)


@pytest.mark.parametrize("frame", ["target", "world"])
@pytest.mark.parametrize("pursuers, obstacles", [(1, 0), (1, 1), (3, 8)])
@pytest.mark.parametrize("motion", ["poses", "motion", "robots"])
def test_size_and_names_agree_with_the_observation(frame, pursuers, obstacles, motion):
    scenario = Scenario(pursuer_count=pursuers, obstacle_count=obstacles, frame=frame, observation=motion)
    observation = observe(scenario, random_world(0, pursuers, obstacles))
    names = observation_names(scenario)
    assert observation.shape == (observation_size(scenario),) == (len(names),)
    assert len(set(names)) == len(names)
    assert np.all(np.abs(observation) <= 20)


@pytest.mark.parametrize("frame", ["target", "world"])
def test_contact_and_arrival_give_finite_entries_and_gradients(frame, precision):
    scenario = Scenario(frame=frame)
    point = jnp.array([0.3, 0.3])

    @eqx.filter_jit
    def both(scenario, evader):
        world = World(
            evader, jnp.array([[0.3, 0.3, 1.0]]), jnp.array([[0.3, 0.3, 0.02, 0.0]]), jnp.array([0.3, 0.3])
        )
        value = lambda e: observe(scenario, eqx.tree_at(lambda w: w.evader, world, e))  # noqa: E731
        return value(evader), jax.jacobian(value)(evader), to_velocity(scenario, world, jnp.array([1.0, 0.0]))

    for evader in (point, point + 1e-30, point + 1e-7, jnp.array([0.3, 0.1])):
        for leaf in both(scenario, evader):
            assert np.all(np.isfinite(leaf))


def test_velocity_is_never_above_the_limit_and_keeps_its_direction(precision):
    scenario, world = Scenario(), random_world(1, 1, 1)
    for action in ([1.0, 1.0], [-1.0, 1.0], [0.3, -0.2], [0.0, 0.0], [1.0, 0.0]):
        velocity = np.asarray(drive_at(scenario, world, jnp.array(action)))
        size = np.hypot(*action)
        np.testing.assert_allclose(np.hypot(*velocity), 0.1574 * min(size, 1.0), rtol=1e-6, atol=1e-9)
        back = np.asarray(to_action(scenario, world, jnp.asarray(velocity)))
        np.testing.assert_allclose(back * max(size, 1.0), action, atol=1e-6)


def test_action_that_is_not_finite_is_a_stop_not_a_nan():
    velocity = drive_at(Scenario(), random_world(1, 1, 1), jnp.array([np.nan, 1.0]))
    np.testing.assert_array_equal(velocity, [0.0, 0.0])


@pytest.mark.parametrize("frame, policy", [("target", goal_seeking), ("world", goal_seeking_world)])
def test_goal_seeking_drives_at_the_target_at_full_speed(frame, policy, precision):
    scenario = Scenario(pursuer_count=2, obstacle_count=3, frame=frame)
    for seed in range(5):
        world = random_world(seed)
        velocity = np.asarray(to_velocity(scenario, world, policy(observe(scenario, world))))
        offset = np.asarray(world.target - world.evader)
        np.testing.assert_allclose(velocity, 0.1574 * offset / np.hypot(*offset), rtol=1e-5, atol=1e-8)


def test_evader_sees_what_would_capture_it():
    # Same place, other heading: the observation must differ, since the capture set does.
    scenario = Scenario(obstacle_count=0)
    make = lambda heading: World(  # noqa: E731
        jnp.zeros(2), jnp.array([[0.5, 0.0, heading]]), jnp.zeros((0, 4)), jnp.array([1.0, 0.0])
    )
    assert np.max(np.abs(see(scenario, make(0.0)) - see(scenario, make(1.5)))) > 0.5


def test_robots_and_any_number_of_obstacles_are_seen_in_as_many_entries():
    """What `motion` sees, five obstacles at most, and the robots' speeds and sizes."""
    numbers = {"evader_speed": 0.15, "pursuer_speed": 0.3, "pursuer_half_axle": 0.1, "capture_distance": 0.16}
    numbers |= {"collision_distance": 0.12, "obstacle_velocity": (0.0, 0.03)}
    expected = [0.75, 1.5, 0.5, 0.8, 0.6, 0.2]
    for count in (0, 1, 5, 8):
        world = random_world(count, 1, count)
        seen = see(Scenario(obstacle_count=count, observation="robots", **numbers), world)
        plain = see(Scenario(obstacle_count=count, observation="motion", **numbers), world)
        assert seen.shape == (40,)
        some = min(len(plain), 34)
        np.testing.assert_allclose(seen[:some], plain[:some], atol=1e-6)
        np.testing.assert_array_equal(seen[some:34], 0.0)
        np.testing.assert_allclose(seen[34:], expected, rtol=1e-5)


def test_robots_beyond_ten_metres_are_not_seen():
    scenario = Scenario(obstacle_count=2, observation="robots")
    near = random_world(0, 1, 2)
    far = eqx.tree_at(lambda w: w.obstacles, near, near.obstacles.at[0, 0].set(1000.0))
    alone = eqx.tree_at(lambda w: w.obstacles, near, near.obstacles[1:])
    expected = see(Scenario(obstacle_count=1, observation="robots"), alone)
    np.testing.assert_allclose(see(scenario, far), expected, atol=1e-6)
