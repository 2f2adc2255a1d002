"""Hazards of one control step: a pursuer that steers another's wheels, a NaN that looks like a stop."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from sidestep.loop.step import control_step, decide, decision_steps_of, pursue
from sidestep.safety import Status, make_shield
from sidestep.world import World, goal_seeking, load_scenario


@pytest.fixture(scope="module")
def scenario():
    return load_scenario("paper", pursuer_count=3, obstacle_count=0)


@pytest.fixture(scope="module")
def world():
    pursuers = jnp.array([[1.0, 0.1, 0.0], [2.0, 0.2, 0.0], [3.0, 0.3, 0.0]])
    return World(jnp.zeros(2), pursuers, jnp.zeros((0, 4)), jnp.array([0.0, 2.0]))


def test_every_pursuer_is_asked_about_itself_and_drives_its_own_wheels(scenario, world):
    wheels = pursue(scenario, lambda scenario, world, key: world.pursuer[:2], world, jax.random.key(0))
    assert np.allclose(wheels, [[1.0, 0.1], [2.0, 0.2], [3.0, 0.3]])


def test_random_pursuers_do_not_move_in_step(scenario, world):
    wheels = pursue(scenario, lambda s, w, key: jax.random.normal(key, (2,)), world, jax.random.key(0))
    assert len(np.unique(np.asarray(wheels))) == 6


def test_wheel_speeds_reach_the_robots_they_were_meant_for(scenario, world):
    shield = make_shield("none", scenario)

    def only_the_second(scenario, world, key):
        return jnp.where(world.pursuer[0] == 2.0, 0.2, 0.0) * jnp.ones(2)

    moved, _, _, _, wheels = control_step(
        scenario, shield, only_the_second, world, shield.init(world), jnp.zeros(2), jax.random.key(0)
    )
    assert np.allclose(wheels, [[0.0, 0.0], [0.2, 0.2], [0.0, 0.0]])
    assert np.allclose(moved.pursuers[:, 0] - world.pursuers[:, 0], [0.0, 0.01, 0.0], atol=1e-6)


def test_action_that_is_not_finite_reaches_the_shield_as_such(scenario, world):
    nominal = decide(scenario, lambda observation: jnp.array([jnp.nan, 0.0]), world)
    assert np.all(np.isnan(nominal))
    for name in ("none", "paper", "game"):
        shield = make_shield(name, scenario)
        result, _ = shield(world, nominal, shield.init(world))
        assert int(result.status) == Status.INVALID
        assert np.all(np.isfinite(result.action))


def test_decision_points_where_the_policy_wants(scenario, world):
    assert np.allclose(decide(scenario, goal_seeking, world), [0.0, 0.1574], atol=1e-6)
    assert np.allclose(
        decide(scenario, lambda observation: [30.0, 40.0], world), [-0.12592, 0.09444], atol=1e-5
    )


def test_answers_of_the_wrong_shape_are_refused(scenario, world):
    with pytest.raises(ValueError, match="action of shape"):
        decide(scenario, lambda observation: jnp.zeros(3), world)
    with pytest.raises(ValueError, match="wheel speeds"):
        pursue(scenario, lambda s, w, k: jnp.zeros((1, 2)), world, jax.random.key(0))


def test_decision_interval_defaults_to_every_step():
    assert decision_steps_of(goal_seeking) == 1
