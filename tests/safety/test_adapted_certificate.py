"""Robots of one's own where a part of the package knows the built-in ones only: taken over, or refused."""

import dataclasses
import warnings

import numpy as np
import pytest

from sidestep.cli import main
from sidestep.pursuit import CaptureGame
from sidestep.safety import SHIELDS, certify, covered, make_shield, of_control_point
from sidestep.views.outlines import LevelOutlines, pursuer_heights
from sidestep.views.scene import capture_set_outline
from sidestep.world import ModelWarning, PursuerModel, load_scenario


class Nameless(PursuerModel):
    """Says what it can do, but names no drive that covers it."""

    def limit(self, scenario, speed, turn_rate):
        return speed.clip(0.0, 1.0), turn_rate.clip(-0.2, 0.2)

    def corners(self, scenario):
        return np.array([[0.0, 0.2], [0.0, -0.2], [1.0, 0.2], [1.0, -0.2]])


@pytest.fixture(scope="module")
def scenario():
    return load_scenario("quadrotor")


@pytest.mark.slow
def test_the_certificate_is_that_of_the_robots_that_stand_for_them(scenario):
    ours = certify(scenario, position_error=0.02, check_shield=False)
    theirs = certify(covered(of_control_point(scenario)), position_error=0.02, check_shield=False)
    assert ours.guaranteed_clearance == theirs.guaranteed_clearance
    assert ours.situation.capture_distance == pytest.approx(0.17 + 0.22 * 0.8)
    words = ours.claims[0].text
    assert "0.176 m" in words
    assert "V = 1.803 m/s, b = 3.213 m" in words
    assert theirs.situation.stands_for == ""


def test_a_certificate_needs_a_drive_that_covers_the_pursuer(scenario):
    with pytest.raises(ValueError, match="names no differential drive"):
        certify(dataclasses.replace(scenario, pursuer_model=Nameless()), check_shield=False)
    with pytest.raises(ValueError, match=r"half_axle = 0\.3: the pursuer is of the model Aircraft"):
        certify(scenario, half_axle=0.3, check_shield=False)


def test_robots_against_which_the_pursuer_wins_are_warned_of_once(scenario):
    allowed = float(CaptureGame.of(covered(of_control_point(scenario))).largest_capture_distance)
    more = allowed - float(of_control_point(scenario).capture_distance)
    near = dataclasses.replace(scenario, capture_distance=scenario.capture_distance + 0.9 * more)
    beyond = dataclasses.replace(scenario, capture_distance=scenario.capture_distance + 1.1 * more)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        for name in SHIELDS:
            make_shield(name, near)
        for name in ("none", "paper"):
            make_shield(name, beyond)
    for name in ("game", "joint"):
        with pytest.warns(ModelWarning, match=f"{allowed:.3g} m is the most") as told:
            make_shield(name, beyond)
        assert len(told) == 1


@pytest.mark.parametrize(
    "arguments, words",
    [
        (["falsify", "--shield", "game", "--out", "{}/falsify"], "the falsifier supports"),
        (["play"], "the page supports"),
        (["twin"], "`sidestep fly` flies a quadrotor"),
    ],
)
def test_what_knows_the_built_in_robots_only_says_so_and_writes_nothing(arguments, words, tmp_path, capsys):
    told = [argument.format(tmp_path) for argument in arguments]
    assert main([*told, "--scenario", "quadrotor"]) == 2
    error = capsys.readouterr().err
    assert words in error
    assert "Quadrotor and Aircraft" in error
    assert not list(tmp_path.iterdir())


def test_exports_of_a_filter_are_refused_and_of_a_policy_are_not(scenario, tmp_path):
    from sidestep.bridges.export import export_onnx

    with pytest.raises(ValueError, match="export the policy alone"):
        export_onnx(tmp_path / "filter.onnx", scenario, None, what="filter")
    assert not list(tmp_path.iterdir())


def test_barriers_are_drawn_as_the_shield_keeps_them(scenario):
    shown, kept = capture_set_outline(scenario), covered(of_control_point(scenario))
    np.testing.assert_array_equal(shown, capture_set_outline(kept))
    pose = np.zeros(3)
    heights = pursuer_heights(scenario, shown, np.broadcast_to(pose, (len(shown), 3)), pursuit=True)
    np.testing.assert_allclose(heights, 0.0, atol=1e-6)
    level = LevelOutlines(scenario, pursuit=True).at(pose[None], np.zeros((0, 2)), 0.0)
    assert np.nanmax(np.abs(level[:, 0])) == pytest.approx(np.abs(shown[:, 0]).max(), rel=1e-3)
    nameless = dataclasses.replace(scenario, pursuer_model=Nameless())
    assert capture_set_outline(nameless)[0, 0] > 0.346
