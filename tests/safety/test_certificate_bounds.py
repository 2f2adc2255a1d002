"""The worst case behind the certificate: no real motion beats it, and little less would be beaten."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from sidestep.pursuit import CaptureGame
from sidestep.safety.certificate.greedy_chase import chase, random_wheels
from sidestep.safety.sampled.flow_map import (
    advance,
    closest_alignment,
    side_value,
    turn_drive_turn,
    wheel_motions,
)
from sidestep.safety.sampled.sampled_design import COARSE, FINE, best_design, broken_level, holds
from sidestep.safety.sampled.sampled_game import Cells, Design, SampledGame, found_slack, slack
from sidestep.world.robots import drive

PAPER = {"evader_speed": 0.1574, "pursuer_speed": 0.2, "half_axle": 0.2}


@pytest.mark.parametrize("half_axle, time", [(0.2, 0.05), (0.2, 3.0), (0.05, 1.0)])
def test_no_motion_of_the_pursuer_comes_farther_than_the_bound(half_axle, time):
    rng = np.random.default_rng(0)
    for extreme in (True, False):
        wheels, share = random_wheels(rng, 20_000, 4, 0.2, extreme=extreme)
        poses = wheel_motions(wheels, time * share, half_axle)
        turned = np.sum(0.5 * np.abs(wheels[..., 1] - wheels[..., 0]) * time * share, axis=1) / half_axle
        assert np.all(np.abs(poses[:, 2]) <= turned + 1e-12)
        angle = rng.uniform(-np.pi, np.pi, len(poses))
        world = angle + poses[:, 2]
        along = poses[:, 0] * np.cos(world) + poses[:, 1] * np.sin(world)
        budget = 0.2 * time - half_axle * np.abs(poses[:, 2])
        bound = advance(budget, closest_alignment(angle, poses[:, 2]), half_axle)
        assert np.max(along - bound) <= 1e-12


def test_the_bound_is_attained_by_turning_and_driving():
    poses = turn_drive_turn(0.05, 0.2, 0.2, 9)
    angle = np.linspace(-1.4, 1.4, 57)[:, None]
    world = angle + poses[:, 2]
    along = poses[:, 0] * np.cos(world) + poses[:, 1] * np.sin(world)
    bound = advance(0.01 - 0.2 * np.abs(poses[:, 2]), closest_alignment(angle, poses[:, 2]), 0.2)
    assert np.all(along <= bound + 1e-12)
    # For every direction and final heading some motion comes all the way.
    for heading in np.unique(np.round(poses[:, 2], 9)):
        same = np.abs(poses[:, 2] - heading) < 1e-9
        np.testing.assert_allclose(np.max(along[:, same], axis=1), bound[:, same][:, 0], atol=1e-5)


def test_motions_are_those_of_the_simulated_pursuer(x64):
    rng = np.random.default_rng(1)
    wheels, share = random_wheels(rng, 20, 3, 0.2, extreme=False)
    for speeds, times, pose in zip(wheels, share, wheel_motions(wheels, share, 0.2), strict=True):
        simulated = jnp.zeros(3)
        for speed, time in zip(speeds, times, strict=True):
            simulated = drive(simulated, jnp.asarray(speed), jnp.asarray(0.2), jnp.asarray(time))
        np.testing.assert_allclose(pose, simulated, atol=1e-12)


def test_the_value_is_the_barrier_of_the_capture_game(x64):
    game = CaptureGame(0.1574, 0.2, 0.2, 0.2)
    points = np.random.default_rng(2).normal(scale=0.4, size=(400, 2))
    for side in (1.0, -1.0):
        value, _ = jax.vmap(game.barrier, in_axes=(0, None))(jnp.asarray(points), side)
        own = np.where(points[:, 1] < 0.0, -1.0, 1.0) == side
        ours = side_value(points, float(game.usable_angle), side)
        np.testing.assert_allclose(ours[own], np.asarray(value)[own] + 0.2, atol=1e-12)


GAMES = {
    "20 Hz": SampledGame(**PAPER, control_period=0.05),
    "2 Hz": SampledGame(**PAPER, control_period=0.5),
    "errors": SampledGame(**PAPER, control_period=0.05, position_error=4e-3, heading_error=0.02),
    "motors": SampledGame(**PAPER, control_period=0.05, tracking_error=5e-3),
    "short axle": SampledGame(0.18, 0.22, 0.08, 0.1),
}
every_game = pytest.mark.parametrize("game", GAMES.values(), ids=GAMES.keys())


@pytest.fixture(scope="module")
def designs():
    return {game: best_design(game, COARSE) for game in GAMES.values()}


@every_game
@pytest.mark.parametrize("segments", [2, 3, 5])
def test_greedy_pursuers_never_break_the_certified_level(designs, game, segments):
    design = designs[game]
    played = chase(game, design, seed=segments, periods=60, segments=segments)
    assert played.least_value >= design.level
    assert played.least_distance >= design.level


@pytest.mark.parametrize("name", ["20 Hz", "2 Hz", "errors"])
def test_greedy_pursuers_do_break_a_higher_level(designs, name):
    game = GAMES[name]
    higher = Design(game.usable_angle, 1.02 * designs[game].level)
    assert chase(game, higher, seed=0, periods=60, segments=2).least_value < higher.level


@every_game
def test_the_bound_is_below_what_real_motions_do_and_not_far(designs, game):
    design = designs[game]
    assert 0.0 <= slack(game, design, COARSE) <= found_slack(game, design) + 1e-12
    above = broken_level(game, design)
    assert design.level <= above <= 1.02 * design.level
    assert found_slack(game, Design(design.angle, above + 1e-3)) < 0.0


def test_a_finer_grid_only_sharpens():
    game = GAMES["20 Hz"]
    design = Design(game.usable_angle + 1e-3, 0.197)
    values = [slack(game, design, Cells(n, n, n // 2)) for n in (8, 16, 32, 64)]
    assert values == sorted(values)


@pytest.mark.parametrize("period", [1e-3, 0.05])
def test_the_sampling_margin_has_the_size_that_theory_gives_it(period):
    """To first order delta = v_e rho^2 T/2: at the tip the pursuer turns until the evader is on its "
    "axis again."""
    game = SampledGame(**PAPER, control_period=period)
    margin = game.largest_capture_distance - best_design(game, Cells(16, 16, 16)).level
    expected = 0.5 * 0.1574 * 0.787**2 * period
    assert 0.98 * expected <= margin <= 1.08 * expected


def test_without_a_period_the_game_itself_comes_out():
    game = SampledGame(**PAPER, control_period=0.0)
    assert holds(game, game.largest_capture_distance - 1e-5, FINE)
    assert not holds(game, game.largest_capture_distance + 1e-9, COARSE)


def test_an_evader_that_measures_nothing_holds_nothing():
    assert best_design(SampledGame(**PAPER, control_period=0.05, position_error=1.0)) is None
    assert best_design(SampledGame(**PAPER, control_period=0.05, heading_error=1.0)) is None
