"""Robots: does the simulated robot move as the real one would, and is no approach overlooked?"""

from functools import partial

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from sidestep.world.robots import (
    body_velocity,
    closest_approach_driving,
    closest_approach_straight,
    drive,
    glide,
    limit_speed,
    limit_wheels,
    wheels_from_body,
    wrap_angle,
)

RNG = np.random.default_rng(7)


def integrate(pose, wheels, half_axle, duration, steps=4000):
    """Runge-Kutta of fourth order on x' = v cos, y' = v sin, heading' = omega, in NumPy."""
    speed, turn_rate = (wheels[0] + wheels[1]) / 2, (wheels[1] - wheels[0]) / (2 * half_axle)
    rate = lambda state: np.array([speed * np.cos(state[2]), speed * np.sin(state[2]), turn_rate])  # noqa: E731
    state, step = np.array(pose, float), duration / steps
    for _ in range(steps):
        k1 = rate(state)
        k2 = rate(state + step / 2 * k1)
        k3 = rate(state + step / 2 * k2)
        k4 = rate(state + step * k3)
        state = state + step / 6 * (k1 + 2 * k2 + 2 * k3 + k4)
    return state


def dense_minimum(position, velocity, pose, wheels, half_axle, duration, samples=4001):
    """Smallest sampled distance, from the textbook form of the arc (centre of rotation)."""
    t = np.linspace(0.0, duration, samples)
    speed, turn_rate = (wheels[0] + wheels[1]) / 2, (wheels[1] - wheels[0]) / (2 * half_axle)
    if abs(turn_rate) < 1e-9:
        x, y = pose[0] + speed * t * np.cos(pose[2]), pose[1] + speed * t * np.sin(pose[2])
    else:
        radius = speed / turn_rate
        x = pose[0] + radius * (np.sin(pose[2] + turn_rate * t) - np.sin(pose[2]))
        y = pose[1] - radius * (np.cos(pose[2] + turn_rate * t) - np.cos(pose[2]))
    return np.min(np.hypot(position[0] + velocity[0] * t - x, position[1] + velocity[1] * t - y))


def assert_same_pose(pose, expected, tolerance):
    np.testing.assert_allclose(pose[:2], expected[:2], atol=tolerance)
    turn = (float(pose[2]) - expected[2] + np.pi) % (2 * np.pi) - np.pi
    assert abs(turn) < tolerance


MOTIONS = {
    "arc left": ((0.3, -0.2, 0.4), (0.05, 0.2)),
    "arc right": ((0.3, -0.2, 3.0), (0.2, -0.01)),
    "arc backwards": ((0.3, -0.2, -2.9), (-0.2, -0.1)),
    "nearly straight": ((1.0, 2.0, 1.0), (0.2, 0.2 + 1e-6)),
    "straight": ((1.0, 2.0, -1.0), (0.2, 0.2)),
    "straight back": ((1.0, 2.0, -1.0), (-0.2, -0.2)),
    "turn in place": ((1.0, 2.0, 3.1), (-0.2, 0.2)),
    "stand": ((1.0, 2.0, 3.1), (0.0, 0.0)),
}


@pytest.mark.parametrize("motion", MOTIONS)
@pytest.mark.parametrize("duration", [0.05, 0.5, 20.0])
def test_held_wheels_follow_the_differential_equation(motion, duration, precision):
    pose, wheels = MOTIONS[motion]
    moved = jax.jit(drive)(jnp.array(pose), jnp.array(wheels), jnp.array(0.2), jnp.array(duration))
    expected = integrate(pose, wheels, 0.2, duration, steps=400)
    assert_same_pose(moved, expected, 1e-7 * max(1.0, duration) if precision else 1e-5)


def test_arc_agrees_with_fine_euler_steps(x64):
    pose, wheels = MOTIONS["arc left"]
    moved = drive(jnp.array(pose), jnp.array(wheels), jnp.array(0.2), jnp.array(0.5))
    state = np.array(pose)
    for _ in range(200_000):
        speed, turn_rate = np.mean(wheels), (wheels[1] - wheels[0]) / 0.4
        state = state + 0.5 / 200_000 * np.array(
            [speed * np.cos(state[2]), speed * np.sin(state[2]), turn_rate]
        )
    assert_same_pose(moved, state, 1e-6)


@pytest.mark.parametrize("motion", MOTIONS)
def test_two_half_holds_are_one_hold(motion, x64):
    pose, wheels = (jnp.array(part) for part in MOTIONS[motion])
    half = lambda pose: drive(pose, wheels, jnp.array(0.2), jnp.array(0.35))  # noqa: E731
    whole = drive(pose, wheels, jnp.array(0.2), jnp.array(0.7))
    assert_same_pose(half(half(pose)), np.asarray(whole), 1e-12)


