"""Hazards of the checker of clearance tables: a lookup unlike the table's, bounds that are none, a bad table
that passes, a motion of the pursuer that is not thought of."""

import math
import shutil
import subprocess
import sys
from pathlib import Path

import jax
import numpy as np
import pytest

from sidestep.safety.clearance import STEP, ClearanceTable
from sidestep.safety.clearance.check import Box, Checker
from sidestep.safety.clearance.stored import ARC, COMMITTED, OPEN, StoredTable
from sidestep.safety.sampled.flow_map import seen_from, wheel_motions
from sidestep.store.checkpoints import CheckpointError, read_named, write_arrays
from sidestep.store.files import read_json

ROOT = Path(__file__).parents[2]
TABLES = ROOT / "src/sidestep/safety/clearance/tables"
PATHS = EASY, NARROW = [TABLES / f"paper-{distance}.npz" for distance in ("0.10", "0.15")]
# By region, away from the jumps, where the obstacle matters.
BOXES = (
    Box(OPEN, (0.0325, 0.0326), (0.0019, 0.0020), (-2.679, -2.678)),
    Box(COMMITTED, (0.0130, 0.0132), (-0.0077, -0.0075), (-2.435, -2.434)),
    Box(ARC, (0.0006, 0.0007), (1.0525, 1.0535), (-1.497, -1.496)),
)


@pytest.fixture(scope="module")
def stored():
    return StoredTable(EASY)


@pytest.mark.parametrize("path", PATHS)
def test_the_lookup_is_that_of_the_table(path):
    generator = np.random.default_rng(0)
    z, phi = generator.uniform(-0.35, 0.35, (4000, 2)), generator.uniform(-4.0, 4.0, 4000)
    towards = np.stack([np.cos(phi), np.sin(phi)], -1)
    height, clearance = StoredTable(path).lookup(z, phi)
    others = jax.jit(jax.vmap(ClearanceTable.load(path)))(z, towards)
    np.testing.assert_allclose(height, others[0], atol=1e-6)
    np.testing.assert_allclose(clearance, others[1], atol=1e-5)


@pytest.mark.parametrize("region", [OPEN, COMMITTED, ARC])
@pytest.mark.parametrize("path", PATHS)
def test_no_clearance_in_a_box_is_beyond_its_bounds(path, region):
    stored, generator, count = StoredTable(path), np.random.default_rng(region), 200
    low = 0.08 * generator.random(count) ** 2
    first = {
        OPEN: low * generator.random(count),
        COMMITTED: -0.07 * generator.random(count) ** 2 - 1e-3,
        ARC: generator.uniform(stored.angle, 1.55, count),
    }[region]
    least = generator.uniform(-math.pi, math.pi, count)
    high, last, most = (part + generator.uniform(0.0, 1e-3, count) for part in (low, first, least))
    bounds = stored.bounds(region, low, high, first, last, least, most * np.ones(count))
    found = np.flatnonzero(~np.isnan(bounds[0]))
    assert len(found) > 0.8 * count
    for number in found:
        height, along, phi = (
            generator.uniform(ends[0][number], ends[1][number], 1000)
            for ends in ((low, high), (first, last), (least, most))
        )
        _, values = stored.lookup(_at(stored, region, height, along), phi)
        assert bounds[0][number] - 1e-9 <= np.min(values)
        assert np.max(values) <= bounds[1][number] + 1e-9


def _at(stored, region, height, along):
    """z by the coordinates of a box."""
    if region == ARC:
        return (stored.level + height)[:, None] * np.stack([np.cos(along), np.sin(along)], -1)
    ahead = (height + along + 2.0 * stored.level) / (2.0 * math.cos(stored.angle))
    return np.stack([ahead, (height - along) / (2.0 * math.sin(stored.angle))], -1)


