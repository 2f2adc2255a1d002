"""Hazards of a clearance table of a wall: one that promises what it does not keep, an evader pushed into the
wall, a wall taken for a disc, a distance that is said to do for ever where none does."""

import math
from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

pytest.importorskip("numba")

from sidestep.safety.clearance import ClearanceGame, ClearanceTable, Resolution, solve
from sidestep.safety.clearance.stored import StoredTable
from sidestep.world import load_scenario
from sidestep.world.capture_geometry import to_pursuer_axes, to_pursuer_frame

SLOWER = ClearanceGame(0.1574, 0.1, 0.2, 0.1, 0.1, 0.0, 0.05, 0.0005, math.radians(30.0), wall=True)
FASTER = replace(SLOWER, pursuer_speed=0.2, angle=math.radians(44.0), spare=0.0)
COARSE = Resolution(
    height=0.004, growth=1.4, share=0.03, share_growth=1.6, bearings=8, angles=64, ridge=0.04, headings=24,
    turns=3,
)  # fmt: skip


@pytest.fixture(scope="module")
def table():
    return ClearanceTable.of(SLOWER, solve(SLOWER, COARSE))


def boundary(table, count, seed):
    """States z and offsets p (m) on the boundary, where the wall matters."""
    generator = np.random.default_rng(seed)
    height = 0.1 * generator.random(count) ** 2
    bearing = math.pi * (2.0 * generator.random(count) - 1.0)
    beside = np.minimum(np.abs(bearing), math.pi - np.abs(bearing))
    distance = (SLOWER.capture_distance + height) / np.cos(np.maximum(SLOWER.angle - beside, 0.0))
    z = distance[:, None] * np.stack([np.cos(bearing), np.sin(bearing)], -1)
    phi = generator.uniform(-math.pi, math.pi, count)
    towards = np.stack([np.cos(phi), np.sin(phi)], -1)
    clearance = np.asarray(jax.jit(jax.vmap(table))(z, towards)[1])
    matters = clearance > SLOWER.collision_distance + 0.001
    return z[matters], (clearance[:, None] * towards)[matters]


def best_margins(table, z, p):
    moves = jnp.asarray(SLOWER.velocities(48) * SLOWER.control_period)
    poses = jnp.asarray(SLOWER.motions(8, 3))

    def best(z, p):
        return jnp.max(jax.vmap(lambda move: table.margin_after(z, p, move, poses, 0.0))(moves))

    return np.asarray(jax.jit(jax.vmap(best))(z, p))


def test_a_held_velocity_keeps_the_set_and_touching_distance_does_not(table):
    z, p = boundary(table, 4000, seed=1)
    assert len(z) > 200
    kept = best_margins(table, z, p)
    assert np.mean(kept >= 0.0) > 0.95
    assert np.min(kept) > -0.002
    touching = SLOWER.collision_distance * p / np.linalg.norm(p, axis=-1, keepdims=True)
    assert np.mean(best_margins(table, z, touching) >= 0.0) < 0.5


def test_a_distant_pursuer_leaves_all_but_the_wall_itself(table):
    phi = np.linspace(-math.pi, math.pi, 50)
    _, clearance = jax.jit(jax.vmap(table, in_axes=(None, 0)))(
        np.array([0.6, 0.1]), np.stack([np.cos(phi), np.sin(phi)], -1)
    )
    np.testing.assert_allclose(clearance, SLOWER.collision_distance, atol=0.002)


def test_mirror_and_reverse_are_the_same_state(table):
    generator = np.random.default_rng(0)
    z, p = generator.uniform(0.05, 0.2, (200, 2)), generator.uniform(-0.5, 0.5, (200, 2))
    look_up = jax.jit(jax.vmap(table))
    height, clearance = look_up(z, p)
    for flip in ((1.0, -1.0), (-1.0, 1.0), (-1.0, -1.0)):
        other = look_up(z * np.array(flip), p * np.array(flip))
        np.testing.assert_allclose(other[0], height, atol=1e-6)
        np.testing.assert_allclose(other[1], clearance, atol=5e-5)


def test_only_moves_along_the_normal_count(table):
    z, poses = jnp.array([0.3, 0.2]), jnp.zeros((1, 3))
    offset, along, beside = jnp.array([0.0, 0.2]), jnp.array([0.0, -0.005]), jnp.array([0.005, 0.0])
    now = float(jax.jit(lambda z, p: table.margin(z, p))(z, offset))
    after = jax.jit(lambda offset, move: table.margin_after(z, offset, move, poses, 0.0))
    assert float(after(offset, beside)) == pytest.approx(now, abs=1e-4)
    assert float(after(offset, along)) == pytest.approx(now - 0.005, abs=1e-4)
    beyond = after(jnp.array([0.0, 0.001]), along)
    assert float(beyond) < -SLOWER.collision_distance


