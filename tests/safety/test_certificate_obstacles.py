"""Hazards of what a certificate says about obstacles: a claim where there is no table, a clearance that is
not the table's, a start inside the set to keep out of, errors that the table knows nothing of."""

import json
import math
from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from sidestep import load_scenario
from sidestep.cli import main
from sidestep.safety import certify
from sidestep.safety.certificate import obstacles
from sidestep.safety.clearance import checked, shipped_table

SCENARIO = load_scenario("paper-0.15")
TABLE = shipped_table(SCENARIO)


@pytest.fixture(scope="module")
def certificate():
    return certify(SCENARIO, start=(0.25, 0.05), obstacle=(0.6, 0.1), check_shield=False)


def said(certificate, kind):
    return " ".join(claim.text for claim in certificate.claims if claim.kind == kind)


def test_the_claims_name_the_tables_own_distances(certificate):
    found = certificate.obstacles
    assert found.beyond == pytest.approx(TABLE.farthest)
    assert 0.5 < found.beyond < 0.6
    assert found.smallest_gap == pytest.approx(2.0 * (found.beyond + (0.1574 + 0.02) * 0.05), abs=1e-6)
    computed = said(certificate, "computed")
    assert f"farther than {found.beyond:.3g} m away can stay free of both for ever" in computed
    assert f"at least {found.smallest_gap:.3g} m apart" in computed
    assert "up to 0.02 m/s" in computed
    assert "goes by the table alone" in said(certificate, "not claimed")
    assert max(one.worst for one in found.directions) <= found.beyond
    for one in found.directions:
        assert 0.2 - 1e-6 <= one.best <= one.worst
    # Farther from the capture set an obstacle may come nearer.
    ahead = [one.worst for one in found.directions if one.bearing == math.radians(5.0)]
    assert ahead == sorted(ahead, reverse=True)


def test_a_start_and_an_obstacle_are_judged_by_the_table(certificate):
    found = certificate.obstacles
    z, offset = jnp.array([0.25, 0.05]), jnp.array([0.25 - 0.6, 0.05 - 0.1])
    assert found.obstacle_margin == pytest.approx(float(TABLE.margin(z, offset)))
    directions = np.linspace(-math.pi, math.pi, 720, endpoint=False)
    look = jax.jit(lambda towards: TABLE(z, towards)[1])
    needed = [float(look(jnp.array([math.cos(angle), math.sin(angle)]))) for angle in directions[::30]]
    assert max(needed) <= found.start_clearance + 1e-6
    assert "mm farther away than needed" in said(certificate, "computed")
    near = certify(SCENARIO, start=(0.25, 0.05), obstacle=(0.44, 0.1), check_shield=False)
    assert near.obstacles.obstacle_margin < 0.0
    assert "mm are missing" in said(near, "not claimed")
    inside = certify(SCENARIO, start=(0.15, 0.0), obstacle=(0.9, 0.0), check_shield=False)
    assert "inside the set to keep out of" in said(inside, "not claimed")


@pytest.mark.parametrize(
    "options, why",
    [
        ({"position_error": 0.001}, "exact measurements"),
        ({"walls": True}, "one pursuer in the open"),
    ],
)
def test_nothing_is_claimed_where_the_table_does_not_apply(options, why):
    certificate = certify(SCENARIO, obstacles=True, check_shield=False, **options)
    assert certificate.obstacles is None
    assert why in said(certificate, "not claimed")


def test_where_the_pursuer_alone_cannot_be_kept_away_the_reason_is_given():
    scenario = load_scenario("paper", capture_distance=0.25)
    certificate = certify(scenario, obstacles=True, check_shield=False)
    assert certificate.obstacles is None
    assert "no design angle keeps the pursuer 0.25 m away" in said(certificate, "not claimed")


def test_where_the_pursuer_can_nearly_be_kept_away_it_is_said_for_how_long():
    certificate = certify(load_scenario("paper"), obstacles=True, check_shield=False)
    assert certificate.obstacles.seconds == pytest.approx(4.0)
    assert "outside the capture set of 0.197884 m" in said(certificate, "computed")
    assert "free of both for 4 s" in said(certificate, "computed")
    assert "still can in 4 s" in said(certificate, "not claimed")


def test_an_obstacle_without_a_start_is_refused():
    with pytest.raises(ValueError, match="give the start, too"):
        certify(SCENARIO, obstacle=(0.6, 0.1))


def test_a_drift_too_fast_for_any_distance_is_found(monkeypatch):
    pytest.importorskip("numba")
    tried = []

    def lasts(game):
        tried.append(game.obstacle_speed)
        return game.obstacle_speed <= 0.071

    monkeypatch.setattr(obstacles, "_lasts", lasts)
    fastest = obstacles.fastest_drift(TABLE.game, 0.02, lambda _: None)
    assert 0.066 <= fastest <= 0.071
    assert all(0.02 < speed < 0.16 for speed in tried)


@pytest.mark.slow
def test_a_coarse_table_ends_for_a_slow_obstacle_and_not_for_one_as_fast_as_the_evader():
    pytest.importorskip("numba")
    game = shipped_table(load_scenario("paper-0.10")).game
    assert obstacles._lasts(game)
    assert not obstacles._lasts(replace(game, obstacle_speed=0.16))


def test_the_command_writes_figures_and_json(tmp_path, capsys):
    outputs = ["--json", str(tmp_path / "c.json"), "--figure", str(tmp_path / "c.png")]
    status = main(["certify", "--scenario", "paper-0.15", "--obstacles", "--no-shield", *outputs])
    assert status == 0
    assert "c-obstacles.png" in capsys.readouterr().out.replace("\n", "")
    assert {path.name for path in tmp_path.iterdir()} == {
        "c.json", "c.png", "c.pdf", "c-obstacles.png", "c-obstacles.pdf",
    }  # fmt: skip
    figures = json.loads((tmp_path / "c.json").read_text())
    assert figures["obstacles"]["beyond"] == pytest.approx(TABLE.farthest)
    assert len(figures["obstacles"]["directions"]) == 16


def test_the_proved_share_is_that_of_the_very_table(certificate):
    found = certificate.obstacles.checked
    assert found is not None
    assert found == checked(TABLE)
    assert 0 < found.verified <= found.boxes - found.refuted
    assert found.at_least < found.verified / found.boxes
    text = f"of {found.boxes} small boxes of states, drawn where it matters, {found.verified} verify"
    assert text in said(certificate, "measured")
    # Another table, though of the same game, has no result.
    assert checked(replace(TABLE, sweeps=TABLE.sweeps + 1)) is None
    assert checked(shipped_table(load_scenario("paper"))) is None
