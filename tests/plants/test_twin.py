"""The physics twin: do its robots move, slip and measure as they should, and is nothing missed in between?"""

import dataclasses
import math
import sys

import jax.numpy as jnp
import numpy as np
import pytest

from sidestep.plants import library
from sidestep.plants.ground import SENSORS, Sensors, Twin, TwinError, TwinOptions, make_sensors
from sidestep.plants.ground.actuation import omniwheel_speeds
from sidestep.plants.ground.robots import OMNIWHEEL_ROLLING
from sidestep.plants.sensors import PoseSensor
from sidestep.world import World, load_scenario
from sidestep.world.robots import drive

SCENARIO = load_scenario("paper-test")
PERFECT = SENSORS["perfect"]
STILL = np.zeros((1, 2))


START = World(
    np.zeros(2), np.array([[1.0, -0.5, 0.0]]), np.array([[1.5, 0.0, 0.02, 0.0]]), np.array([2.5, 0.0])
)


def make(scenario=SCENARIO, **options) -> Twin:
    twin = Twin(scenario, TwinOptions(**{"sensors": PERFECT, **options}))
    twin.reset(START)
    return twin


@pytest.mark.parametrize("base, off", [("servo", 1e-4), ("omniwheels", 0.004)])
def test_evader_drives_what_it_is_told_in_every_direction_and_keeps_its_heading(base, off):
    twin = make(base=base)
    for angle in np.linspace(0.0, 2.0 * np.pi, 7):
        told = 0.1574 * np.array([np.cos(angle), np.sin(angle)])
        twin.command(told, STILL)
        twin.measurements()
        twin.advance(0.3)
        begin = np.asarray(twin.world.evader)
        twin.measurements()
        twin.advance(0.5)
        driven = (np.asarray(twin.world.evader) - begin) / 0.5
        assert np.linalg.norm(driven - told) < off
        assert abs(twin.poses_of(twin.data.qpos[None])[0, 0, 2]) < math.radians(3.0)


def test_motors_have_limits():
    twin = make(acceleration=1.5)
    twin.command(np.array([0.15, 0.0]), STILL)
    twin.advance(0.5)
    twin.command(np.array([-0.15, 0.0]), STILL)
    twin.advance(0.05)
    # A reversal takes 0.3/1.5 s at least.
    assert float(twin.world.evader_velocity[0]) == pytest.approx(0.15 - 1.5 * 0.05, abs=0.005)


@pytest.mark.parametrize("half_axle", [0.08, 0.2])
@pytest.mark.parametrize("wheels", [(0.2, 0.2), (-0.2, 0.2), (0.05, 0.2), (-0.2, -0.1)])
def test_pursuer_drives_the_arc_of_its_wheel_speeds(half_axle, wheels):
    scenario = dataclasses.replace(SCENARIO, pursuer_half_axle=half_axle)
    twin = make(scenario)
    speeds = np.array([wheels])
    twin.command(np.zeros(2), speeds)
    twin.advance(0.3)
    begin = twin.world
    np.testing.assert_allclose(np.asarray(begin.wheel_speeds), speeds, atol=1e-3)
    twin.advance(1.0)
    wanted = drive(begin.pursuers[0], jnp.asarray(wheels), scenario.pursuer_half_axle, jnp.asarray(1.0))
    off = np.asarray(twin.world.pursuers[0]) - np.asarray(wanted)
    assert np.linalg.norm(off[:2]) < 0.003
    assert abs(math.remainder(off[2], 2.0 * np.pi)) < 0.02


def test_pursuer_that_leads_with_its_wheels_slips_only_while_it_speeds_up():
    twin = make()
    twin.command(np.zeros(2), np.array([[0.2, 0.2]]))
    twin.advance(0.02)
    started = float(twin.world.wheel_speeds[0, 0])
    assert 0.01 < started < 0.15
    twin.advance(0.3)
    assert float(twin.world.wheel_speeds[0, 0]) == pytest.approx(0.2, abs=1e-3)


def test_commands_beyond_the_limits_or_not_finite_never_reach_the_motors():
    twin = make()
    twin.command(np.array([3.0, 4.0]), np.array([[9.0, np.nan]]))
    twin.advance(0.5)
    speed = np.asarray(twin.world.evader_velocity)
    np.testing.assert_allclose(speed, 0.1574 * np.array([0.6, 0.8]), atol=1e-3)
    np.testing.assert_allclose(np.asarray(twin.world.wheel_speeds)[0], [0.2, 0.0], atol=1e-3)
    twin.command(np.array([np.nan, 0.1]), STILL)
    twin.advance(0.5)
    np.testing.assert_allclose(np.asarray(twin.world.evader_velocity), 0.0, atol=1e-3)