@pytest.mark.parametrize("box", BOXES)
def test_a_good_box_is_verified_and_real_motions_keep_its_set(stored, box):
    checker = Checker(stored, 0.02)
    verdict = checker.check(box)
    assert verdict.verified
    assert 0.0 <= verdict.dip < 1e-4
    move, _, _ = checker.move(box)
    assert move is not None
    generator, count = np.random.default_rng(1), 20_000
    height, along, phi = (generator.uniform(*ends, count) for ends in box[1:])
    z = _at(stored, box.region, height, along)
    _, clearance = stored.lookup(z, phi)
    speed, period = stored.game["pursuer_speed"], stored.game["control_period"]
    # Full wheel speed in every other sequence; three pieces of any lengths.
    wheels = generator.uniform(-speed, speed, (count, 3, 2))
    wheels[::2] = speed * np.sign(wheels[::2])
    durations = period * generator.dirichlet(np.full(3, 0.4), count)
    poses = wheel_motions(wheels, durations, stored.game["half_axle"])
    begins = np.concatenate([np.zeros((count, 1)), np.cumsum(durations, 1)[:, :-1]], 1)
    angle = generator.uniform(-math.pi, math.pi, count)
    drift = 0.02 * period * np.stack([np.cos(angle), np.sin(angle)], -1)
    for farther in (0.0, 0.001, 0.02):
        p = (clearance + farther)[:, None] * np.stack([np.cos(phi), np.sin(phi)], -1) + move - drift
        after, needed = stored.lookup(seen_from(z + move, poses), np.arctan2(p[:, 1], p[:, 0]) - poses[:, 2])
        assert np.min(after) >= 0.0
        assert np.min(np.hypot(*p.T) - needed) >= 0.0
    for share in (0.2, 0.5, 0.8):
        so_far = np.clip(share * period - begins, 0.0, durations)
        place = wheel_motions(wheels, so_far, stored.game["half_axle"])[:, :2]
        assert np.min(np.hypot(*(z + share * move - place).T)) >= stored.level - verdict.dip
        p = clearance[:, None] * np.stack([np.cos(phi), np.sin(phi)], -1) + share * (move - drift)
        assert np.min(np.hypot(*p.T)) >= stored.game["collision_distance"] - verdict.dip


def test_a_table_that_asks_for_the_collision_distance_only_is_not_verified(stored):
    lowered = StoredTable(EASY)
    lowered.rows[:], lowered.slopes[:] = stored.game["collision_distance"], 0.0
    verdicts = [Checker(lowered, 0.02).check(box) for box in BOXES]
    assert not all(verdict.verified for verdict in verdicts)
    assert any(verdict.refuted and verdict.shortfall > 1e-4 for verdict in verdicts)
    # An obstacle faster than what the table was solved for is too much as well.
    assert not Checker(stored, 0.3).check(BOXES[1]).verified


def test_a_damaged_file_is_refused(tmp_path):
    torn = tmp_path / "torn.npz"
    torn.write_bytes(EASY.read_bytes()[:-5000])
    with pytest.raises(CheckpointError, match="damaged"):
        StoredTable(torn)
    arrays, about = read_named(EASY)
    plain = {name[2:-2]: array for name, array in arrays.items()}
    about = {name: part for name, part in about.items() if name not in ("digest", "rows")}
    clearance = plain["clearance"].copy()
    clearance[1000, 7] = round(0.19 / STEP)
    for name, tree, header, said in (
        ("low", {**plain, "clearance": clearance}, about, "less than the collision distance"),
        ("short", {**plain, "clearance": clearance[:-1]}, about, "clearances, not"),
        ("headless", plain, {**about, "game": {}}, "no clearance table"),
        ("old", plain, {**about, "format": 1}, "format 1, not 3"),
    ):
        write_arrays(tmp_path / name, tree, **header)
        with pytest.raises(ValueError, match=said):
            StoredTable(tmp_path / name)


def test_a_campaign_goes_on_refuses_other_arguments_and_merges(tmp_path):
    table = tmp_path / "table.npz"
    shutil.copy(EASY, table)

    def run(*arguments):
        command = [sys.executable, "benchmarks/clearance_check.py", *map(str, arguments)]
        return subprocess.run(command, cwd=ROOT, capture_output=True, text=True)

    first, second, both = (tmp_path / f"{name}.json" for name in ("first", "second", "both"))
    assert run(table, "--boxes", 4, "--shard", "0/2", "--json", first).returncode == 0
    kept = read_json(first)
    assert run(table, "--boxes", 4, "--shard", "0/2", "--json", first).returncode == 0
    assert read_json(first) == kept
    other = run(table, "--boxes", 4, "--seed", 1, "--shard", "0/2", "--json", first)
    assert other.returncode != 0
    assert "other arguments" in other.stderr
    assert run(table, "--boxes", 4, "--shard", "1/2", "--json", second).returncode == 0
    assert run("--merge", first, second, "--json", both).returncode == 0
    result = read_json(both)
    assert result["boxes"] == 4
    assert result["share at least"] <= result["share"] <= result["share at most"]
    assert run("--merge", first, first).returncode != 0


def test_a_table_that_is_not_for_ever_is_none_to_prove():
    with pytest.raises(ValueError, match="it is for some periods"):
        StoredTable(TABLES / "paper.npz")
