"""A quadrotor in MuJoCo: its autopilot keeps what the shield's budget says, and whoever breaks it says so."""

import json
import math
import os

import jax
import numpy as np
import pytest

from sidestep.cli import main
from sidestep.loop import load_trajectory
from sidestep.plants.air import (
    Airframe,
    Attitude,
    Autopilot,
    Flight,
    FlightOptions,
    Gains,
    Pilot,
    Setpoint,
    certificate_of,
    errors_of,
    fly,
    frames_of,
)
from sidestep.plants.air.estimate import OwnMotion
from sidestep.plants.library import TwinError
from sidestep.plants.sensors import Sensors
from sidestep.safety import make_shield
from sidestep.world import Quadrotor, load_scenario

UP = np.array([0.0, 0.0, 1.0])


@pytest.fixture(scope="module")
def scene():
    return load_scenario("quadrotor-test")


@pytest.fixture(scope="module")
def start(scene):
    return scene.reset(jax.random.key(0))


@pytest.fixture(scope="module")
def pilot(scene):
    return Pilot(scene, "goal-seeking", "game")


def still(place):
    zero = np.zeros(3)
    return Setpoint(np.asarray(place, float), zero, zero, zero)


def rotation(axis, angle):
    x, y, z = np.asarray(axis, float) / np.linalg.norm(axis)
    skew = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    return np.eye(3) + math.sin(angle) * skew + (1.0 - math.cos(angle)) * skew @ skew


def torque_of(frame, thrusts):
    """Thrust and torque of the rotors, from their places and senses."""
    x, y = np.array(frame.rotor_places).T
    return np.array(
        [
            np.sum(thrusts),
            np.sum(y * thrusts),
            -np.sum(x * thrusts),
            frame.rotor_torque * np.sum(np.array(frame.rotor_senses) * thrusts),
        ]
    )


def test_hovering_carries_the_weight_and_turns_nothing():
    frame = Airframe()
    pilot = Autopilot(frame)
    level = Attitude(np.eye(3), np.zeros(3))
    given = torque_of(
        frame, pilot.thrusts(still((0, 0, 1)), np.array([0.0, 0.0, 1.0]), np.zeros(3), level, 0.002)
    )
    np.testing.assert_allclose(given, [9.81 * frame.mass, 0.0, 0.0, 0.0], atol=1e-9)
    assert not pilot.saturated


@pytest.mark.parametrize("axis", [(1, 0, 0), (0, 1, 0), (0.6, -0.8, 0), (0, 0, 1)])
def test_a_turned_quadrotor_is_turned_back(axis):
    frame = Airframe()
    attitude = Attitude(rotation(axis, 0.1), np.zeros(3))
    given = torque_of(frame, Autopilot(frame).thrusts(still((0, 0, 1)), UP, np.zeros(3), attitude, 0.002))
    assert float(given[1:] @ np.asarray(axis, float)) < 0.0


def test_it_leans_where_it_wants_to_go():
    """A place to the left (+y) asks for a turn about -x, one ahead (+x) for a turn about +y."""
    frame, level = Airframe(), Attitude(np.eye(3), np.zeros(3))
    left = torque_of(frame, Autopilot(frame).thrusts(still((0, 0.1, 1)), UP, np.zeros(3), level, 0.002))
    ahead = torque_of(frame, Autopilot(frame).thrusts(still((0.1, 0, 1)), UP, np.zeros(3), level, 0.002))
    assert left[1] < 0.0 == pytest.approx(left[2], abs=1e-9)
    assert ahead[2] > 0.0 == pytest.approx(ahead[1], abs=1e-9)


def test_what_the_rotors_cannot_give_is_yaw_first():
    frame = Airframe()
    pilot, hard = Autopilot(frame), Attitude(rotation((0, 0, 1), 2.0) @ rotation((1, 0, 0), 0.9), np.zeros(3))
    thrusts = pilot.thrusts(still((0, 0, 1)), UP, np.zeros(3), hard, 0.002)
    assert pilot.saturated
    assert np.all((thrusts >= 0.0) & (thrusts <= frame.largest_thrust))


def test_a_place_far_off_never_makes_it_lean_over_more_than_allowed(scene, start):
    flight = Flight(scene, FlightOptions(gains=Gains(largest_tilt=math.radians(35.0))))
    flight.reset(start)
    # As if carried off: half a metre from where it should be.
    flight.data.qpos[0] += 0.5
    leaned = []
    for _ in range(20):
        flight.command(np.zeros(2), np.zeros((1, 2)))
        flight.advance(0.05)
        leaned.append(np.degrees(np.arccos(flight.data.xmat[flight._body][8])))
    assert 20.0 < max(leaned) < 45.0
    assert flight.tracking_error > 0.4


