"""Hazards of the clearance table: a side interpolated away, a table that does not keep its own promise, a
solution lost to an interrupt."""

import math
from dataclasses import replace

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

pytest.importorskip("numba")

from sidestep.safety.clearance import (
    STEP,
    ClearanceGame,
    ClearanceTable,
    Resolution,
    clearance_table,
    solve,
)
from sidestep.safety.clearance.grid import Angles, Spacing
from sidestep.world import load_scenario
from sidestep.world.capture_geometry import to_pursuer_frame

# What is to spare absorbs the interpolation.
GAME = ClearanceGame(0.1574, 0.2, 0.2, 0.1, 0.2, 0.02, 0.05, 0.0015, math.radians(44.0))
COARSE = Resolution(
    height=0.003, growth=1.35, share=0.02, share_growth=1.5, bearings=10, angles=72, ridge=0.03, headings=24,
    turns=3,
)  # fmt: skip


@pytest.fixture(scope="module")
def solution():
    return solve(GAME, COARSE)


@pytest.fixture(scope="module")
def short():
    """For one second, in a fifth of the time."""
    return solve(GAME, COARSE, periods=20)


@pytest.fixture(scope="module")
def table(solution):
    return ClearanceTable.of(GAME, solution)


def test_every_node_is_found_where_it_is():
    grid = COARSE.grid(GAME)
    points = grid.points
    place = grid.place(np, points[:, 0], np.abs(points[:, 1]))
    node, weight = place.corners(np)
    nearest = node[np.arange(len(node)), np.argmax(weight, -1)]
    count = grid.heights.count
    # Rounding decides whether b = 0 is open or committed, and below the axis lie mirror images.
    mine = (points[:, 1] >= 0.0) & (np.arange(grid.size) % count > 0) | (np.arange(grid.size) >= count**2)
    assert np.all(np.max(weight, -1)[mine] > 1.0 - 1e-6)
    np.testing.assert_array_equal(nearest[mine], np.flatnonzero(mine))


def test_nothing_is_interpolated_across_the_loss_of_a_side():
    grid = COARSE.grid(GAME)
    # Just above and below b = 0, from the axis on.
    cosine, sine = math.cos(GAME.angle), math.sin(GAME.angle)
    for height in (0.0, 0.01, 0.05):
        for other, first in ((1e-9, True), (-1e-9, False)):
            x = (height + other + 2.0 * GAME.capture_distance) / (2.0 * cosine)
            y = (height - other) / (2.0 * sine)
            place = grid.place(np, np.asarray(x), np.asarray(y))
            node, _ = place.corners(np)
            assert np.all((node < grid.first_committed) == first)
            assert place.height == pytest.approx(height, abs=1e-8)


def test_mirror_and_reverse_are_the_same_state(table):
    generator = np.random.default_rng(0)
    look_up = jax.jit(jax.vmap(table))
    z = generator.uniform(0.05, 0.3, (200, 2))
    p = generator.uniform(-0.5, 0.5, (200, 2))
    height, clearance = look_up(z, p)
    for flip in ((1.0, -1.0), (-1.0, 1.0), (-1.0, -1.0)):
        other = look_up(z * np.array(flip), p * np.array(flip))
        np.testing.assert_allclose(other[0], height, atol=1e-6)
        np.testing.assert_allclose(other[1], clearance, atol=2e-5)


@pytest.mark.parametrize("places", [Spacing.up_to(0.4, 0.002, 1.2), Angles(0.3, 64), Angles(1e3, 96)])
def test_nodes_have_their_own_number_and_middles_half_a_weight(places):
    nodes = places.nodes
    cell, weight = places.place(np, nodes[:-1])
    np.testing.assert_allclose(cell + weight, np.arange(len(nodes) - 1), atol=1e-6)
    cell, weight = places.place(np, (nodes[1:] + nodes[:-1]) / 2.0)
    np.testing.assert_array_equal(cell, np.arange(len(nodes) - 1))
    np.testing.assert_allclose(weight, 0.5, atol=1e-6)


