"""The quadrotor moves by its equation, and its control point obeys; an aircraft turns no tighter."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import sidestep
from sidestep.loop import rollout
from sidestep.pursuit import CaptureGame, make_pursuer, pursue
from sidestep.safety import covered
from sidestep.world import Aircraft, EvaderState, Quadrotor, ScenarioError, load_scenario, scenario_to_dict
from sidestep.world.robots import body_velocity, wheels_from_body


@pytest.fixture(scope="module")
def scenario():
    return load_scenario("quadrotor")


def integrated(model, state, command, time, steps=4000):
    """The equation of `Quadrotor` by the midpoint rule, in double precision."""
    tau, lag = model.time_constant, model.attitude_lag
    p, v, a = (np.array(part, float) for part in state)

    def rates(v, a):
        return v, a, ((command - v) / tau - a) / lag

    step = time / steps
    for _ in range(steps):
        _, dv, da = rates(v, a)
        dp, dv, da = rates(v + 0.5 * step * dv, a + 0.5 * step * da)
        p, v, a = p + step * dp, v + step * dv, a + step * da
    return p, v, a


def test_the_closed_form_is_the_equation(scenario):
    model, rng = Quadrotor(time_constant=0.3, attitude_lag=0.06), np.random.default_rng(0)
    after = jax.jit(lambda robot, command, time: model.after(scenario, robot, command, time))
    for time in (0.0, 0.01, 0.05, 0.7):
        state = rng.uniform(-1.0, 1.0, (3, 2))
        command = rng.uniform(-0.8, 0.8, 2)
        reached = after(EvaderState(*map(jnp.asarray, state)), jnp.asarray(command), jnp.asarray(time))
        expected = integrated(model, state, command, time)
        for got, wanted in zip((reached.position, reached.velocity, reached.state), expected, strict=True):
            np.testing.assert_allclose(got, wanted, atol=2e-5)


def test_no_commands_tilt_it_more_than_it_says(scenario):
    model = scenario.evader_model
    slow, fast = (float(rate) for rate in model._rates())
    # The worst commands turn round where the response to an impulse does.
    turn = np.log(fast / slow) / (slow - fast)
    most = 0.0
    after = jax.jit(lambda robot, command: model.after(scenario, robot, command, jnp.asarray(0.005)))
    robot = EvaderState(jnp.zeros(2), jnp.zeros(2), jnp.zeros(2))
    speed = float(scenario.evader_speed)
    for count in range(800):
        command = -speed if count * 0.005 < 4.0 - turn else speed
        robot = after(robot, jnp.asarray([command, 0.0]))
        most = max(most, float(jnp.abs(robot.state[0])))
    claimed = float(model.largest_acceleration(scenario))
    assert 0.98 * claimed < most <= claimed + 1e-3
    assert np.degrees(float(model.largest_tilt(scenario))) < 45.0


@pytest.mark.parametrize("numbers", [{"time_constant": 0.2}, {"attitude_lag": 0.06}])
def test_a_quadrotor_whose_velocity_would_overshoot_is_refused(numbers):
    with pytest.raises(ValueError, match="more than four times the lag"):
        Quadrotor(**numbers)
    with pytest.raises(ValueError, match=r"time_constant = 0.0: .*attitude_lag = -0.1: .*greater than 0 s"):
        Quadrotor(time_constant=0.0, attitude_lag=-0.1)


def test_an_aircraft_keeps_its_speed_and_its_circle(scenario):
    rng = np.random.default_rng(1)
    for pair in rng.uniform(-3.0, 3.0, (200, 2)):
        wheels = wheels_from_body(*jnp.asarray(pair, float), scenario.pursuer_half_axle)
        taken = scenario.drivable(wheels)
        speed, turn_rate = body_velocity(taken, scenario.pursuer_half_axle)
        assert 0.5 - 1e-5 <= speed <= 1.0 + 1e-5
        assert abs(float(turn_rate)) <= float(speed) / 4.0 + 1e-5
    with pytest.raises(ValueError, match=r"turning_radius = 0\.0: .* greater than 0 m"):
        Aircraft(turning_radius=0.0)
    with pytest.raises(ValueError, match=r"slowest = 1\.5: .* from 0 to 1"):
        Aircraft(slowest=1.5)


def test_the_covering_drive_is_the_one_that_leaves_most(scenario):
    """No other b covers the aircraft and leaves a larger capture distance."""
    best = float(CaptureGame.of(covered(scenario)).largest_capture_distance)
    rim, axle = (float(part) for part in scenario.pursuer_model.covering(scenario))
    corners = np.asarray(scenario.pursuer_model.corners(scenario))
    assert np.max(np.abs(corners[:, 0]) + axle * np.abs(corners[:, 1])) == pytest.approx(rim, rel=1e-5)
    for b in np.linspace(0.3, 6.0, 58):
        ratio = 0.8 / (1.0 + b / 4.0)
        assert b * ratio**2 / np.sqrt(1.0 - ratio**2) <= best + 1e-5


def test_files_name_the_robots_that_fly(tmp_path):
    file = tmp_path / "yard.toml"
    file.write_text(
        'preset = "quadrotor"\n[evader_model]\nmodel = "quadrotor"\ntime_constant = 0.3\n'
        '[pursuer_model]\nmodel = "aircraft"\nturning_radius = 5.0\n'
    )
    scenario = load_scenario(file)
    assert scenario.evader_model == Quadrotor(time_constant=0.3)
    assert scenario.pursuer_model == Aircraft(turning_radius=5.0)
    told = scenario_to_dict(scenario)
    assert told["evader_model"] == {"model": "quadrotor", "time_constant": 0.3, "attitude_lag": 0.05}
    again = load_scenario("paper", **told)
    assert scenario_to_dict(again) == told


@pytest.mark.parametrize(
    "value, words",
    [
        ("aircraft", r"must be a EvaderModel, or None for the built-in robot, or by name \(quadrotor\)"),
        (
            {"model": "quadrotor", "mass": 1.0},
            "a quadrotor has no 'mass'; it has time_constant, attitude_lag",
        ),
        (
            {"model": "quadrotor", "time_constant": "long"},
            "time_constant = 'long': it must be a finite number",
        ),
        ({"model": "quadrotor", "time_constant": 0.1}, "more than four times the lag"),
    ],
)
def test_a_model_that_a_file_gets_wrong_is_named(value, words):
    with pytest.raises(ScenarioError, match=words):
        load_scenario("quadrotor", evader_model=value)


def test_the_chauffeur_meets_an_evader_that_flies_straight_on():
    """It crosses the evader's way where and when that comes by, neither before nor after."""
    scenario = load_scenario(
        "quadrotor", obstacle_count=0, evader_start=[0.0, 0.0], pursuer_starts=[[3.0, -4.0, 1.2]],
        target_start=[20.0, 0.0],
    )  # fmt: skip
    flown = rollout(scenario, sidestep.goal_seeking, "none", "chauffeur", 0, steps=200)
    assert flown.outcome == "captured"
    speed, _ = body_velocity(flown.wheel_speeds[:, 0].T, scenario.pursuer_half_axle)
    assert np.all((speed >= 0.5 - 1e-6) & (speed <= 1.0 + 1e-6))
    # Its turning circle keeps the first place where it could be at just over 4 s.
    assert flown.length * 0.05 < 4.2


def test_the_chauffeur_flies_on_while_the_evader_is_inside_its_turning_circle(scenario):
    pursuer = make_pursuer("chauffeur")
    world = scenario.reset(jax.random.key(0))
    for place, turns in (((0.0, 4.0), 0.0), ((0.0, 9.0), 1.0), ((0.5, -9.0), -1.0), ((5.0, 0.0), 0.0)):
        here = sidestep.World(jnp.asarray(place), jnp.zeros((1, 3)), world.obstacles, world.target)
        wheels = pursue(scenario, pursuer, here, jax.random.key(0))[0]
        speed, turn_rate = body_velocity(wheels, scenario.pursuer_half_axle)
        assert float(speed) == pytest.approx(1.0)
        assert float(turn_rate) == pytest.approx(0.25 * turns, abs=1e-5)
