"""Estimates from poses that err: nearer to the truth than the poses, and in time when something changes."""

import jax.numpy as jnp
import numpy as np
import pytest

from sidestep.robot import EvaderTrack, ObstacleTrack, PursuerTrack
from sidestep.world.robots import drive

NOISE, TURN = 0.002, 0.0087
RATE = 0.01


def _driven(wheels):
    """Poses of a pursuer (half axle 0.2 m) at every `RATE`, wheel speeds held over each."""
    poses = [np.array([0.0, 0.0, 0.3])]
    for pair in wheels:
        moved = drive(jnp.asarray(poses[-1]), jnp.asarray(pair), jnp.asarray(0.2), jnp.asarray(RATE))
        poses.append(np.asarray(moved, float))
    return np.array(poses)


def test_a_pursuer_that_turns_round_is_followed_more_closely_than_its_poses_tell_it():
    rng = np.random.default_rng(0)
    pairs = rng.choice([-0.2, 0.2], (8, 2))
    truth = _driven(np.repeat(pairs, 60, axis=0))
    track = PursuerTrack(NOISE, TURN, 0.2, 0.2)
    raw, kept = [], []
    for i, pose in enumerate(truth):
        seen = pose + np.array([*rng.normal(scale=NOISE, size=2), rng.normal(scale=TURN)])
        (track.start if i == 0 else track.take)(RATE * i, seen)
        off = track.at(RATE * i) - pose
        raw.append(np.abs(seen - pose))
        kept.append([*np.abs(off[:2]), abs((off[2] + np.pi) % (2 * np.pi) - np.pi)])
    raw, kept = np.mean(np.square(raw), axis=0) ** 0.5, np.mean(np.square(kept), axis=0) ** 0.5
    assert np.all(kept[:2] < 0.8 * raw[:2])
    assert kept[2] < 0.8 * raw[2]
    np.testing.assert_allclose(track.wheel_speeds(), pairs[-1], atol=0.08)
    assert np.max(np.abs(track.wheel_speeds())) <= 0.2 + 1e-12


def test_a_heading_that_passes_half_a_turn_does_not_throw_the_pursuer_round():
    track = PursuerTrack(NOISE, TURN, 0.2, 0.2)
    angle = 3.1 + 1.0 * RATE * np.arange(40)
    for i, heading in enumerate((angle + np.pi) % (2 * np.pi) - np.pi):
        (track.start if i == 0 else track.take)(RATE * i, np.array([0.0, 0.0, heading]))
    assert track.motion[1] == pytest.approx(1.0, abs=0.05)
    assert np.cos(track.at(0.39)[2] - angle[-1]) > 0.999


def test_the_drift_of_an_obstacle_is_found_within_seconds_and_predicts_where_it_will_be():
    rng, track = np.random.default_rng(1), ObstacleTrack(NOISE, 0.02, 0.005)
    for i in range(300):
        where = np.array([1.0, -0.5]) + RATE * i * np.array([0.02, 0.01])
        (track.start if i == 0 else track.take)(RATE * i, where + rng.normal(scale=NOISE, size=2))
    np.testing.assert_allclose(track.velocity, [0.02, 0.01], atol=4e-3)
    np.testing.assert_allclose(track.at(RATE * 299 + 0.5), where + 0.5 * np.array([0.02, 0.01]), atol=4e-3)


def test_the_own_motion_since_a_late_pose_is_added_from_the_commands_when_they_act():
    track = EvaderTrack(NOISE, TURN, 0.003, delay=0.02)
    track.start(0.0, np.zeros(3))
    track.told(0.0, np.array([0.1, 0.0]))
    track.told(0.05, np.array([0.0, 0.1]))
    # The first acts from 0.02 to 0.07, the second from then on.
    np.testing.assert_allclose(track.at(0.1)[:2], [0.005, 0.003], atol=1e-12)
    # A pose of 0.04 that arrives now corrects what came before it, and nothing after.
    track.take(0.04, np.array([0.002, 0.0, 0.0]))
    np.testing.assert_allclose(track.at(0.1)[:2], [0.005, 0.003], atol=1e-9)


def test_motors_that_lag_and_have_a_limit_are_followed_exactly():
    lag, limit, told = 0.02, 2.0, np.array([-0.1, 0.1])
    track = EvaderTrack(NOISE, TURN, 0.003, delay=0.0, motor_lag=lag, acceleration=limit)
    track.start(0.0, np.zeros(3))
    track.told(0.0, np.array([0.15, 0.0]))
    track.told(0.2, told)
    place, velocity, step = np.zeros(2), np.zeros(2), 1e-5
    for i in range(30000):
        wanted = np.array([0.15, 0.0]) if i * step < 0.2 else told
        change = (wanted - velocity) / lag
        change *= min(1.0, limit / max(np.linalg.norm(change), 1e-9))
        place, velocity = place + step * velocity, velocity + step * change
    np.testing.assert_allclose(track.at(0.3)[:2], place, atol=2e-6)
    np.testing.assert_allclose(track.velocity_at(0.3), velocity, atol=2e-5)
    # The same in parts: what is known at one pose is the beginning of the next.
    track.take(0.22, track.at(0.22))
    track.take(0.25, track.at(0.25))
    np.testing.assert_allclose(track.at(0.3)[:2], place, atol=2e-6)
    np.testing.assert_allclose(track.velocity_at(0.3), velocity, atol=2e-5)


def test_averaging_poses_of_a_moving_robot_does_not_hold_it_back():
    rng, track = np.random.default_rng(2), EvaderTrack(NOISE, TURN, 0.003, delay=0.0)
    off, truth = [], np.zeros(2)
    for i in range(400):
        if i % 5 == 0:
            command = 0.15 * np.array([np.cos(0.05 * i), np.sin(0.05 * i)])
            track.told(RATE * i, command)
        seen = np.array([*(truth + rng.normal(scale=NOISE, size=2)), 0.0])
        (track.start if i == 0 else track.take)(RATE * i, seen)
        off.append(track.at(RATE * i)[:2] - truth)
        truth = truth + RATE * command
    assert np.sqrt(np.mean(np.square(off[50:]))) < 0.4 * NOISE
    assert np.all(np.abs(np.mean(off[50:], axis=0)) < 0.4 * NOISE)