def test_obstacles_drift_as_the_world_says():
    twin = Twin(dataclasses.replace(SCENARIO, obstacle_count=3), TwinOptions(sensors=PERFECT))
    begin = np.array([[1.0, 1.0, 0.02, 0.0], [-1.0, 1.0, 0.0, -0.05], [2.0, 0.0, -0.1, 0.1]])
    twin.reset(World(np.zeros(2), np.array([[1.0, -0.5, 0.0]]), begin, np.ones(2)))
    twin.command(np.zeros(2), STILL)
    twin.advance(2.0)
    moved = np.asarray(twin.world.obstacles)
    np.testing.assert_allclose(moved[:, :2], begin[:, :2] + 2.0 * begin[:, 2:], atol=1e-4)
    np.testing.assert_allclose(moved[:, 2:], begin[:, 2:], atol=1e-4)


def test_a_command_takes_effect_after_the_actuation_delay_and_not_before():
    twin = make(actuation_delay=0.1)
    twin.command(np.array([0.15, 0.0]), STILL)
    twin.advance(0.099)
    assert abs(float(twin.world.evader[0])) < 1e-6
    twin.advance(0.101)
    assert float(twin.world.evader[0]) > 0.005


def test_an_approach_between_two_control_instants_is_not_missed():
    world = World(
        np.array([0.0, 0.0]),
        np.array([[0.0, 5.0, 0.0]]),
        np.array([[0.1, 0.2, 0.0, 0.0]]),
        np.array([0.2, -0.04]),
    )
    twin = make()
    twin.reset(world)
    twin.command(np.array([0.1574, 0.0]), STILL)
    twin.advance(0.2)
    contacts = twin.advance(1.2)
    # Nearest beside the obstacle and beside the target, half-way through.
    assert contacts.obstacle_distance == pytest.approx(0.2, abs=1e-5)
    assert contacts.target_distance == pytest.approx(0.04, abs=1e-5)
    assert contacts.pursuer_distance == pytest.approx(5.0, abs=1e-2)
    assert twin.least_distances[1] == contacts.obstacle_distance
    far = twin.advance(0.05)
    assert far.obstacle_distance > 0.21
    assert twin.least_distances[1] == contacts.obstacle_distance


def test_reaching_counts_only_without_a_contact():
    beside = np.array([0.02, 0.0])
    for obstacle, collided in ((0.19, True), (0.21, False)):
        world = World(np.zeros(2), np.array([[3.0, 0.0, 0.0]]), np.array([[0.0, obstacle, 0.0, 0.0]]), beside)
        twin = make()
        twin.reset(world)
        contacts = twin.advance(0.05)
        assert contacts.collided is collided
        assert contacts.reached is not collided
        assert not contacts.captured


def test_the_same_seed_measures_the_same_however_time_is_cut():
    def seen(seed, pieces):
        twin = Twin(SCENARIO, TwinOptions(sensors=make_sensors("odometry", {"dropout": 0.2})), seed)
        twin.reset(START)
        twin.command(np.array([0.1, 0.05]), np.array([[0.2, 0.1]]))
        collected = []
        for piece in pieces:
            twin.advance(piece)
            collected += twin.measurements()
        return sorted(collected)

    whole = seen(3, [0.6])
    assert whole == seen(3, [0.6])
    for pieces in ([0.2] * 3, [0.013, 0.407, 0.18]):
        again = seen(3, pieces)
        assert [one[:3] for one in again] == [one[:3] for one in whole]
        # The yaw loop hears of the heading only when someone reads the measurements.
        poses = [np.array([one.pose for one in those]) for those in (again, whole)]
        np.testing.assert_allclose(poses[0], poses[1], atol=6e-3)
    assert whole != seen(4, [0.6])
    assert {one.robot for one in whole} == {"evader", "pursuer", "obstacle"}


def watched(sensors: Sensors, seconds: float = 40.0, seed: int = 0) -> list:
    sensor = PoseSensor(sensors, "evader", 0, 0.001, np.random.default_rng(seed))
    sensor.watch(0, np.tile([1.0, 2.0, 3.0], (round(seconds * 1000) + 1, 1)))
    return sensor.arrived(seconds + 10.0)


def test_noise_has_the_size_it_says_and_never_more_than_its_bound():
    sensors = Sensors(rate=200.0, position_noise=0.002, heading_noise=0.01)
    errors = np.array([one.pose for one in watched(sensors)]) - [1.0, 2.0, 3.0]
    np.testing.assert_allclose(errors.std(axis=0), [0.002, 0.002, 0.01], rtol=0.05)
    np.testing.assert_allclose(errors.mean(axis=0), 0.0, atol=5e-4)
    bounds = sensors.bounds()
    assert 2.0 * np.linalg.norm(errors[:, :2], axis=1).max() <= bounds["position_error"] + 1e-12
    assert np.abs(errors[:, 2]).max() <= bounds["heading_error"]
    assert bounds["position_error"] == pytest.approx(0.012)


def test_bias_stays_and_drift_grows():
    biased = np.array([one.pose for one in watched(Sensors(position_bias=0.01, heading_bias=0.1))])
    off = biased - [1.0, 2.0, 3.0]
    np.testing.assert_allclose(np.linalg.norm(off[:, :2], axis=1), 0.01)
    assert np.ptp(off, axis=0).max() < 1e-12
    walks = [watched(Sensors(rate=10.0, position_drift=0.01), 4.0, seed)[-1].pose[0] for seed in range(200)]
    assert np.std(np.array(walks) - 1.0) == pytest.approx(0.01 * 2.0, rel=0.15)