def test_no_pursuer_captures_an_evader_that_keeps_its_set_or_pushes_it_into_the_wall(table):
    """Evaders that want into the wall, against pursuers that know the table and the velocity chosen."""
    z, p = boundary(table, 400, seed=2)
    z, p = z[:64], p[:64]
    moves = jnp.asarray(SLOWER.velocities(48) * SLOWER.control_period)
    poses = jnp.asarray(SLOWER.motions(8, 3))

    def heights(place):
        return jax.vmap(lambda pose: table.grid.height(jnp, *to_pursuer_frame(place, pose)))(poses)

    def period(state, key, strategy):
        z, p = state
        margins = jax.vmap(
            lambda move: jnp.minimum(jnp.min(heights(z + move)), table.spare_after(z, p, move, 0.0))
        )(moves)
        inwards = -moves @ p
        chosen = moves[
            jnp.where(
                jnp.any(margins >= 0.0),
                jnp.argmax(jnp.where(margins >= 0.0, inwards, -1.0)),
                jnp.argmax(margins),
            )
        ]
        moved, distance = table._moved(p, chosen)
        q = distance * moved / jnp.hypot(moved[0], moved[1])
        after = jax.vmap(
            lambda pose: jnp.stack(
                [
                    table.margin(to_pursuer_frame(z + chosen, pose), to_pursuer_axes(q, pose[2])),
                    table.grid.height(jnp, *to_pursuer_frame(z + chosen, pose)),
                ]
            )
        )(poses)
        noise = jax.random.uniform(key, (len(poses),))
        pose = poses[jnp.argmin(jnp.stack([after[:, 0], after[:, 1], noise])[strategy])]
        new = to_pursuer_frame(z + chosen, pose), to_pursuer_axes(q, pose[2])
        return new, (jnp.hypot(*new[0]), distance)

    @jax.jit
    def chase(z, p, key, strategy):
        def step(state, key):
            return period(state, key, strategy)

        return jax.lax.scan(step, (z, p), jax.random.split(key, 300))[1]

    keys = jax.random.split(jax.random.key(0), len(z))
    for strategy in range(3):
        pursuer, wall = jax.vmap(chase, in_axes=(0, 0, 0, None))(z, p, keys, strategy)
        assert float(jnp.min(pursuer)) > SLOWER.capture_distance - 1e-3, strategy
        assert float(jnp.min(wall)) > SLOWER.collision_distance - 1e-3, strategy


@pytest.fixture(scope="module")
def two_seconds():
    return solve(FASTER, COARSE, periods=40)


def test_a_very_large_disc_is_a_wall(two_seconds):
    """For the same nodes and time: the disc bends by s^2/(2 d) along the wall."""
    disc = replace(FASTER, collision_distance=16.0, wall=False)
    fresh = np.full_like(two_seconds.clearance, disc.collision_distance)
    begun = two_seconds._replace(clearance=fresh, after=fresh, sweeps=0, change=math.inf)
    solved = solve(disc, COARSE, periods=40, most=18.0, begun=begun)
    beyond = two_seconds.clearance - FASTER.collision_distance
    assert np.max(beyond) > 0.1
    np.testing.assert_allclose(solved.clearance - disc.collision_distance, beyond, atol=0.005)


@pytest.mark.slow
def test_against_a_faster_pursuer_no_distance_does_for_ever():
    """It herds the evader at a steady rate: from the fourth second on each asks for as much more."""
    needed = {}

    def note(solution):
        if solution.stage == 2 and solution.sweeps % 20 == 0:
            needed[solution.sweeps] = float(np.max(solution.clearance))

    solve(FASTER, replace(COARSE, height=0.006, growth=1.5, angles=48), periods=120, progress=note)
    rises = np.diff([needed[sweeps] for sweeps in (80, 100, 120)])
    assert np.all(rises > 0.015)
    assert rises[1] == pytest.approx(rises[0], rel=0.2)


def test_a_wall_is_taken_for_no_disc(table, tmp_path):
    scenario = load_scenario("paper-0.10")
    assert replace(ClearanceGame.of(scenario), wall=True).refuses(scenario) == (
        "its obstacles are discs, the table's is a wall"
    )
    kept = tmp_path / "wall.npz"
    table.save(kept)
    loaded = ClearanceTable.load(kept)
    assert loaded.game == SLOWER
    with pytest.raises(ValueError, match="it is of a wall"):
        StoredTable(kept)
    # So the files and cache keys of discs stay as they were.
    assert "wall" not in replace(SLOWER, wall=False).as_dict
