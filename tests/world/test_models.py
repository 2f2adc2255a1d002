"""Robots that a user brings: their motion, and what is said of a model that does not keep its word."""

import dataclasses
import json
import runpy
from pathlib import Path

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from sidestep.pursuit import as_pursuer, make_pursuer, pursue
from sidestep.world import (
    EvaderModel,
    EvaderState,
    ModelWarning,
    PursuerModel,
    ScenarioError,
    World,
    load_scenario,
    probe_evader,
    scenario_to_dict,
)
from sidestep.world.robots import body_velocity

# What users are shown is what is tested.
EXAMPLES = Path(__file__).parents[2] / "examples"
Accelerating = runpy.run_path(str(EXAMPLES / "accelerating_evader.py"))["Accelerating"]
Unicycle = runpy.run_path(str(EXAMPLES / "unicycle_evader.py"))["Unicycle"]
Car = runpy.run_path(str(EXAMPLES / "car_pursuer.py"))["Car"]


class Obedient(EvaderModel):
    """Moves as the built-in evader does."""

    def after(self, scenario, robot, command, time):
        return EvaderState(robot.position + command * time, command, robot.state)


@eqx.filter_jit
def _random_worlds(scenario, count=16):
    return jax.vmap(scenario.reset)(jax.random.split(jax.random.key(1), count))


@eqx.filter_jit
def _step(scenario, world, action, wheels):
    return scenario.step(world, action, wheels)


@eqx.filter_jit
def _step_all(scenario, worlds, actions, wheels):
    return jax.vmap(scenario.step)(worlds, actions, wheels)


def test_obedient_model_is_the_built_in_evader(x64):
    plain, own = load_scenario("paper"), load_scenario("paper", evader_model=Obedient())
    rng = np.random.default_rng(0)
    actions, wheels = (jnp.asarray(rng.uniform(-0.3, 0.3, shape)) for shape in ((16, 2), (16, 1, 2)))
    world = _random_worlds(own)
    plain_world = eqx.tree_at(lambda w: w.evader_state, world, None, is_leaf=lambda leaf: leaf is None)
    moved, events = _step_all(own, world, actions, wheels)
    expected, expected_events = _step_all(plain, plain_world, actions, wheels)
    moved = eqx.tree_at(lambda w: w.evader_state, moved, None)
    for a, b in zip(
        jax.tree.leaves((moved, events)), jax.tree.leaves((expected, expected_events)), strict=True
    ):
        np.testing.assert_allclose(a, b, atol=1e-9)


def test_worlds_in_lanes_move_as_one_by_one():
    scenario = load_scenario("paper", evader_model=Unicycle(), pursuer_model=Car())
    worlds = _random_worlds(scenario)
    rng = np.random.default_rng(0)
    actions, wheels = (jnp.asarray(rng.uniform(-0.3, 0.3, shape), float) for shape in ((16, 2), (16, 1, 2)))
    one_by_one = _step_all(scenario, worlds, actions, wheels)
    behind = jax.tree.map(lambda leaf: jnp.moveaxis(leaf, 0, -1), (worlds, actions, wheels))
    in_lanes = jax.tree.map(lambda leaf: jnp.moveaxis(leaf, -1, 0), _step(scenario, *behind))
    for a, b in zip(jax.tree.leaves(in_lanes), jax.tree.leaves(one_by_one), strict=True):
        np.testing.assert_allclose(a, b, atol=1e-6)


@pytest.mark.parametrize("model", [Accelerating(), Unicycle()], ids=["mass", "unicycle"])
def test_control_point_moves_as_told_and_stays_within_its_offset(x64, model):
    seen = probe_evader(model, load_scenario("paper", capture_distance=0.15))
    assert seen.errors == ()
    assert seen.tracking_error < 1e-9
    assert 0.5 * float(model.offset(load_scenario("paper"))) < seen.offset


