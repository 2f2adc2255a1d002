"""One episode: does it stop when it ends, and does its tally say what happened?"""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from sidestep.loop import Task, advance, as_policy, begin, rollout
from sidestep.loop.episode import ask_in_time
from sidestep.loop.keys import as_key, start_and_pursuit
from sidestep.loop.step import CAPTURED, RUNNING
from sidestep.pursuit import make_pursuer
from sidestep.safety import Status, make_shield
from sidestep.store.runs import OUTCOMES
from sidestep.world import load_scenario

SEED = 5


@pytest.fixture(scope="module")
def task():
    scenario = load_scenario("paper", episode_steps=60, arena_side=2.0, reach_distance=0.05)
    policy = as_policy("goal-seeking", scenario)
    return Task(scenario, policy, make_shield("game", scenario), make_pursuer("nash"))


@eqx.filter_jit
def played(task, episode, key, periods):
    """Each period from the start on, whether the episode had ended or not."""

    def period(episode, count):
        episode = ask_in_time(task, episode, count)
        episode, period = advance(task, episode, jax.random.fold_in(key, count))
        return episode, (episode, period)

    return jax.lax.scan(period, episode, jnp.arange(periods))[1]


def test_an_episode_that_has_ended_never_changes_again(task):
    key, pursuit_key = start_and_pursuit(as_key(SEED))
    episodes, periods = played(task, begin(task.shield, task.scenario.reset(key)), pursuit_key, 80)
    outcome = np.asarray(episodes.outcome)
    ended = int(np.argmax(outcome != RUNNING))
    assert 0 < ended < 70
    assert np.all(outcome[ended:] == outcome[ended])
    np.testing.assert_array_equal(periods.running, np.arange(80) <= ended)
    kept = (episodes.world, episodes.memory, episodes.outcome, episodes.tally)
    for leaf in map(np.asarray, jax.tree.leaves(kept)):
        assert all(later.tobytes() == leaf[ended].tobytes() for later in leaf[ended:])


def test_the_tally_is_what_the_recorded_periods_say(task):
    record = rollout(task.scenario, task.policy, task.shield, task.pursuer, SEED)
    key, pursuit_key = start_and_pursuit(as_key(SEED))
    episodes, _ = played(task, begin(task.shield, task.scenario.reset(key)), pursuit_key, 80)
    end = jax.tree.map(lambda leaf: leaf[-1], episodes)
    tally, status = end.tally, np.asarray(record.status)
    assert OUTCOMES[int(end.outcome)] == record.outcome
    assert int(tally.steps) == record.length
    assert int(tally.interventions) == np.sum(status != Status.OK) > 0
    assert int(tally.infeasible) == np.sum(status == Status.INFEASIBLE)
    assert int(tally.invalid) == int(tally.pursuer_invalid) == 0
    events = record.events
    assert float(tally.total_reward) == pytest.approx(float(np.sum(events.reward)), rel=1e-5)
    assert float(tally.pursuer_clearance) == pytest.approx(float(np.min(events.pursuer_clearance)), abs=1e-6)
    assert float(tally.obstacle_clearance) == pytest.approx(
        float(np.min(events.obstacle_clearance)), abs=1e-6
    )
    assert float(tally.correction) == pytest.approx(float(np.sum(record.intervention)), rel=1e-5)
    assert float(tally.max_correction) == pytest.approx(float(np.max(record.intervention)), rel=1e-6)


def test_the_policy_is_asked_only_when_a_decision_is_due(task):
    class Slow(eqx.Module):
        decision_steps: int = eqx.field(static=True, default=7)

        def __call__(self, observation):
            return jnp.stack([jnp.cos(observation[0] * 50.0), jnp.sin(observation[0] * 50.0)])

    slow = eqx.tree_at(lambda task: task.policy, task, Slow())
    key, pursuit_key = start_and_pursuit(as_key(SEED))
    _, periods = played(slow, begin(slow.shield, slow.scenario.reset(key)), pursuit_key, 35)
    running = np.asarray(periods.running)
    nominal = np.asarray(periods.nominal)[running]
    changed = np.any(nominal[1:] != nominal[:-1], axis=1)
    assert np.all(np.flatnonzero(changed) % 7 == 6)
    assert np.sum(changed) == (len(nominal) - 1) // 7 > 1


def test_pursuers_without_an_answer_and_a_capture_are_counted(task):
    def broken(scenario, world, key):
        return jnp.full(2, jnp.nan)

    scenario = load_scenario("paper", episode_steps=5)
    world = scenario.reset(jax.random.key(0))
    near = world.evader + jnp.array([0.5 * float(scenario.capture_distance), 0.0])
    world = eqx.tree_at(lambda w: w.pursuers, world, world.pursuers.at[0, :2].set(near))
    still = Task(scenario, as_policy("goal-seeking", scenario), make_shield("none", scenario), broken)
    episodes, _ = played(still, begin(still.shield, world), jax.random.key(0), 3)
    assert int(episodes.outcome[-1]) == CAPTURED
    assert int(episodes.tally.pursuer_invalid[-1]) == 1
    assert int(episodes.tally.steps[-1]) == 1