def test_positions_that_come_late_are_compared_with_when_they_were_true():
    own, rng = OwnMotion(0.02, 0.001, 0.01), np.random.default_rng(0)
    truth, speed = np.zeros(3), np.array([0.5, -0.2, 0.0])
    own.start(0.0, truth, np.zeros(3))
    pending, errors = [], []
    for count in range(1, 2001):
        now = 0.002 * count
        acceleration = np.array([math.sin(3.0 * now), 0.0, 0.0])
        truth, speed = truth + 0.002 * speed + 2e-6 * acceleration, speed + 0.002 * acceleration
        own.feel(now, acceleration, 0.002)
        if count % 5 == 0:
            pending.append((now + 0.02, now, truth + 0.001 * rng.standard_normal(3)))
        while pending and pending[0][0] <= now:
            _, stamp, seen = pending.pop(0)
            own.see(stamp, seen)
        errors.append(np.linalg.norm(own.position - truth))
    # It starts still, which is wrong; in the end it is better than a measurement, which is 1.7 mm off.
    assert np.sqrt(np.mean(np.square(errors[-500:]))) < 0.001
    assert np.linalg.norm(own.velocity - speed) < 0.01


@pytest.mark.parametrize("every", [1, 6])
def test_the_quadrotor_stays_as_near_to_what_it_is_told_as_the_budget_says(scene, start, every):
    """Velocities at random at full speed, new in every period or held for a while."""
    flight, rng = Flight(scene, seed=3), np.random.default_rng(every)
    flight.reset(start)
    speed, told = float(scene.evader_speed), np.zeros(2)
    before = flight.control_point
    for count in range(80):
        if count % every == 0:
            angle = rng.uniform(-math.pi, math.pi)
            told = speed * np.array([math.cos(angle), math.sin(angle)])
        flight.command(told, np.zeros((1, 2)))
        flight.advance(0.05)
        # The control point moves exactly as told.
        np.testing.assert_allclose(flight.control_point - before, 0.05 * told, atol=1e-9)
        before = flight.control_point
        assert abs(flight.data.qpos[2] - 0.8) < 0.08
    assert 0.002 < flight.tracking_error < flight.options.tracking_error
    offset = np.linalg.norm(flight.control_point - flight.reference[0])
    assert offset <= float(scene.evader_model.offset(scene)) + 1e-9


def test_the_same_seed_flies_the_same_way(scene, start, pilot):
    first, second, other = (fly(pilot, seed=seed, steps=20, world=start) for seed in (5, 5, 6))
    assert np.array_equal(first.frames[-1][0], second.frames[-1][0])
    assert not np.array_equal(first.frames[-1][0], other.frames[-1][0])


def test_the_aircraft_flies_arcs_along_its_heading(scene, start):
    flight = Flight(scene)
    flight.reset(start)
    flight.command(np.zeros(2), np.array([[0.75, 1.25]]))
    poses = []
    for _ in range(60):
        flight.advance(0.05)
        poses.append(flight.world.pursuers[0])
    ways = np.diff(np.array(poses), axis=0)
    along = np.array(poses)[:-1, 2] + 0.5 * ways[:, 2]
    aside = -np.sin(along) * ways[:, 0] + np.cos(along) * ways[:, 1]
    np.testing.assert_allclose(aside, 0.0, atol=1e-5)
    np.testing.assert_allclose(ways[-10:, 2], 0.25 * 0.05, rtol=1e-3)
    np.testing.assert_allclose(np.hypot(*ways[-10:, :2].T), 0.05, rtol=1e-3)


@pytest.mark.slow
def test_the_scene_is_lost_without_a_shield_and_won_with_one(scene, start, pilot):
    certificate = certificate_of(scene, FlightOptions(), check_shield=False)
    assert certificate.guaranteed
    assert "Quadrotor" in certificate.situation.stands_for
    assert "Aircraft" in certificate.situation.stands_for
    bare = fly(Pilot(scene, "goal-seeking", "none"), world=start, certificate=certificate)
    assert bare.outcome == "captured"
    assert bare.least_pursuer_distance <= float(scene.capture_distance)
    flight = fly(pilot, world=start, certificate=certificate)
    assert flight.outcome == "reached"
    assert flight.within_assumptions
    told = flight.to_dict()
    assert told["infeasible_periods"] == told["periods_not_normal"] == 0
    assert told["start_margin"] > 0.0
    assert flight.least_pursuer_distance > float(scene.capture_distance) + 0.05


def test_wind_that_the_budget_does_not_know_of_is_reported(scene, start, pilot):
    calm, windy = (
        fly(Pilot(scene, "goal-seeking", "none", FlightOptions(wind=wind)), world=start, steps=30)
        for wind in ((0.0, 0.0), (0.0, 6.0))
    )
    assert calm.within_assumptions
    assert not windy.within_assumptions
    assert np.max(windy.tracking_errors) > windy.options.tracking_error


@pytest.mark.slow
def test_the_certificate_counts_what_the_flight_cannot_know(scene):
    exact, poor = (
        certificate_of(scene, FlightOptions(tracking_error=error), check_shield=False) for error in (0.0, 0.2)
    )
    assert exact.guaranteed_clearance > poor.guaranteed_clearance
    assert not poor.guaranteed
    errors = errors_of(FlightOptions(sensors=Sensors(rate=50.0, position_noise=0.01, delay=0.03)))
    assert errors == {"position_error": 0.03 + 0.04, "heading_error": 0.0, "delay": 0.05}