def test_mass_never_asks_for_more_than_the_greatest_acceleration(x64):
    scenario, model = load_scenario("paper"), Accelerating(most=3.0)
    robot = EvaderState(jnp.zeros(2), jnp.asarray([-scenario.evader_speed, 0.0]), jnp.zeros(0))
    told = jnp.asarray([scenario.evader_speed, 0.0])
    soon = model.after(scenario, robot, told, jnp.asarray(1e-6))
    assert float(jnp.linalg.norm(soon.velocity - robot.velocity)) / 1e-6 == pytest.approx(3.0, rel=1e-4)


class Swinging(EvaderModel):
    """Swings out by 3 cm on the way to where it is told to go, and is back at the end of each period."""

    def start(self, scenario, key):
        return jnp.zeros(1)

    def after(self, scenario, robot, command, time):
        swing = 0.03 * jnp.sin(jnp.pi * time / scenario.control_period) ** 2
        return EvaderState(robot.position + jnp.stack([jnp.zeros(()), swing]), command, robot.state)


def test_contact_in_the_middle_of_a_curved_period_is_seen():
    scenario = dataclasses.replace(load_scenario("paper"), evader_model=Swinging())
    world = World(
        jnp.zeros(2), jnp.asarray([[5.0, 5.0, 0.0]]), jnp.asarray([[0.0, 0.22, 0.0, 0.0]]), jnp.full(2, 3.0),
        evader_state=jnp.zeros(1),
    )  # fmt: skip
    moved, events = _step(scenario, world, jnp.zeros(2), jnp.zeros((1, 2)))
    np.testing.assert_allclose(moved.evader, 0.0, atol=1e-6)
    assert bool(events.collided)
    assert float(events.obstacle_clearance) == pytest.approx(-0.01, abs=1e-4)


def test_world_without_the_models_state_says_where_to_get_one():
    scenario = load_scenario("paper", evader_model=Unicycle(), capture_distance=0.15)
    world = load_scenario("paper").reset(jax.random.key(0))
    with pytest.raises(ValueError, match=r"worlds from scenario\.reset"):
        scenario.step(world, jnp.zeros(2), jnp.zeros((1, 2)))


class Lagging(Accelerating):
    """Guards its position, which does not move as it is told."""

    def control_point(self, scenario, robot):
        return robot.position


class Understating(Unicycle):
    def offset(self, scenario):
        return 0.5 * self.ahead


class Timeless(Unicycle):
    def after(self, scenario, robot, command, time):
        return super().after(scenario, robot, command, scenario.control_period)


class Broken(Obedient):
    def after(self, scenario, robot, command, time):
        return EvaderState(robot.position / (time - time), command, robot.state)


class Misshapen(Obedient):
    def after(self, scenario, robot, command, time):
        return robot.position, command


class Raising(Obedient):
    def offset(self, scenario):
        return scenario.no_such_field


class Concrete(Obedient):
    def offset(self, scenario):
        return 0.1 * float(scenario.evader_speed)


@pytest.mark.parametrize(
    "model, words",
    [
        (Understating(), r"was 0\.02 m from the robot, but offset\(\.\.\.\) is 0\.01 m"),
        (Timeless(), "over one period and over four parts"),
        (Broken(), "not finite"),
        (Misshapen(), r"must give an EvaderState of the shapes"),
        (Raising(), r"offset\(scenario\) raised AttributeError"),
        (Concrete(), r"offset\(scenario\) raised ConcretizationTypeError"),
    ],
    ids=lambda value: type(value).__name__,
)
def test_evader_that_does_not_keep_its_word_is_refused(model, words):
    with pytest.raises(ScenarioError, match=words):
        load_scenario("paper", evader_model=model)


def test_evader_whose_point_lags_is_told_the_tracking_error():
    with pytest.warns(ModelWarning, match=r"Budget\(tracking_error=0\.2"):
        load_scenario("paper", evader_model=Lagging())


