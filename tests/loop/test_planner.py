"""Hazards of the planner: it imagines another chase than the one that is run, or is no yardstick."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from sidestep.loop import Task, as_policy, ask, begin, rollout
from sidestep.loop.planner import SEGMENTS, STRAIGHT, Planner
from sidestep.pursuit import make_pursuer
from sidestep.robot import Onboard
from sidestep.safety import make_shield
from sidestep.trials import evaluate
from sidestep.world import World, load_scenario

SCENARIO = load_scenario("paper", episode_steps=600)
QUICK = Planner(segment=20)


def task_of(pursuer, shield="game", planner=QUICK):
    return Task(SCENARIO, planner, make_shield(shield, SCENARIO), make_pursuer(pursuer))


def facing(pursuer, target=(1.0, 0.0)):
    """The evader at the origin, and one obstacle far away."""
    return World(
        evader=np.zeros(2),
        pursuers=np.array([pursuer]),
        obstacles=np.array([[9.0, 9.0, 0.0, 0.0]]),
        target=np.array(target),
    )


@eqx.filter_jit
def planned(task, worlds):
    return ask(task, begin(task.shield, worlds, task.policy))


def test_nothing_in_the_way_means_straight_at_the_target():
    episode = planned(task_of("still"), facing((-5.0, 0.0, 0.0)))
    np.testing.assert_array_equal(episode.plan, STRAIGHT)
    np.testing.assert_allclose(episode.nominal, [float(SCENARIO.evader_speed), 0.0], atol=1e-6)


def test_plans_depend_on_the_strategy_of_the_pursuer():
    world = facing((1.5, 1.3, -2.0), target=(1.5, 0.6))
    plans = [np.asarray(planned(task_of(name), world).plan) for name in ("still", "interceptor")]
    assert np.any(plans[0] != plans[1])


def test_worlds_in_lanes_get_the_plans_that_each_gets_alone():
    task = task_of("interceptor")
    starts = [SCENARIO.reset(jax.random.key(seed)) for seed in range(4)]
    lanes = planned(task, jax.tree.map(lambda *leaves: jnp.stack(leaves, axis=-1), *starts))
    assert lanes.plan.shape == (SEGMENTS, 4)
    for lane, world in enumerate(starts):
        alone = planned(task, world)
        np.testing.assert_array_equal(lanes.plan[:, lane], alone.plan)
        np.testing.assert_allclose(lanes.nominal[:, lane], alone.nominal, atol=1e-6)


def test_the_chase_ends_as_imagined():
    """A plan that is imagined to arrive does: each later decision keeps the rest of it, or finds a better."""
    task = task_of("interceptor", planner=Planner.of(SCENARIO))
    arrived = 0
    for seed in range(4):
        start = begin(task.shield, SCENARIO.reset(jax.random.key(seed)), task.policy)
        plan = planned(task, start.world).plan
        costs = eqx.filter_jit(task.policy._costs)(task, start, plan[:, None])
        record = rollout(SCENARIO, task.policy, task.shield, task.pursuer, 0, start.world)
        if float(costs[0]) == 0.0:
            assert record.outcome == "reached"
            arrived += 1
    assert arrived > 1


def test_planner_is_faster_than_goal_seeking_where_there_is_room():
    found = {
        name: evaluate(SCENARIO, name, "game", "interceptor", 16, 1_000_000, batch=16)
        for name in ("goal-seeking", "planner")
    }
    planner, goal_seeking = (np.mean(found[name].times_to_target) for name in ("planner", "goal-seeking"))
    assert planner < 0.8 * goal_seeking
    assert found["planner"].safe == 16


def test_without_a_shield_it_plans_for_staying_free():
    found = [evaluate(SCENARIO, name, "none", "nash", 16, 3, batch=16) for name in ("goal-seeking", QUICK)]
    assert found[0].safe < found[1].safe
    assert found[1].safe >= 14


def own(scenario, world, key):
    return jnp.array([0.1, 0.05]) + 0.0 * world.time


def on_the_host(scenario, world, key):
    return np.array([0.1, 0.05])


@pytest.mark.parametrize("pursuer", [pytest.param("random", marks=pytest.mark.slow), own, on_the_host])
def test_any_pursuer_can_be_planned_against(pursuer):
    # Each imagined period asks a pursuer on the host for all plans, one by one.
    short = load_scenario("paper", episode_steps=4)
    assert evaluate(short, Planner(segment=2), "game", pursuer, 2, 0, batch=2).safe == 2


def test_shields_that_look_ahead_are_imagined_by_their_rows():
    task = task_of("nash", shield="joint")
    assert task.shield.rows_only is not task.shield
    episode = planned(task, facing((-1.0, 0.0, 0.0)))
    np.testing.assert_array_equal(episode.plan, STRAIGHT)


def test_segment_is_the_time_to_drive_two_capture_distances():
    assert as_policy("planner", SCENARIO, in_episode=True).segment == 51
    fast = load_scenario("paper", evader_speed=1.574, pursuer_speed=2.0)
    assert Planner.of(fast).segment == 5


def test_robots_cannot_ask_it():
    with pytest.raises(ValueError, match="knows the pursuer's strategy"):
        Onboard(SCENARIO, "game", QUICK)
    with pytest.raises(ValueError, match="knows the pursuer's strategy"):
        as_policy("planner", SCENARIO)
