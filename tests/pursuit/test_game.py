"""Hazards of the barrier: a normal that points into the pursuer's reach, a margin that is not there."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from sidestep.pursuit import CaptureGame
from sidestep.pursuit.game import turning_moment
from sidestep.world import load_scenario
from sidestep.world.capture_geometry import to_pursuer_frame
from sidestep.world.robots import body_velocity, drive

PAPER = (0.1574, 0.2, 0.2, 0.2)
ROOMY = (0.1574, 0.2, 0.2, 0.1)
FAST_EVADER = (0.3, 0.2, 0.2, 0.2)
LOST = (0.1, 0.2, 0.2, 0.2)
GAMES = [PAPER, ROOMY, FAST_EVADER, LOST, (0.18, 0.22, 0.08, 0.09), (0.1, 0.2, 0.0, 0.2)]


def points(count: int = 400, reach: float = 1.0, seed: int = 0) -> np.ndarray:
    return np.random.default_rng(seed).uniform(-reach, reach, (count, 2))


def points_between(low: float, high: float, parameters, count: int = 2000) -> np.ndarray:
    """Points whose distance from the capture set is between `low` and `high`, on all sides of the pursuer."""
    draw = np.random.default_rng(2)
    evader_speed, rim, _, size = parameters
    usable = np.arccos(min(evader_speed / rim, 1.0))
    bearing = draw.uniform(-np.pi, np.pi, count)
    off_axis = np.minimum(np.abs(bearing), np.pi - np.abs(bearing))
    distance = (size + draw.uniform(low, high, count)) / np.cos(np.maximum(usable - off_axis, 0.0))
    return distance[:, None] * np.stack([np.cos(bearing), np.sin(bearing)], axis=1)


# Jitted with the game as an argument: one compilation serves every game.
barrier = jax.jit(jax.vmap(lambda game, z: game.barrier(z), in_axes=(None, 0)))
slope = jax.jit(jax.vmap(jax.grad(lambda z, game: game.barrier(z)[0]), in_axes=(0, None)))
rate = jax.jit(jax.vmap(lambda game, z: game.pursuit_rate(z, game.barrier(z)[1]), in_axes=(None, 0)))


def barriers(game: CaptureGame, z) -> tuple[np.ndarray, np.ndarray]:
    values, normals = barrier(game, jnp.asarray(z, float))
    return np.asarray(values), np.asarray(normals)


def rates(game: CaptureGame, z) -> np.ndarray:
    return np.asarray(rate(game, jnp.asarray(z, float)))


# Who wins


def test_largest_capture_distance_matches_known_numbers(x64):
    assert float(CaptureGame(*PAPER).largest_capture_distance) == pytest.approx(0.20078321, abs=1e-8)
    assert float(CaptureGame(0.18, 0.22, 0.08, 0.1).largest_capture_distance) == pytest.approx(
        0.0931435, abs=1e-7
    )


def test_the_papers_evader_is_barely_fast_enough(x64):
    """With b = l it escapes iff rho^2 >= (sqrt(5) - 1)/2, v_e >= 0.15723 m/s; the paper has 0.1574 m/s."""
    critical = 0.2 * np.sqrt((np.sqrt(5.0) - 1.0) / 2.0)
    assert critical == pytest.approx(0.15723, abs=5e-6)
    assert bool(CaptureGame(critical + 1e-9, 0.2, 0.2, 0.2).evader_can_escape)
    assert not bool(CaptureGame(critical - 1e-9, 0.2, 0.2, 0.2).evader_can_escape)
    assert bool(CaptureGame.of(load_scenario("paper")).evader_can_escape)


def test_winner_agrees_with_the_angle_condition(precision):
    for speed in np.linspace(0.02, 0.199, 30):
        game = CaptureGame(speed, 0.2, 0.2, 0.1)
        condition = np.tan(np.arccos(speed / 0.2)) - (speed / 0.2) * 0.2 / 0.1
        if abs(condition) > 1e-4:
            assert bool(game.evader_can_escape) == (condition < 0.0)


def test_an_evader_as_fast_as_the_pursuer_always_escapes(precision):
    for speed in (0.2, 0.3):
        game = CaptureGame(speed, 0.2, 0.2, 5.0)
        assert bool(game.evader_can_escape)
        assert float(game.largest_capture_distance) == np.inf
        assert float(game.usable_angle) == 0.0


def test_a_pursuer_that_turns_at_no_cost_always_wins(precision):
    game = CaptureGame(0.1999, 0.2, 0.0, 1e-3)
    assert float(game.largest_capture_distance) == 0.0
    assert not bool(game.evader_can_escape)


# The barrier


@pytest.mark.parametrize("parameters", GAMES)
def test_barrier_is_the_same_left_and_right_front_and_rear(parameters, precision):
    game, z = CaptureGame(*parameters), points()
    values, normals = barriers(game, z)
    for mirror in ([1, -1], [-1, 1], [-1, -1]):
        mirrored_values, mirrored_normals = barriers(game, z * np.array(mirror))
        np.testing.assert_array_equal(mirrored_values, values)
        np.testing.assert_array_equal(mirrored_normals, normals * np.array(mirror))


@pytest.mark.parametrize("parameters", GAMES)
def test_normal_is_the_gradient_of_the_value_away_from_kinks(parameters, x64):
    game, z = CaptureGame(*parameters), points()
    z = z[(np.abs(z) > 1e-3).all(axis=1)]
    normals = barriers(game, z)[1]
    np.testing.assert_allclose(slope(jnp.asarray(z), game), normals, atol=1e-12)
    step = 1e-6
    for axis in range(2):
        shift = step * np.eye(2)[axis]
        difference = (barriers(game, z + shift)[0] - barriers(game, z - shift)[0]) / (2.0 * step)
        np.testing.assert_allclose(difference, normals[:, axis], atol=1e-4)


@pytest.mark.parametrize("parameters", GAMES)
def test_an_error_in_position_costs_no_more_than_its_size(parameters, x64):
    game, z = CaptureGame(*parameters), points()
    nudges = points(seed=1, reach=0.3)
    change = np.abs(barriers(game, z + nudges)[0] - barriers(game, z)[0])
    assert (change <= np.linalg.norm(nudges, axis=1) + 1e-12).all()


def test_an_error_in_heading_costs_at_most_b_rho_per_radian_near_the_barrier(x64):
    game = CaptureGame(*ROOMY)
    z = points_between(0.0, float(game.largest_capture_distance) - 0.1, ROOMY)
    moments = jax.vmap(turning_moment)(jnp.asarray(z), jnp.asarray(barriers(game, z)[1]))
    assert np.abs(moments).max() <= 0.2 * 0.787 + 1e-12
    assert np.abs(moments).max() > 0.2 * 0.787 * 0.9


HARD_PLACES = [
    (0.0, 0.0),
    (0.3, 0.0),
    (-0.3, 0.0),
    (0.0, 0.3),
    (0.0, -0.3),
    (-0.0, -0.0),
    (1e-20, -1e-20),
    (1e6, -1e6),
]


@jax.jit
def everything(game, z):
    def one(z):
        value, normal = game.barrier(z)
        gradients = (
            jax.grad(lambda z: game.barrier(z)[0])(z),
            jax.grad(game.time_to_capture)(z),
            jax.jacobian(game.pursuer_saddle)(z),
            jax.jacobian(game.evader_saddle)(z),
        )
        # Turning at no cost, with b = 0, makes the pursuit rate infinite, and then so is its slope.
        rate = game.pursuit_rate(z, normal)
        steepness = jnp.where(game.half_axle > 0.0, jax.grad(lambda z: game.pursuit_rate(z, normal))(z), 0.0)
        units = (normal, game.evader_saddle(z))
        return (value, gradients, steepness), (game.time_to_capture(z), rate), units, game.pursuer_saddle(z)

    return jax.vmap(one)(z)


@pytest.mark.parametrize("parameters", GAMES)
def test_nothing_is_nan_at_the_centre_on_the_axes_or_far_out(parameters, precision):
    game = CaptureGame(*parameters)
    finite, times, units, wheels = everything(game, jnp.asarray(HARD_PLACES, float))
    for leaf in jax.tree.leaves(finite):
        assert np.isfinite(leaf).all()
    for time in times:
        assert not np.isnan(time).any()
    for unit in units:
        np.testing.assert_allclose(np.linalg.norm(unit, axis=1), 1.0, atol=1e-6)
    np.testing.assert_array_equal(np.abs(wheels), np.asarray(game.pursuer_speed))


def test_a_side_to_follow_keeps_one_tangent_across_the_axis(x64):
    """Exactly ahead either tangent will do; switching with the sign of y would chatter."""
    game = CaptureGame(*ROOMY)
    cosine, sine = 0.787, np.sqrt(1.0 - 0.787**2)
    for y in (-0.02, -1e-9, 0.0, 1e-9, 0.02):
        for side in (1.0, -1.0):
            for x in (0.4, -0.4):
                value, normal = game.barrier(jnp.array([x, y]), side=side)
                np.testing.assert_allclose(normal, [np.sign(x) * cosine, side * sine], atol=1e-12)
                assert float(value) == pytest.approx(0.4 * cosine + side * y * sine - 0.1, abs=1e-12)
    value, normal = game.barrier(jnp.array([0.1, -0.4]), side=1.0)
    np.testing.assert_allclose(normal, np.array([0.1, -0.4]) / np.hypot(0.1, 0.4), atol=1e-12)
    assert float(value) == pytest.approx(np.hypot(0.1, 0.4) - 0.1)


def test_the_wrong_side_never_reports_more_clearance_than_there_is(x64):
    game, z = CaptureGame(*ROOMY), points()
    value = barriers(game, z)[0]
    for side in (1.0, -1.0):
        followed = jax.vmap(lambda z, side=side: game.barrier(z, side=side)[0])(jnp.asarray(z))
        assert (np.asarray(followed) <= value + 1e-12).all()


# The row n.u >= pursuit_rate - gain h


@pytest.mark.parametrize("parameters", [PAPER, ROOMY, FAST_EVADER, (0.18, 0.22, 0.08, 0.09)])
def test_the_evader_can_hold_every_point_up_to_h_max(parameters, x64):
    """For 0 <= h <= h_max the pursuer alone cannot lower h faster than v_e: the row holds with any gain."""
    game = CaptureGame(*parameters)
    h_max = min(float(game.largest_capture_distance) - parameters[3], 1.0)
    assert rates(game, points_between(0.0, h_max, parameters)).max() <= parameters[0] + 1e-12


def test_the_evader_loses_ground_just_beyond_h_max_ahead(x64):
    """The bound is tight: on the axis, past b cot S, turning gains more than v_e."""
    game = CaptureGame(*ROOMY)
    edge = 0.2 / np.tan(float(game.usable_angle))
    for x, holds in ((edge - 1e-6, True), (edge + 1e-6, False)):
        z = jnp.array([x, 0.0])
        assert bool(game.pursuit_rate(z, game.barrier(z)[1]) <= 0.1574 + 1e-12) == holds


@pytest.mark.parametrize("parameters", [PAPER, ROOMY, (0.18, 0.22, 0.08, 0.09)])
def test_a_gain_of_v_tan_s_over_b_keeps_the_row_feasible_everywhere(parameters, x64):
    game = CaptureGame(*parameters)
    z = points_between(0.0, 3.0, parameters)
    gain = parameters[1] / parameters[2] * np.tan(float(game.usable_angle))
    assert (rates(game, z) - gain * barriers(game, z)[0]).max() <= parameters[0] + 1e-12


@jax.jit
def worst_rates(game, z, wheels, duration):
    """Slopes of h along true motion for an instant: evader at rest, fleeing, and fleeing the saddle law."""

    def one(z):
        value, normal = game.barrier(z)

        def slope(velocity, wheel):
            pose = drive(jnp.zeros(3), wheel, game.half_axle, duration)
            return (game.barrier(to_pursuer_frame(z + velocity * duration, pose))[0] - value) / duration

        at_rest = jax.vmap(lambda wheel: slope(jnp.zeros(2), wheel))(wheels)
        fleeing = jax.vmap(lambda wheel: slope(game.evader_speed * normal, wheel))(wheels)
        saddle = slope(game.evader_speed * normal, game.steer_against(z, normal))
        return jnp.min(at_rest), jnp.min(fleeing), saddle, game.pursuit_rate(z, normal)

    return jax.vmap(one)(z)


@pytest.mark.parametrize("parameters", [PAPER, ROOMY, LOST])
def test_pursuit_rate_is_the_worst_over_all_wheel_speeds(parameters, x64):
    z = points(60)
    z = jnp.asarray(z[np.abs(z[:, 1]) > 1e-3])
    grid = np.linspace(-parameters[1], parameters[1], 21)
    wheels = jnp.asarray(np.stack(np.meshgrid(grid, grid), axis=-1).reshape(-1, 2))
    at_rest, fleeing, saddle, claimed = worst_rates(CaptureGame(*parameters), z, wheels, jnp.asarray(1e-6))
    np.testing.assert_allclose(at_rest, -claimed, atol=1e-5)
    np.testing.assert_allclose(fleeing, parameters[0] - claimed, atol=1e-5)
    np.testing.assert_allclose(saddle, parameters[0] - claimed, atol=1e-5)


def test_the_saddle_law_turns_toward_the_evader_and_drives_at_it(x64):
    game = CaptureGame(*ROOMY)
    for x, y, straight, turn_sign in (
        (1.0, 0.2, 0.0, 1.0),
        (1.0, -0.2, 0.0, -1.0),
        (-1.0, 0.2, 0.0, -1.0),
        (-1.0, -0.2, 0.0, 1.0),
        (0.2, 0.05, 1.0, 0.0),
        (-0.2, 0.05, -1.0, 0.0),
    ):
        speed, turn_rate = body_velocity(game.pursuer_saddle(jnp.array([x, y])), game.half_axle)
        assert float(speed) == pytest.approx(0.2 * straight)
        assert float(turn_rate) == pytest.approx(1.0 * turn_sign)


def test_another_speed_or_axle_never_recompiles():
    @jax.jit
    @eqx.debug.assert_max_traces(max_traces=1)
    def play(game, z):
        return game.barrier(z), game.pursuer_saddle(z), game.time_to_capture(z), game.evader_can_escape

    for parameters in GAMES:
        play(CaptureGame(*parameters), jnp.array([0.5, 0.2]))
