"""Every plant keeps the interface, and the plain simulation is on it what it is everywhere else."""

import dataclasses

import jax
import numpy as np
import pytest

from sidestep.loop import rollout
from sidestep.plants import Simulation, play
from sidestep.plants.air import Flight
from sidestep.plants.ground import SENSORS, Twin, TwinError, TwinOptions
from sidestep.robot import Onboard, OnboardSettings
from sidestep.world import load_scenario

ROOMY = load_scenario("paper", capture_distance=0.15)
EXACT = OnboardSettings(position_noise=0.0, heading_noise=0.0)
PLANTS = {
    "simulation": lambda: Simulation(ROOMY, heading=1.0),
    "ground": lambda: Twin(ROOMY, TwinOptions(sensors=SENSORS["perfect"])),
    "air": lambda: Flight(load_scenario("quadrotor", obstacle_count=1)),
}


@pytest.fixture(params=PLANTS, scope="module")
def plant(request):
    return PLANTS[request.param]()


@pytest.fixture(scope="module")
def start(plant):
    return plant.scenario.reset(jax.random.key(1))


def test_after_a_reset_everything_is_where_it_should_be_at_time_zero(plant, start):
    for _ in range(2):
        plant.reset(start, 3)
        assert plant.time == 0.0
        for name in ("evader", "pursuers", "obstacles", "target"):
            np.testing.assert_allclose(getattr(plant.world, name), getattr(start, name), atol=1e-6)
        plant.command(np.array([0.1, 0.0]), np.full((1, 2), 0.1))
        plant.advance(0.3)
        assert plant.time == pytest.approx(0.3)
        assert float(plant.world.time) == pytest.approx(0.3)


def test_the_same_seed_and_commands_give_the_same_world_and_measurements(plant, start):
    def drive(seed):
        plant.reset(start, seed)
        measured = []
        for count in range(6):
            plant.command(np.array([0.1, 0.02 * count]), np.full((1, 2), 0.1))
            plant.advance(0.05)
            measured += plant.measurements()
        return jax.tree.map(np.asarray, plant.world), measured

    (first, seen), (second, seen_again) = drive(3), drive(3)
    jax.tree.map(np.testing.assert_array_equal, first, second)
    assert seen == seen_again
    robots = {(one.robot, one.index) for one in seen}
    assert robots - {("evader", 0)} == {("pursuer", 0), ("obstacle", 0)}


def test_contacts_are_those_of_the_stretch(plant, start):
    plant.reset(start, 3)
    plant.command(np.zeros(2), np.zeros((1, 2)))
    contacts, there = plant.advance(0.05), plant.world
    for distance, place in (
        (contacts.pursuer_distance, there.pursuers[0, :2]),
        (contacts.obstacle_distance, there.obstacles[0, :2]),
        (contacts.target_distance, there.target),
    ):
        # Nobody moves by more than 5 cm meanwhile.
        assert distance == pytest.approx(np.linalg.norm(np.asarray(place - there.evader)), abs=0.06)
    assert not any((contacts.captured, contacts.collided, contacts.reached))


def test_commands_that_are_not_finite_are_a_stop(plant, start):
    plant.reset(start, 3)
    for _ in range(4):
        plant.command(np.array([np.nan, 0.1]), np.full((1, 2), 0.1))
        plant.advance(0.05)
    assert np.linalg.norm(np.asarray(plant.world.evader) - np.asarray(start.evader)) < 0.01


def test_a_command_beyond_the_limit_is_cut_to_it_before_anything_else(plant, start):
    """Cut later, an evader with a lag would reach its speed, and stop, as no evader can."""

    def drive(times):
        plant.reset(start, 3)
        for share in (1.0, 1.0, 0.0, 0.0):
            speed = times * share * float(plant.scenario.evader_speed)
            plant.command(
                np.array([speed, 0.0]), np.full((1, 2), times * float(plant.scenario.pursuer_speed))
            )
            plant.advance(0.05)
        return plant.world

    at_the_limit, beyond = drive(1.0), drive(20.0)
    np.testing.assert_allclose(beyond.evader, at_the_limit.evader, atol=1e-5)
    np.testing.assert_allclose(beyond.pursuers, at_the_limit.pursuers, atol=1e-5)


def test_a_world_with_other_robots_is_refused(plant):
    world = dataclasses.replace(plant.scenario, pursuer_count=2).reset(jax.random.key(0))
    with pytest.raises(TwinError, match="2 pursuers"):
        plant.reset(world)


def test_without_a_shield_the_simulation_is_driven_exactly_as_a_rollout():
    core = Onboard(ROOMY, "none", "goal-seeking", EXACT)
    played = play(Simulation(ROOMY), core, "nash", 3).trajectory
    plain = rollout(ROOMY, "goal-seeking", "none", "nash", 3)
    assert played.outcome == plain.outcome
    assert played.length == plain.length > 40
    np.testing.assert_array_equal(played.worlds.time, plain.worlds.time)
    for name in ("evader", "pursuers", "obstacles", "target", "evader_velocity", "wheel_speeds"):
        np.testing.assert_allclose(
            getattr(played.worlds, name), getattr(plain.worlds, name), atol=1e-5, err_msg=name
        )
    for name in ("reward", "pursuer_clearance", "obstacle_clearance"):
        np.testing.assert_allclose(
            getattr(played.events, name), getattr(plain.events, name), rtol=1e-5, atol=1e-5
        )


def test_the_decision_core_reaches_the_target_as_a_rollout_behind_a_shield_does():
    """They differ in what they know of the pursuer's speed: measured there, estimated here."""
    core = Onboard(ROOMY, "game", "goal-seeking", EXACT)
    episode = play(Simulation(ROOMY), core, "nash", 10)
    plain = rollout(ROOMY, "goal-seeking", "game", "nash", 10)
    played = episode.trajectory
    assert episode.outcome == plain.outcome == "reached"
    assert abs(played.length - plain.length) <= 2
    np.testing.assert_allclose(played.worlds.evader[:100], plain.worlds.evader[:100], atol=1e-3)
    np.testing.assert_array_equal(played.status[:100], plain.status[:100])
    assert np.sum(np.asarray(plain.status) > 0) > 5
    assert set(episode.levels) == {"normal"}
    assert np.max(episode.estimate_errors) < 1e-3
    assert np.all(episode.tracking_errors == 0.0)
    assert episode.least_pursuer_distance == pytest.approx(
        0.15 + float(np.min(plain.events.pursuer_clearance)), abs=1e-3
    )


def test_the_evader_turns_as_commanded_which_moves_nothing():
    plant = Simulation(ROOMY, heading=3.0)
    plant.reset(ROOMY.reset(jax.random.key(1)))
    plant.command(np.array([0.1, 0.0]), np.zeros((1, 2)), turn_rate=0.5)
    before = plant.measurements()[0].pose
    plant.advance(1.0)
    after = plant.measurements()[0].pose
    assert after[0] - before[0] == pytest.approx(0.1, abs=1e-6)
    assert after[2] == pytest.approx(3.5 - 2.0 * np.pi)


def test_what_the_pursuer_sees_is_checked():
    with pytest.raises(ValueError, match="'truth', 'measurements'"):
        play(Simulation(ROOMY), Onboard(ROOMY, "none", "goal-seeking"), "nash", pursuer_sees="nothing")