def best_margins(table, states, offsets):
    """The best margin (m) after a period that one of the evader's velocities has against every motion."""
    moves, poses = (
        jnp.asarray(part) for part in (GAME.velocities(48) * GAME.control_period, GAME.motions(8, 3))
    )

    def best(z, p):
        return jnp.max(
            jax.vmap(lambda move: table.margin_after(z, p, move, poses, 0.02 * GAME.control_period))(moves)
        )

    return np.asarray(jax.jit(jax.vmap(best))(states, offsets))


def test_a_held_velocity_keeps_the_set_and_collision_distance_alone_does_not(table):
    generator = np.random.default_rng(1)
    count = 500
    height = 0.06 * generator.random(count) ** 2
    bearing = math.pi / 2.0 * generator.random(count) ** 2
    distance = (GAME.capture_distance + height) / np.cos(np.maximum(GAME.angle - bearing, 0.0))
    states = distance[:, None] * np.stack([np.cos(bearing), np.sin(bearing)], -1)
    phi = generator.uniform(-math.pi, math.pi, count)
    towards = np.stack([np.cos(phi), np.sin(phi)], -1)
    _, clearance = jax.jit(jax.vmap(table))(states, towards)
    clearance = np.asarray(clearance)
    matters = clearance > GAME.collision_distance + 0.001
    assert 0.1 < np.mean(matters) < 0.6
    states, towards, clearance = states[matters], towards[matters], clearance[matters]
    kept = best_margins(table, states, clearance[:, None] * towards)
    assert np.mean(kept >= 0.0) > 0.97
    assert np.min(kept) > -0.005
    # The same check for a set that keeps each robot away by itself: it breaks.
    least = round(GAME.collision_distance / STEP)
    alone = eqx.tree_at(lambda t: t.clearance, table, jnp.full_like(table.clearance, least))
    touching = best_margins(alone, states, GAME.collision_distance * towards)
    assert np.mean(touching >= 0.0) < 0.9


def test_longer_asks_for_more_and_no_time_for_nothing(solution, short):
    tables = [*(solve(GAME, COARSE, periods=periods) for periods in (0, 5)), short]
    assert np.all(tables[0].clearance == np.float32(GAME.collision_distance))
    largest = [float(np.max(one.clearance)) for one in (*tables, solution)]
    assert largest[0] < largest[1] < largest[2] < largest[3] < 0.5
    # Each period can ask for no more than both robots can come nearer in it.
    closing = (GAME.evader_speed + GAME.obstacle_speed) * GAME.control_period + GAME.spare
    assert largest[1] <= GAME.collision_distance + 5 * closing


def test_more_than_a_table_holds_is_refused(solution):
    """It would wrap round to a small clearance."""
    far = solution._replace(clearance=solution.clearance + 1.2)
    with pytest.raises(ValueError, match=r"clearance of 1\.\d+ m: a table holds 1\.31 m at most"):
        ClearanceTable.of(GAME, far)


def test_a_table_of_some_periods_keeps_saying_so(solution, tmp_path):
    path = tmp_path / "short.npz"
    ClearanceTable.of(GAME, solution, 20).save(path)
    assert ClearanceTable.load(path).periods == 20
    ClearanceTable.of(GAME, solution).save(path)
    assert ClearanceTable.load(path).periods is None


@pytest.mark.parametrize("periods", [20, pytest.param(None, marks=pytest.mark.slow)])
def test_an_interrupted_solution_goes_on_and_ends_the_same(periods, request, tmp_path, monkeypatch):
    uninterrupted = request.getfixturevalue("short" if periods else "solution")
    monkeypatch.setenv("SIDESTEP_CACHE", str(tmp_path))
    seen = []

    def interrupt(on_the_way):
        seen.append((on_the_way.stage, on_the_way.sweeps))
        if seen[-1] == (1, 10):
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        clearance_table(GAME, COARSE, periods=periods, progress=interrupt)
    (part,) = (tmp_path / "clearance").iterdir()
    assert part.name.endswith(".part.npz")
    begun = len(seen)
    table = clearance_table(GAME, COARSE, periods=periods, progress=interrupt)
    assert seen[begun] == (1, 11)
    whole = ClearanceTable.of(GAME, uninterrupted, periods)
    np.testing.assert_array_equal(table.clearance, whole.clearance)
    np.testing.assert_array_equal(table.after, whole.after)
    (kept,) = (tmp_path / "clearance").iterdir()
    # Kept: another call solves nothing.
    again = clearance_table(GAME, COARSE, periods=periods, progress=lambda _: pytest.fail("solved again"))
    np.testing.assert_array_equal(again.clearance, table.clearance)
    assert (again.game, again.grid, again.directions) == (table.game, table.grid, table.directions)
    kept.write_bytes(b"torn")
    with pytest.raises(ValueError, match="no clearance table of this version"):
        ClearanceTable.load(kept)