def test_turning_in_place_never_moves_the_centre(precision):
    pose = jnp.array([1.0, 2.0, 0.3])
    for duration in (0.01, 1.0, 100.0):
        moved = drive(pose, jnp.array([-0.2, 0.2]), jnp.array(0.2), jnp.array(duration))
        np.testing.assert_array_equal(moved[:2], pose[:2])


def test_heading_stays_in_its_interval_whatever_the_turn(precision):
    angles = np.concatenate(
        [RNG.uniform(-100, 100, 2000), np.pi * np.arange(-9, 10), np.nextafter(np.pi, 0) * np.array([1, -1])]
    )
    angles = np.concatenate([angles, -np.pi - 10.0 ** -np.arange(1, 17), np.pi + 10.0 ** -np.arange(1, 17)])
    wrapped = np.asarray(wrap_angle(jnp.asarray(angles, dtype=float)))
    limit = np.asarray(np.pi, wrapped.dtype)
    assert np.all(wrapped >= -limit)
    assert np.all(wrapped < limit)
    np.testing.assert_allclose(np.cos(wrapped), np.cos(angles), atol=1e-12 if precision else 2e-5)
    np.testing.assert_allclose(np.sin(wrapped), np.sin(angles), atol=1e-12 if precision else 2e-5)


def test_body_velocity_and_wheels_are_inverse(precision):
    for wheels in ([0.2, 0.2], [-0.2, 0.2], [0.1, -0.05], [0.0, 0.0]):
        speed, turn_rate = body_velocity(jnp.array(wheels), jnp.array(0.15))
        np.testing.assert_allclose(wheels_from_body(speed, turn_rate, jnp.array(0.15)), wheels, atol=1e-7)
    speed, turn_rate = body_velocity(jnp.array([0.1, 0.2]), jnp.array(0.2))
    np.testing.assert_allclose([speed, turn_rate], [0.15, 0.25], rtol=1e-6)


def test_left_wheel_faster_turns_right():
    moved = drive(jnp.zeros(3), jnp.array([0.2, 0.1]), jnp.array(0.2), jnp.array(1.0))
    assert moved[2] < 0.0
    assert moved[1] < 0.0


def test_speed_limit_holds_for_every_command(precision):
    limit = 0.1574
    commands = np.concatenate(
        [
            RNG.normal(size=(3000, 2)) * 10.0 ** RNG.uniform(-30, 30, (3000, 1)),
            [[0.0, 0.0], [limit, 0.0], [0.0, -limit], [limit, limit], [3e38, 3e38], [1e-38, 0.0]],
        ]
    )
    limited = np.asarray(
        jax.vmap(limit_speed, in_axes=(0, None))(jnp.asarray(commands, dtype=float), jnp.array(limit))
    )
    norms = np.hypot(*limited.T.astype(float))
    assert np.all(norms <= limit * (1 + (1e-14 if precision else 3e-7)))
    asked = np.hypot(*commands.T)
    np.testing.assert_allclose(norms, np.minimum(asked, limit), rtol=1e-12 if precision else 1e-6, atol=1e-37)
    moving = (asked > 1e-30) & (asked < 1e15)
    turn = np.arctan2(*limited[moving].T) - np.arctan2(*commands[moving].T)
    np.testing.assert_allclose(np.cos(turn), 1.0, atol=1e-6)


@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf])
def test_non_finite_commands_stop_the_robot(bad, precision):
    np.testing.assert_array_equal(limit_speed(jnp.array([bad, 0.1]), jnp.array(0.15)), [0.0, 0.0])
    np.testing.assert_array_equal(limit_speed(jnp.array([0.1, bad]), jnp.array(0.15)), [0.0, 0.0])
    np.testing.assert_allclose(limit_wheels(jnp.array([bad, 0.1]), jnp.array(0.2)), [0.0, 0.1], rtol=1e-6)


def test_wheel_limits_hold_for_every_command(precision):
    commands = jnp.asarray(RNG.normal(size=(2, 1000)), dtype=float)
    limited = limit_wheels(commands, jnp.array(0.2))
    assert jnp.all(jnp.abs(limited) <= jnp.array(0.2))
    speed, turn_rate = body_velocity(limited, jnp.array(0.2))
    assert jnp.all(jnp.abs(speed) + 0.2 * jnp.abs(turn_rate) <= 0.2 * (1 + 1e-6))


def straight_minimum(position, velocity, duration):
    t = np.linspace(0.0, duration, 20001)
    return np.min(np.hypot(position[0] + velocity[0] * t, position[1] + velocity[1] * t))


