"""Robots on sale: does every figure say where it stands, and does the model never claim too much for it?"""

import itertools
import math
import tomllib
from importlib.resources import files
from pathlib import Path

import numpy as np
import pytest

import sidestep
from sidestep.world import Aircraft, Quadrotor, ScenarioError, known_robots, load_scenario, robot_fields

CONTENT = tomllib.loads(files("sidestep.world").joinpath("known_robots.toml").read_text("utf-8"))
PURSUERS = [name for name, robot in known_robots().items() if robot.role == "pursuer"]
EVADERS = [name for name, robot in known_robots().items() if robot.role == "evader"]


def test_the_robots_that_were_asked_for_are_there():
    assert {"turtlebot3-burger", "turtlebot3-waffle", "create3", "jackal"} <= set(PURSUERS)
    assert len(EVADERS) >= 3


@pytest.mark.parametrize("name", [*PURSUERS, *EVADERS])
def test_every_figure_is_positive_and_says_where_it_stands(name):
    robot = known_robots()[name]
    wanted = {"speed", "radius"} | ({"turn_rate", "wheel_separation"} if robot.role == "pursuer" else set())
    assert wanted <= set(robot.figures)
    for figure in robot.figures.values():
        assert math.isfinite(figure["value"])
        assert figure["value"] > 0.0
        assert figure["sources"]
        for source in figure["sources"]:
            assert source["address"].startswith("https://")
            assert source["title"]
            assert source["read"]
    assert robot.unknown


def test_every_source_is_used():
    entries = [entry for robot in CONTENT["robots"].values() for entry in robot.values()]
    used = {key for entry in entries if isinstance(entry, dict) for key in entry["sources"]}
    assert used == set(CONTENT["sources"])


@pytest.mark.parametrize("name", PURSUERS)
def test_a_pursuer_of_the_model_can_do_all_that_its_makers_say_this_one_can(name):
    robot = known_robots()[name]
    top, turn = robot.figure("speed"), robot.figure("turn_rate")
    reach, half = robot.speed, robot.half_axle
    assert half == robot.figure("wheel_separation") / 2.0
    assert top <= reach
    assert half * turn <= reach + 1e-12
    if "wheel_speed" in robot.figures:
        speeds, rates = np.meshgrid(np.linspace(0.0, top, 50), np.linspace(0.0, turn, 50))
        possible = speeds + half * rates <= robot.figure("wheel_speed")
        assert np.all((speeds + half * rates)[possible] <= reach)
    else:
        assert top + half * turn <= reach + 1e-12


@pytest.mark.parametrize("name", EVADERS)
def test_an_evader_of_the_model_needs_no_wheel_faster_than_straight_ahead_in_any_direction(name):
    robot = known_robots()[name]
    assert robot.drive == "mecanum"
    direction = np.linspace(0.0, 2.0 * np.pi, 361)
    rim = robot.speed * (np.abs(np.cos(direction)) + np.abs(np.sin(direction)))
    assert np.max(rim) == pytest.approx(robot.figure("speed"))


@pytest.mark.parametrize("pursuer, evader", list(itertools.product(PURSUERS, EVADERS)))
def test_any_two_make_a_scenario_whose_capture_distance_is_contact(pursuer, evader):
    scenario = load_scenario("paper", **sidestep.robot_fields(pursuer, evader))
    robots = known_robots()
    assert float(scenario.capture_distance) == pytest.approx(robots[pursuer].radius + robots[evader].radius)
    assert float(scenario.pursuer_speed) == pytest.approx(robots[pursuer].speed)
    assert float(scenario.pursuer_half_axle) == pytest.approx(robots[pursuer].half_axle)
    assert float(scenario.evader_speed) == pytest.approx(robots[evader].speed)
    assert float(scenario.initial_separation / scenario.capture_distance) == pytest.approx(3.0)


@pytest.mark.parametrize("name", [*PURSUERS, *EVADERS])
def test_the_documentation_names_the_robot_with_the_numbers_that_are_used(name):
    page = (Path(__file__).parents[2] / "docs" / "certificate.md").read_text("utf-8")
    row = next(line for line in page.splitlines() if line.startswith(f"| `{name}` |"))
    robot = known_robots()[name]
    half = f"| {robot.half_axle:g} m |" if robot.role == "pursuer" else "| |"
    assert f"= {robot.speed:.4g} m/s {half} {robot.radius:g} m |" in row


def test_one_robot_alone_leaves_the_capture_distance_to_the_scenario():
    assert "capture_distance" not in {**robot_fields("create3"), **robot_fields(evader="dingo-o")}
    assert robot_fields() == {}


def test_a_robot_takes_the_place_of_one_that_flies():
    flown = load_scenario("quadrotor")
    assert isinstance(flown.evader_model, Quadrotor)
    assert isinstance(flown.pursuer_model, Aircraft)
    driven = load_scenario("quadrotor", **robot_fields("turtlebot3-burger"))
    assert driven.pursuer_model is None
    assert isinstance(driven.evader_model, Quadrotor)


@pytest.mark.parametrize(
    "names, words",
    [
        (("turtlebot", None), "'turtlebot': it is not known; known pursuers: turtlebot3-burger"),
        (("dingo-o", None), "'dingo-o': it is an evader; known pursuers: "),
        ((None, "jackal"), "'jackal': it is a pursuer; known evaders: rosbot-xl"),
    ],
)
def test_a_robot_that_is_not_known_or_is_the_others_is_refused_with_those_that_are(names, words):
    with pytest.raises(ScenarioError, match=words):
        robot_fields(*names)
