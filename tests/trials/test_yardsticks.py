"""Hazards of yardsticks: a comparison of different starts, a sign the wrong way round, a share of nothing."""

import dataclasses

import numpy as np
import pytest

from sidestep.store.runs import OUTCOMES
from sidestep.trials import Evaluation, Yardsticks, evaluate, take_yardsticks
from sidestep.world import load_scenario

SHORT = load_scenario("paper", episode_steps=40)


def timed(times, limit=100.0):
    """An evaluation whose episodes took these times (s); those at the limit did not arrive."""
    times = np.asarray(times, float)
    zero, count = np.zeros(len(times)), np.zeros(len(times), int)
    names = np.where(times < limit, "reached", "timed_out")
    outcome = np.array([OUTCOMES.index(name) for name in names])
    clear = (zero, zero, count, count, count, zero, zero)
    return Evaluation(outcome, zero, count + 1, times, *clear, straight_times=zero, time_limit=limit)


@pytest.fixture
def yardsticks():
    generator = np.random.default_rng(0)
    slow = generator.uniform(30.0, 90.0, 400)
    noise = generator.normal(0.0, 1.0, (2, 400))
    others = {"goal-seeking": timed(slow), "planner": timed(slow - 20.0 + noise[0])}
    return Yardsticks(timed(slow - 5.0 + noise[1]), others)


def test_difference_is_negative_for_the_faster_policy_and_taken_start_by_start(yardsticks):
    found = yardsticks.difference("goal-seeking")
    assert found.low < found.estimate < found.high < 0.0
    assert found.estimate == pytest.approx(-5.0, abs=0.2)
    # The starts differ by tens of seconds; from other starts for each policy the interval would be 5 s wide.
    assert found.high - found.low < 0.5
    assert yardsticks.difference("planner").low > 0.0
    mean = np.mean(yardsticks.others["goal-seeking"].times)
    assert yardsticks.ratio("goal-seeking") == pytest.approx(1.0 + found.estimate / mean)


def test_share_of_the_way_to_the_planner_is_that_of_the_mean_times(yardsticks):
    found = yardsticks.share_of_planner
    assert found.low < 0.25 < found.high
    assert found.estimate == pytest.approx(0.25, abs=0.02)


def test_share_is_not_given_where_the_planner_gains_nothing(yardsticks):
    goal_seeking = yardsticks.others["goal-seeking"]
    others = {"goal-seeking": goal_seeking, "planner": timed(goal_seeking.times[::-1])}
    assert dataclasses.replace(yardsticks, others=others).share_of_planner is None
    assert dataclasses.replace(yardsticks, others={}).to_dict() == {"share_of_planner": None}


def test_episodes_that_did_not_arrive_count_as_the_limit():
    other = Yardsticks(timed([10.0, 100.0]), {"goal-seeking": timed([100.0, 100.0])})
    assert other.difference("goal-seeking").estimate == pytest.approx(-45.0)


def test_all_are_measured_from_the_same_starts():
    found = take_yardsticks(SHORT, "goal-seeking", "none", "nash", 5, 3, planner=True, batch=8)
    assert list(found.others) == ["planner"]
    np.testing.assert_array_equal(found.others["planner"].straight_times, found.evaluation.straight_times)
    policy = take_yardsticks(SHORT, lambda observation: observation[:2] * 0.0, "none", "nash", 5, 3, batch=8)
    assert list(policy.others) == ["goal-seeking"]
    np.testing.assert_array_equal(
        policy.others["goal-seeking"].straight_times, found.evaluation.straight_times
    )
    alone = evaluate(SHORT, "goal-seeking", "none", "nash", 5, 3, batch=8)
    np.testing.assert_array_equal(policy.others["goal-seeking"].returns, alone.returns)