@pytest.mark.parametrize("name", ["turn-then-drive", "random"])
def test_no_strategy_makes_a_car_turn_on_the_spot(name):
    scenario = load_scenario("paper", pursuer_model=Car())
    worlds, strategy = _random_worlds(scenario), make_pursuer(name)
    keys = jax.random.split(jax.random.key(0), 16)
    wheels = jax.jit(jax.vmap(lambda world, key: pursue(scenario, strategy, world, key)))(worlds, keys)
    speed, turn_rate = body_velocity(jnp.moveaxis(wheels[:, 0], -1, 0), scenario.pursuer_half_axle)
    assert float(jnp.min(speed)) >= -1e-6
    assert float(jnp.max(speed)) <= 0.2 + 1e-6
    assert bool(jnp.all(jnp.abs(turn_rate) <= speed + 1e-5))
    # The physics lets no more through than the strategy's own call does.
    moved, _ = _step_all(scenario, worlds, jnp.zeros((16, 2)), jnp.full((16, 1, 2), 9.0))
    far = jnp.linalg.norm(moved.pursuers[:, 0, :2] - worlds.pursuers[:, 0, :2], axis=-1)
    assert float(jnp.max(far)) <= 0.2 * 0.05 + 1e-6


def test_own_strategy_of_a_car_is_limited_too():
    scenario = load_scenario("paper", pursuer_model=Car(radius=2.0))
    spin = as_pursuer(lambda scenario, world, key: jnp.asarray([-0.2, 0.2]))
    speed, turn_rate = body_velocity(
        spin(scenario, scenario.reset(jax.random.key(0)), jax.random.key(0)), scenario.pursuer_half_axle
    )
    assert float(speed) == pytest.approx(0.0, abs=1e-6)
    assert float(turn_rate) == pytest.approx(0.0, abs=1e-6)


class Boastful(Car):
    def covering(self, scenario):
        return scenario.pursuer_speed, 0.75 * self.radius


class Slipping(Car):
    def limit(self, scenario, speed, turn_rate):
        return speed, turn_rate


class Flat(Car):
    def corners(self, scenario):
        return scenario.pursuer_speed * jnp.ones(2)


@pytest.mark.parametrize(
    "model, words",
    [
        (Boastful(), r"cannot do .*\|v\| \+ b \|omega\| is 0\.35 m/s"),
        (Slipping(), "outside the hull"),
        (Flat(), r"must give finite pairs"),
    ],
    ids=lambda value: type(value).__name__,
)
def test_pursuer_that_can_do_more_than_its_model_says_is_refused(model, words):
    with pytest.raises(ScenarioError, match=words):
        load_scenario("paper", pursuer_model=model)


@pytest.mark.parametrize("value", ["Unicycle(ahead=0.02)", 3.0, Car()], ids=["text", "number", "pursuer"])
def test_model_that_is_none_says_that_it_is_code(value):
    with pytest.raises(ScenarioError, match=r"must be a EvaderModel.*is code"):
        load_scenario("paper", evader_model=value)


def test_written_scenario_names_its_model_and_asks_for_it(tmp_path):
    scenario = load_scenario("paper", evader_model=Unicycle(), capture_distance=0.15)
    file = tmp_path / "mine.json"
    file.write_text(json.dumps(scenario_to_dict(scenario)))
    with pytest.raises(ScenarioError, match=r"Unicycle\("):
        load_scenario(file)
    again = load_scenario(file, evader_model=Unicycle())
    assert eqx.tree_equal(again.evader_model, Unicycle())


def test_plain_scenario_writes_none_for_its_models_and_reads_it_back(tmp_path):
    values = scenario_to_dict(load_scenario("paper"))
    assert values["evader_model"] is None
    assert isinstance(PursuerModel, type)
    file = tmp_path / "plain.json"
    file.write_text(json.dumps(values))
    assert load_scenario(file).built_in
