"""Suggestions: does the certificate hold with each of them, taken as printed, and not with a little less?"""

import json

import pytest

from sidestep.cli import main
from sidestep.safety.certificate.guarantee import certify, clearance_of
from sidestep.safety.certificate.nearest_changes import (
    MINE,
    PARAMETERS,
    WHOSE,
    changed,
    nearest_changes,
    nearest_pairs,
)
from sidestep.safety.certificate.situation import Situation
from sidestep.safety.sampled.sampled_game import SampledGame
from sidestep.world import load_scenario

ALL = tuple(WHOSE)
CLOSE = Situation(SampledGame(0.1574, 0.2, 0.2, 0.05), 0.2)
MEASURED = Situation(SampledGame(0.2, 0.2272, 0.08, 0.1, delay=0.05), 0.15)
LOST = Situation(SampledGame(0.1574, 0.22, 0.08, 0.05, position_error=0.002), 0.06)


def guaranteed(situation):
    return clearance_of(situation)[0] >= situation.capture_distance


def found(situation, mine, certified=None):
    clearance, budget, _ = certified or clearance_of(situation)
    alone = nearest_changes(situation, clearance, mine)
    return alone, nearest_pairs(situation, budget, alone, mine)


def values(changes, share=1.0):
    return {change.parameter: change.now + share * (change.needed - change.now) for change in changes}


def check(situation, changes):
    for change in changes:
        assert float(f"{change.needed:.6g}") == change.needed
    assert guaranteed(changed(situation, values(changes))), changes
    assert not guaranteed(changed(situation, values(changes, 0.9))), changes


@pytest.mark.parametrize(
    "situation, mine",
    [
        (CLOSE, MINE),
        pytest.param(CLOSE, ALL, marks=pytest.mark.slow),
        pytest.param(MEASURED, ALL, marks=pytest.mark.slow),
        pytest.param(LOST, ALL, marks=pytest.mark.slow),
    ],
)
def test_each_suggestion_as_printed_is_guaranteed_and_a_tenth_less_is_not(situation, mine):
    assert not guaranteed(situation)
    alone, pairs = found(situation, mine)
    assert {change.parameter for change in alone} == set(PARAMETERS)
    useful = [change for change in alone if change.needed is not None]
    assert len(useful) >= 4
    assert pairs
    for change in useful:
        if change.mine:
            check(situation, [change])
    singles = {change.parameter: change.share for change in useful}
    for pair in pairs:
        check(situation, pair.changes)
        for change in pair.changes:
            assert change.share == pytest.approx(pair.share, rel=1e-2)
            assert pair.share < singles.get(change.parameter, 1.0)


@pytest.fixture(scope="module")
def lost():
    certified = clearance_of(LOST)
    return {mine: found(LOST, mine, certified) for mine in (MINE, ("pursuer",))}


def test_what_can_be_changed_comes_first_and_the_smallest_of_it_before_the_rest(lost):
    for mine, (alone, _) in lost.items():
        owned = [change.mine for change in alone]
        assert owned == sorted(owned, reverse=True)
        assert {change.parameter for change in alone if change.mine} == {
            parameter for owner in mine for parameter in WHOSE[owner]
        }
        for group in (True, False):
            shares = [change.share for change in alone if change.mine is group]
            answered = [share for share in shares if share is not None]
            assert shares == [*sorted(answered), *[None] * (len(shares) - len(answered))]


def test_pairs_change_only_what_can_be_changed_by_clearly_less_than_alone(lost):
    for mine, (alone, pairs) in lost.items():
        assert pairs
        single = {change.parameter: change.share for change in alone}
        for pair in pairs:
            for change in pair.changes:
                assert change.whose in mine
                assert change.mine
                assert single[change.parameter] is None or pair.share <= 0.9 * single[change.parameter]
    assert [change.parameter for change in lost[("pursuer",)][1][0].changes] == list(WHOSE["pursuer"])


def test_every_parameter_is_somebodys():
    assert sorted(sum(WHOSE.values(), ())) == sorted(PARAMETERS)


@pytest.mark.parametrize("options, fields", [({"walls": True}, {}), ({}, {"pursuer_count": 2})])
def test_where_no_change_helps_no_pair_is_named(options, fields):
    certificate = certify(load_scenario("paper", **fields), check_shield=False, **options)
    assert certificate.nearest_pairs == ()
    assert all(change.needed is None for change in certificate.nearest_changes)


def test_unknown_owner_is_named():
    with pytest.raises(ValueError, match="mine = 'me'"):
        certify(load_scenario("paper"), mine=("me",))


def test_command_names_robots_and_marks_what_is_not_yours_within_80_columns(tmp_path, capsys, monkeypatch):
    monkeypatch.setenv("COLUMNS", "80")
    path = tmp_path / "certificate.json"
    quick = ["certify", "--no-shield", "--pursuer", "turtlebot3-burger"]
    words = [*quick, "--set", "evader_speed=0.2", "capture_distance=0.18", "--mine", "evader", "sensing"]
    assert main([*words, "--json", str(path)]) == 0
    printed = capsys.readouterr().out
    assert max(len(line) for line in printed.splitlines()) <= 80
    assert "ROBOTIS TurtleBot3 Burger" in printed
    assert "--set" in printed
    lines = {line.split()[1]: line for line in printed.splitlines() if line.startswith("│ ")}
    assert "not yours" in lines["capture_distance"]
    assert "not yours" in lines["pursuer_speed"]
    assert "not yours" not in lines["evader_speed"]
    figures = json.loads(path.read_text())
    assert figures["robots"] == {"pursuer": "turtlebot3-burger", "evader": None}
    assert figures["situation"]["half_axle"] == pytest.approx(0.08)
    assert set(figures["nearest_changes"][0]) >= {
        "parameter",
        "now",
        "needed",
        "unit",
        "whose",
        "mine",
        "share",
    }


def test_command_takes_contact_for_capture_of_two_known_robots(capsys):
    assert main(["certify", "--no-shield", "--strict", "--pursuer", "create3", "--evader", "rosbot-xl"]) == 0
    printed = capsys.readouterr().out
    assert "0.178 m + 0.233 m" in " ".join(printed.split())


def test_command_lists_the_robots_with_their_sources(capsys):
    assert main(["certify", "--robots"]) == 0
    printed = " ".join(capsys.readouterr().out.split())
    for word in ("turtlebot3-burger", "jackal", "dingo-o", "Not known:", "emanual.robotis.com"):
        assert word in printed


@pytest.mark.parametrize(
    "arguments, named",
    [
        (["--pursuer", "roomba"], "known pursuers: turtlebot3-burger"),
        (["--evader", "jackal"], "known evaders"),
        (["--set", "wheel_separation=-1"], "wheel_separation"),
        (["--set", "wheel_separation=0.1", "pursuer_half_axle=0.1"], "give one of them"),
        (["--set", "track_width=0.1"], "wheel_separation"),
    ],
)
def test_command_refuses_by_name(arguments, named, capsys):
    assert main(["certify", *arguments]) == 2
    assert named in " ".join(capsys.readouterr().err.split())


def test_wheels_at_one_point_may_be_given_as_their_separation(capsys):
    assert main(["certify", "--no-shield", "--set", "wheel_separation=0", "evader_speed=0.21"]) == 0
    assert "GUARANTEED" in capsys.readouterr().out