def test_straight_approach_agrees_with_dense_sampling(precision):
    for _ in range(200):
        position, velocity = RNG.uniform(-1, 1, 2), RNG.normal(size=2) * 10.0 ** RNG.uniform(-3, 1)
        duration = RNG.uniform(0.01, 2.0)
        distance = closest_approach_straight(jnp.array(position), jnp.array(velocity), jnp.array(duration))
        sampled = straight_minimum(position, velocity, duration)
        spacing = np.hypot(*velocity) * duration / 20000
        assert sampled - spacing - 1e-6 <= float(distance) <= sampled + 1e-6


def test_robots_at_rest_relative_to_each_other_keep_their_distance(precision):
    distance = closest_approach_straight(jnp.array([0.3, 0.4]), jnp.zeros(2), jnp.array(0.5))
    np.testing.assert_allclose(distance, 0.5, rtol=1e-6)


def random_approaches(count, longest, least_half_axle):
    """Encounters within a few decimetres, where a miss would matter."""
    position = RNG.uniform(-0.5, 0.5, (count, 2))
    velocity = RNG.uniform(-0.25, 0.25, (count, 2))
    pose = np.concatenate(
        [RNG.uniform(-0.2, 0.2, (count, 2)), RNG.uniform(-np.pi, np.pi, (count, 1))], axis=1
    )
    wheels = RNG.uniform(-0.3, 0.3, (count, 2))
    wheels[::5, 1] = wheels[::5, 0]
    wheels[1::5, 1] = -wheels[1::5, 0]
    half_axle, duration = RNG.uniform(least_half_axle, 0.4, count), RNG.uniform(0.01, longest, count)
    return position, velocity, pose, wheels, half_axle, duration


@pytest.mark.parametrize(
    "longest, least_half_axle, tolerance",
    [(0.1, 0.08, 1e-6), (0.5, 0.08, 1e-4)],
    ids=["control periods", "half a second"],
)
def test_approach_to_a_turning_pursuer_is_not_overlooked(longest, least_half_axle, tolerance, precision):
    cases = random_approaches(1500, longest, least_half_axle)
    ours = jax.jit(jax.vmap(closest_approach_driving))(*(jnp.asarray(part, dtype=float) for part in cases))
    sampled = np.array([dense_minimum(*case) for case in zip(*cases, strict=True)])
    error = np.asarray(ours) - sampled
    assert np.max(error) < tolerance + (0.0 if precision else 1e-6)
    # Sampling can only overestimate, by less than half its spacing times the relative speed.
    assert np.min(error) > -1e-4


def test_approach_within_a_hold_is_below_both_ends(precision):
    # The evader crosses just ahead of the pursuer's centre: 0.25 m at both ends, nearly 0 between.
    distance = jax.jit(closest_approach_driving)(
        jnp.array([0.0, 0.25]),
        jnp.array([0.0, -1.0]),
        jnp.array([-0.05, 0.0, 0.0]),
        jnp.array([0.2, 0.2]),
        jnp.array(0.2),
        jnp.array(0.5),
    )
    assert float(distance) < 0.01


@pytest.mark.parametrize("where", ["apart", "coincident"])
def test_gradient_of_the_approach_is_never_nan(where, precision):
    position = jnp.array([0.3, 0.2]) if where == "apart" else jnp.zeros(2)

    @jax.jit
    @partial(jax.grad, argnums=(0, 1))
    def slope(velocity, wheels):
        return closest_approach_driving(
            position, velocity, jnp.zeros(3), wheels, jnp.array(0.2), jnp.array(0.05)
        ) + closest_approach_straight(position, velocity, jnp.array(0.05))

    for velocity in ([0.1, 0.05], [0.0, 0.0]):
        for wheels in ([0.1, 0.2], [0.2, 0.2], [-0.2, 0.2], [0.0, 0.0]):
            gradients = slope(jnp.array(velocity), jnp.array(wheels))
            assert all(bool(jnp.all(jnp.isfinite(part))) for part in gradients)


def test_another_speed_or_half_axle_does_not_recompile():
    counted = eqx.filter_jit(eqx.debug.assert_max_traces(drive, max_traces=1))
    for half_axle in (0.1, 0.2, 0.3):
        counted(jnp.zeros(3), jnp.array([0.1, half_axle]), jnp.array(half_axle), jnp.array(0.05))


def test_gliding_is_straight(precision):
    np.testing.assert_allclose(
        glide(jnp.array([1.0, 2.0]), jnp.array([0.02, -0.01]), jnp.array(10.0)), [1.2, 1.9], rtol=1e-6
    )