@pytest.mark.parametrize(
    "options, words",
    [
        ({"tracking_error": -1.0}, "tracking_error = -1.0"),
        ({"pursuer_lag": 0.0}, "pursuer_lag = 0.0"),
        ({"wind": (1.0, math.nan)}, "wind"),
        ({"physics_step": 0.01}, "at most 0.002 s"),
        ({"autopilot_period": 0.0025}, "a multiple of physics_step"),
        ({"pursuer_sees": "nothing"}, "'truth', 'measurements'"),
    ],
)
def test_options_that_cannot_be_are_named(options, words):
    with pytest.raises(TwinError, match=words):
        FlightOptions(**options)


def test_airframes_that_cannot_fly_are_named(scene):
    with pytest.raises(ValueError, match="cannot lift"):
        Airframe(mass=0.1)
    with pytest.raises(ValueError, match="mass = -1"):
        Airframe(mass=-1.0)
    with pytest.raises(TwinError, match=r"tilts \d+ degrees, more than largest_tilt = 20"):
        Flight(scene, FlightOptions(gains=Gains(largest_tilt=math.radians(20.0))))
    weak = load_scenario("quadrotor-test", evader_model=Quadrotor(0.11, 0.025))
    with pytest.raises(TwinError, match="longer time_constant"):
        Flight(weak, FlightOptions(gains=Gains(largest_tilt=1.3), airframe=Airframe(largest_thrust=0.08)))


def test_scenarios_without_a_quadrotor_are_refused(scene):
    with pytest.raises(TwinError, match="has no quadrotor: use the preset 'quadrotor'"):
        Pilot(load_scenario("paper-test"))
    with pytest.raises(TwinError, match="differential drive pursue a quadrotor"):
        Pilot(load_scenario("quadrotor-test", pursuer_model=None, pursuer_half_axle=0.2))
    with pytest.raises(ValueError, match="needs a shield of its control point"):
        Pilot(scene, shield=make_shield("none", load_scenario("paper-test")))


def test_the_command_flies_prints_and_draws(tmp_path, capsys):
    out = tmp_path / "flight"
    status = main(
        [
            "fly",
            "--shield",
            "game",
            "--steps",
            "60",
            "--out",
            str(out),
            "--json",
            str(tmp_path / "flight.json"),
        ]
    )
    printed = " ".join(capsys.readouterr().out.split())
    assert status == 0
    assert "Capture is excluded by the certificate" in printed
    assert "Within its assumptions: 1 of 1 flights" in printed
    told = json.loads((tmp_path / "flight.json").read_text())
    assert told["cut"] == 1
    assert told["lost_within_assumptions"] == told["infeasible_periods"] == 0
    assert told["scenario"]["evader_model"]["model"] == "quadrotor"
    assert told["certificate"]["guaranteed"]
    for name in ("flight.npz", "flight.png", "flight.pdf"):
        assert (out / name).stat().st_size > 1000
    recorded = load_trajectory(out / "flight.npz")
    assert recorded.worlds.evader_state is not None


@pytest.mark.slow
@pytest.mark.parametrize("pursuer", ["chauffeur", "nash"])
def test_nobody_is_lost_behind_joint(pursuer):
    """As in benchmarks/quadrotor.py, of which CI has the flights behind `game` above."""
    scenario, options = load_scenario("quadrotor"), FlightOptions()
    certificate = certificate_of(scenario, options, check_shield=False)
    pilot = Pilot(scenario, "goal-seeking", "joint", options)
    for seed in range(20):
        flight = fly(pilot, pursuer, seed, certificate=certificate)
        assert flight.outcome == "reached"
        assert flight.within_assumptions


def test_the_command_refuses_what_it_cannot_fly(capsys):
    assert main(["fly", "--scenario", "paper-test"]) == 2
    assert "has no quadrotor" in capsys.readouterr().err
    assert main(["fly", "--noise", "ratio=5"]) == 2
    assert "did you mean 'rate'?" in capsys.readouterr().err
    assert main(["fly", "--seeds", "0"]) == 2
    assert main(["twin", "--scenario", "quadrotor"]) == 2
    assert "`sidestep fly` flies a quadrotor" in capsys.readouterr().err


def test_frames_show_quadrotor_aircraft_and_columns(start, pilot):
    flight = fly(pilot, steps=10, world=start)
    try:
        early, late = frames_of(flight, np.array([0.0, 0.5]), (240, 426))
    except TwinError as error:
        if os.environ.get("CI"):
            pytest.fail(str(error))
        pytest.skip(str(error))
    assert early.shape == (240, 426, 3)
    assert np.any(early != late)
    # Columns are the only thing that is dark.
    assert np.sum(np.all(early < 90, axis=-1)) > 200