def test_a_scenario_names_its_game_and_one_without_a_table_is_refused():
    game = ClearanceGame.of(load_scenario("paper", capture_distance=0.15))
    assert game.obstacle_speed == pytest.approx(0.02)
    assert math.degrees(game.angle) == pytest.approx(39.5, abs=0.5)
    assert len(game.velocities(48)) == 49
    driving = ClearanceGame.of(load_scenario("paper", capture_distance=0.15, action="heading"))
    assert len(driving.velocities(48)) == 48
    with pytest.raises(ValueError, match=r"no design angle keeps the pursuer 0\.2 m away"):
        ClearanceGame.of(load_scenario("paper"))
    with pytest.raises(ValueError, match="no velocity keeps the pursuit barrier"):
        solve(ClearanceGame(0.1574, 0.2, 0.2, 0.2, 0.2, 0.02, 0.05, 0.0, math.radians(44.0)), COARSE)
    with pytest.raises(ValueError, match=r"resolution: growth = 1\.0: it must be"):
        solve(GAME, Resolution(growth=1.0))
    with pytest.raises(ValueError, match="angles = 99: it must be even"):
        solve(GAME, Resolution(angles=99))
    with pytest.raises(ValueError, match=r"clearance game: .*half_axle = nan"):
        solve(replace(GAME, half_axle=math.nan), COARSE)


def test_derivatives_are_those_of_the_cell(table):
    z, p = jnp.array([0.16, 0.02]), jnp.array([-0.1, -0.35])
    margin = jax.jit(lambda z: table.margin(z, p))
    gradient = jax.grad(margin)(z)
    step = 1e-3 * gradient / jnp.linalg.norm(gradient)
    change = margin(z + step) - margin(z - step)
    assert float(change) == pytest.approx(2e-3 * float(jnp.linalg.norm(gradient)), rel=0.2)


def test_one_look_does_for_every_motion_of_a_period(table):
    generator = np.random.default_rng(2)
    count = 400
    bearing = math.pi * (2.0 * generator.random(count) - 1.0)
    beside = np.minimum(np.abs(bearing), math.pi - np.abs(bearing))
    distance = (GAME.capture_distance + 0.02 + 0.05 * generator.random(count)) / np.cos(
        np.maximum(GAME.angle - beside, 0.0)
    )
    z = distance[:, None] * np.stack([np.cos(bearing), np.sin(bearing)], -1)
    p = generator.uniform(-0.4, 0.4, (count, 2))
    moves = jnp.asarray(generator.uniform(-0.005, 0.005, (count, 2)))
    poses = jnp.asarray(GAME.motions(12, 3))

    def both(z, p, move):
        height = jnp.min(
            jax.vmap(lambda pose: table.grid.height(jnp, *to_pursuer_frame(z + move, pose)))(poses)
        )
        one = jnp.minimum(height, table.spare_after(z, p, move, 0.001))
        return one, table.margin_after(z, p, move, poses, 0.001)

    one, every = jax.jit(jax.vmap(both))(z, p, moves)
    difference = np.asarray(one - every)
    assert np.mean(np.abs(difference) < 1e-3) > 0.9
    # It promises too much nowhere by more than the coarse grid's own error.
    assert np.max(difference) < 0.012
    assert np.mean(difference > 0.003) < 0.02