def test_measurements_arrive_late_and_with_the_stamp_at_which_they_were_true():
    sensor = PoseSensor(
        Sensors(rate=50.0, delay=0.03, synchronised=True), "evader", 0, 0.001, np.random.default_rng(0)
    )
    path = np.stack([np.arange(501) * 0.001, np.zeros(501), np.zeros(501)], axis=-1)
    sensor.watch(0, path)
    first = sensor.arrived(0.1)
    assert [one.stamp for one in first] == pytest.approx([0.0, 0.02, 0.04, 0.06])
    for one in first:
        assert one.pose[0] == pytest.approx(one.stamp)
    assert [one.stamp for one in sensor.arrived(0.12)] == pytest.approx([0.08])
    assert sensor.arrived(0.12) == []


def test_dropped_samples_never_arrive():
    share = len(watched(Sensors(rate=100.0, dropout=0.3))) / 4000
    assert share == pytest.approx(0.7, abs=0.03)


def test_sensors_have_seen_everybody_when_the_clock_starts():
    twin = Twin(SCENARIO, TwinOptions(sensors=make_sensors("odometry")), 1)
    twin.reset(START)
    first = twin.measurements()
    newest = {one.robot: one for one in first}
    assert set(newest) == {"evader", "pursuer", "obstacle"}
    assert all(-0.05 < one.stamp <= -0.02 for one in newest.values())
    # The obstacle was already drifting.
    way = [one.pose[0] for one in first if one.robot == "obstacle"]
    assert way[-1] - way[0] == pytest.approx(0.02 * 0.5, abs=0.01)


def test_omniwheels_turn_as_their_kinematics_say():
    # Straight ahead, the wheel at the back is dragged along its axle; the others turn against each other.
    left, back, right = omniwheel_speeds(np.array([0.1, 0.0]), 0.0)
    assert back == pytest.approx(0.0, abs=1e-12)
    assert left == pytest.approx(-right)
    assert left == pytest.approx(0.1 * math.sin(math.radians(60.0)) / (0.04 * OMNIWHEEL_ROLLING))
    # Turned by a quarter, world x is the robot's right; the yaw loop turns it back.
    turned = omniwheel_speeds(np.array([0.1, 0.0]), math.pi / 2.0) - omniwheel_speeds(
        np.zeros(2), math.pi / 2.0
    )
    np.testing.assert_allclose(turned, omniwheel_speeds(np.array([0.0, -0.1]), 0.0), atol=1e-12)


@pytest.mark.parametrize(
    "options, message",
    [
        ({"base": "legs"}, "'servo', 'omniwheels'"),
        ({"actuation_delay": -0.1}, "actuation_delay"),
        ({"acceleration": 0.0}, "acceleration"),
        ({"physics_step": 0.01}, "at most 0.002"),
        ({"pursuer_sees": "nothing"}, "'truth', 'measurements'"),
    ],
)
def test_options_that_cannot_be_are_named(options, message):
    with pytest.raises(TwinError, match=message):
        TwinOptions(**options)


def test_sensors_that_cannot_be_are_named():
    with pytest.raises(TwinError, match="perfect, motion-capture, odometry"):
        make_sensors("sonar")
    with pytest.raises(TwinError, match="did you mean 'position_noise'"):
        make_sensors("perfect", {"position_nose": 0.1})
    for overrides in ({"rate": 0.0}, {"dropout": 1.0}, {"delay": -1.0}, {"delay": "long"}, {"rate": True}):
        with pytest.raises(TwinError, match=next(iter(overrides))):
            make_sensors("perfect", overrides)


def test_a_world_with_other_robots_is_refused():
    twin = make()
    with pytest.raises(TwinError, match="2 obstacles"):
        twin.reset(World(np.zeros(2), np.zeros((1, 3)), np.zeros((2, 4)), np.ones(2)))


def test_without_mujoco_the_error_names_the_command_that_installs_it(monkeypatch):
    monkeypatch.setitem(sys.modules, "mujoco", None)
    with pytest.raises(TwinError, match=r"pip install .*\[twin\]"):
        Twin(SCENARIO)


def test_without_a_video_writer_the_error_names_the_command_that_installs_it(monkeypatch):
    monkeypatch.setitem(sys.modules, "av", None)
    with pytest.raises(TwinError, match=r"pip install .*\[twin\]"):
        library.load_av()


def test_without_opengl_the_error_names_the_debian_packages(monkeypatch):
    def broken(*_):
        raise ImportError("no libEGL")

    monkeypatch.setattr(library.load_mujoco(), "Renderer", broken, raising=False)
    with pytest.raises(TwinError, match=r"libegl1.*libosmesa6"):
        library.make_renderer(make().model, 10, 10, 10)


def test_the_backend_is_the_first_one_whose_library_is_there(monkeypatch):
    for there, backend in (("EGL", "egl"), ("OSMesa", "osmesa"), ("nothing", None)):
        monkeypatch.setattr(library, "_loads", lambda name, there=there: there in name)
        assert library.offscreen_backend() == backend
