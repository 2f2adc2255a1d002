"""Hazards of the game of time: a time that the evader does not have, or a law that falls short."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from sidestep.pursuit import CaptureGame

# Evader and wheel speed, half axle, capture distance: far from the winner's edge, near it, and with l < b,
# where the pursuer backs off from an evader close beside it.
WIDE = (0.1574, 0.2, 0.2, 0.3)
NARROW = (0.15, 0.2, 0.2, 0.175)
SLOW = (0.06, 0.2, 0.3, 0.05)
EQUAL_SIZES = (0.1, 0.2, 0.2, 0.2)
FAST = (0.19, 0.2, 0.2, 0.7)
SMALL_AXLE = (0.18, 0.22, 0.08, 0.12)
LOST = [WIDE, NARROW, SLOW, EQUAL_SIZES, FAST, SMALL_AXLE]


def outside(parameters, count: int, seed: int = 0, reach: float | None = None) -> np.ndarray:
    """Points outside the capture circle, uniform in area, the narrow band at the circle included."""
    draw = np.random.default_rng(seed)
    size = parameters[3]
    reach = reach or max(1.0, 3.0 * size)
    distance = np.sqrt(draw.uniform(size**2, reach**2, count))
    distance[: count // 4] = draw.uniform(size, 2.0 * size, count // 4)
    bearing = draw.uniform(-np.pi, np.pi, count)
    return distance[:, None] * np.stack([np.cos(bearing), np.sin(bearing)], axis=1)


# Jitted with the game as an argument: one compilation serves every game.
time_of = jax.jit(jax.vmap(lambda game, z: game.time_to_capture(z), in_axes=(None, 0)))
slope_of = jax.jit(jax.vmap(jax.grad(lambda z, game: game.time_to_capture(z)), in_axes=(0, None)))
barrier_of = jax.jit(jax.vmap(lambda game, z: game.barrier(z)[0], in_axes=(None, 0)))


def times(parameters, z) -> np.ndarray:
    return np.asarray(time_of(CaptureGame(*parameters), jnp.asarray(z, float)))


def barriers(parameters, z) -> np.ndarray:
    return np.asarray(barrier_of(CaptureGame(*parameters), jnp.asarray(z, float)))


@pytest.mark.parametrize("parameters", LOST)
def test_the_time_solves_isaacs_equation(parameters, x64):
    """v_e |grad T| - V max(|T_x|, |x T_y - y T_x|/b) = -1 by finite differences, away from jumps."""
    evader_speed, rim, half_axle, _ = parameters
    z, step = outside(parameters, 4000), 1e-6
    z = z[(np.abs(z) > 1e-4).all(axis=1)]
    slope = [
        (times(parameters, z + step * axis) - times(parameters, z - step * axis)) / (2.0 * step)
        for axis in np.eye(2)
    ]
    moment = z[:, 0] * slope[1] - z[:, 1] * slope[0]
    rate = evader_speed * np.hypot(*slope) - rim * np.maximum(np.abs(slope[0]), np.abs(moment) / half_axle)
    residual = np.abs(rate + 1.0)
    assert np.mean(residual > 1e-3) < 0.002
    assert np.median(residual) < 1e-6


@pytest.mark.parametrize("parameters", LOST)
def test_the_gradient_of_the_time_is_its_slope(parameters, x64):
    z, step = outside(parameters, 500, seed=3), 1e-6
    z = z[(np.abs(z) > 1e-4).all(axis=1)]
    gradient = slope_of(jnp.asarray(z), CaptureGame(*parameters))
    for axis in range(2):
        shift = step * np.eye(2)[axis]
        slope = (times(parameters, z + shift) - times(parameters, z - shift)) / (2.0 * step)
        off = np.abs(slope - np.asarray(gradient)[:, axis])
        assert np.mean(off > 1e-3 * (1.0 + np.abs(slope))) < 0.005


@pytest.mark.parametrize("parameters", LOST)
def test_the_time_is_symmetric_and_finite_wherever_the_pursuer_wins(parameters, precision):
    z = outside(parameters, 2000, seed=1, reach=5.0)
    time = times(parameters, z)
    assert np.isfinite(time).all()
    assert (time > 0.0).all()
    np.testing.assert_array_equal(times(parameters, z * np.array([-1, 1])), time)
    np.testing.assert_array_equal(times(parameters, z * np.array([1, -1])), time)


@pytest.mark.parametrize("parameters", LOST)
def test_float32_promises_the_same_time(parameters):
    z = outside(parameters, 1000, seed=2).astype(np.float32)
    single = times(parameters, z)
    with jax.enable_x64(True):
        double = times(parameters, z.astype(np.float64))
        jump = np.abs(
            np.asarray(jax.vmap(lambda z: CaptureGame(*parameters).barrier(z)[0])(jnp.asarray(z, float)))
        )
    certain = jump > 1e-5
    np.testing.assert_allclose(single[certain], double[certain], rtol=2e-4, atol=1e-5)


def test_the_time_does_not_jump_where_turning_begins_and_ends(x64):
    """On the axis, where most play ends up: no jump across it, and never below a straight chase."""
    for parameters in LOST:
        game = CaptureGame(*parameters)
        x = np.linspace(parameters[3] * 1.001, 2.0, 300)
        on, off = (times(parameters, np.stack([x, np.full_like(x, y)], axis=1)) for y in (0.0, 1e-9))
        np.testing.assert_allclose(on, off, atol=1e-5)
        ahead = times(parameters, np.stack([x, np.zeros_like(x)], axis=1))
        assert (np.diff(ahead) > 0.0).all()
        closing = float(game.pursuer_speed - game.evader_speed)
        assert (ahead >= (x - parameters[3]) / closing - 1e-9).all()


def test_captured_already_takes_no_time(precision):
    for parameters in [*LOST, (0.3, 0.2, 0.2, 0.2), (0.1, 0.2, 0.0, 0.2)]:
        size = parameters[3]
        np.testing.assert_array_equal(
            times(parameters, [[0.0, 0.0], [0.9 * size, 0.0], [0.0, -0.9 * size]]), 0.0
        )


def test_a_faster_evader_is_never_caught(precision):
    assert np.isinf(times((0.2, 0.2, 0.2, 0.2), [[0.201, 0.0], [0.0, 0.5], [-3.0, 1.0]])).all()
    assert np.isinf(times((0.3, 0.2, 0.2, 0.2), [[0.201, 0.0], [0.0, 0.5], [-3.0, 1.0]])).all()


def test_turning_at_no_cost_leaves_a_straight_chase(precision):
    z = outside((0.1, 0.2, 0.0, 0.2), 50)
    expected = (np.linalg.norm(z, axis=1) - 0.2) / 0.1
    np.testing.assert_allclose(times((0.1, 0.2, 0.0, 0.2), z), expected, rtol=1e-5, atol=1e-5)
    nearly = times((0.1, 0.2, 1e-5, 0.2), z)
    np.testing.assert_allclose(nearly, expected, rtol=2e-3, atol=2e-3)


def test_an_evader_that_can_escape_is_lost_only_inside_the_capture_set(precision):
    paper = (0.1574, 0.2, 0.2, 0.2)
    z = outside(paper, 1000, seed=6, reach=0.3)
    h, time = barriers(paper, z), times(paper, z)
    inside = h < -1e-6
    assert inside.sum() > 20
    assert np.isfinite(time[inside]).all()
    assert time[inside].max() <= 0.2 / 0.1574
    assert np.isinf(time[h > 1e-6]).all()


def test_close_beside_the_pursuer_backs_off_first(x64):
    """With l < b, driving away brings it ahead sooner than turning does."""
    game = CaptureGame(*SLOW)
    play = game.play(jnp.array([0.01, 0.1]))
    assert float(play.backing) > 0.1
    np.testing.assert_array_equal(game.pursuer_saddle(jnp.array([0.01, 0.1])), [-0.2, -0.2])
    np.testing.assert_array_equal(game.pursuer_saddle(jnp.array([-0.01, -0.1])), [0.2, 0.2])
