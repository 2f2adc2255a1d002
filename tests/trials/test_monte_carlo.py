"""Hazards of evaluation: counts that do not add up, results that depend on how they were computed, code of
others that misbehaves."""

import json
import threading

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from sidestep._arrays import whole_number
from sidestep.loop import batch, episode_key, rollout
from sidestep.store.runs import OUTCOMES
from sidestep.trials import Evaluation, evaluate, monte_carlo
from sidestep.world import goal_seeking, load_scenario

# Crowded and short, so that every outcome occurs.
SETTING = {"arena_side": 2.0, "obstacle_count": 2, "episode_steps": 220}


@pytest.fixture(scope="module")
def scenario():
    return load_scenario("paper", **SETTING)


@pytest.fixture(scope="module")
def evaluation(scenario):
    return evaluate(scenario, "goal-seeking", "none", "turn-then-drive", 150, 7, batch=32)


def test_outcomes_are_exclusive_and_add_up(evaluation):
    counts = [getattr(evaluation, name) for name in OUTCOMES]
    assert evaluation.episodes == sum(counts) == 150
    assert min(counts) > 0
    assert evaluation.safe == evaluation.reached + evaluation.timed_out
    assert np.array_equal(np.bincount(evaluation.outcome, minlength=4), counts)


def test_figures_agree_with_the_outcomes(evaluation, scenario):
    captured, collided = evaluation.numbers_of("captured"), evaluation.numbers_of("collided")
    assert np.all(evaluation.min_pursuer_clearance[captured] <= 0.0)
    others = np.setdiff1d(np.arange(150), captured)
    assert np.all(evaluation.min_pursuer_clearance[others] > 0.0)
    assert np.all(evaluation.min_obstacle_clearance[collided] <= 0.0)
    assert np.all(evaluation.returns[evaluation.numbers_of("reached")] > 900.0)
    assert np.all(evaluation.steps[evaluation.numbers_of("timed_out")] == scenario.episode_steps)
    assert np.allclose(evaluation.times, evaluation.steps * 0.05)


def test_time_to_the_target_is_that_of_the_limit_where_it_was_not_reached(evaluation, scenario):
    reached, report = evaluation.numbers_of("reached"), evaluation.to_dict()
    times = evaluation.times_to_target
    assert np.array_equal(times[reached], evaluation.times[reached])
    others = np.delete(times, reached)
    assert len(others) > 0
    assert np.all(others == evaluation.time_limit)
    assert evaluation.time_limit == pytest.approx(scenario.episode_steps * 0.05)
    assert report["time_mean"] == pytest.approx(np.mean(times))
    assert report["reached_by"]["15"] == pytest.approx(len(reached) / 150)


def test_nobody_is_faster_than_straight_at_full_speed(evaluation, scenario):
    reached = evaluation.numbers_of("reached")
    # The target is reached within a period, which counts in full.
    assert np.all(evaluation.straight_times[reached] <= evaluation.times[reached] + 1e-4)
    alone = evaluate(
        load_scenario("paper", **{**SETTING, "obstacle_count": 0}), "goal-seeking", "none", "still", 50, 7
    )
    undisturbed = alone.numbers_of("reached")
    assert len(undisturbed) > 40
    late = (alone.times - alone.straight_times)[undisturbed]
    assert np.all((late >= -1e-4) & (late < 0.05 + 1e-4))


def test_results_do_not_depend_on_the_batch_size(evaluation, scenario):
    other = evaluate(scenario, "goal-seeking", "none", "turn-then-drive", 150, jax.random.key(7), batch=200)
    assert np.array_equal(other.outcome, evaluation.outcome)
    assert np.array_equal(other.steps, evaluation.steps)
    assert np.allclose(other.returns, evaluation.returns, rtol=1e-4)
    assert np.allclose(other.min_pursuer_clearance, evaluation.min_pursuer_clearance, atol=1e-4)


def test_more_episodes_do_not_change_the_first_ones(evaluation, scenario):
    fewer = evaluate(scenario, "goal-seeking", "none", "turn-then-drive", 40, 7, batch=32)
    assert np.array_equal(fewer.outcome, evaluation.outcome[:40])
    assert np.array_equal(fewer.returns, evaluation.returns[:40])


def test_results_do_not_depend_on_the_number_of_threads(scenario, monkeypatch):
    monkeypatch.setattr(monte_carlo, "useful_threads", lambda most: min(3, most))
    run = lambda **more: evaluate(  # noqa: E731
        scenario, "goal-seeking", "paper", "random", 101, 7, mapped=True, **more
    )
    compiled = batch._advance._cached._cache_size()  # pyright: ignore
    shared, alone = run(batch=96), run(batch=32, threads=1)
    # All threads, and the one alone, have the same width.
    assert batch._advance._cached._cache_size() == compiled + 1  # pyright: ignore
    for name in ("outcome", "returns", "steps", "min_pursuer_clearance", "interventions", "max_correction"):
        assert np.array_equal(getattr(shared, name), getattr(alone, name)), name
    assert shared.map is not None
    assert alone.map is not None
    for name, values in shared.map.to_arrays().items():
        np.testing.assert_allclose(values, alone.map.to_arrays()[name], rtol=1e-5, err_msg=name)


@pytest.mark.parametrize("host", ["policy", "pursuer"])
def test_code_on_the_host_is_asked_by_one_thread(host, monkeypatch):
    most = []
    monkeypatch.setattr(monte_carlo, "useful_threads", lambda count: most.append(count) or count)

    def answer(*_):
        return np.array([0.1, 0.1])

    policy = answer if host == "policy" else "goal-seeking"
    pursuer = answer if host == "pursuer" else "turn-then-drive"
    short = load_scenario("paper", **{**SETTING, "episode_steps": 5})
    assert evaluate(short, policy, "none", pursuer, 100, 7, batch=96).episodes == 100
    assert most == [1]


def test_another_scenario_value_does_not_compile_again(evaluation, scenario):
    before = batch._advance._cached._cache_size()  # pyright: ignore
    faster = load_scenario("paper", **{**SETTING, "arena_side": 2.5, "pursuer_speed": 0.3})
    result = evaluate(faster, "goal-seeking", "none", "turn-then-drive", 33, 8, batch=32)
    assert batch._advance._cached._cache_size() == before  # pyright: ignore
    assert result.episodes == 33


@pytest.mark.parametrize("number", [0, 3, 77])
def test_any_episode_can_be_run_again_alone(evaluation, scenario, number):
    trajectory = rollout(scenario, "goal-seeking", "none", "turn-then-drive", episode_key(7, number))
    assert trajectory.outcome == OUTCOMES[evaluation.outcome[number]]
    assert trajectory.length == evaluation.steps[number]
    assert float(trajectory.events.reward.sum()) == pytest.approx(evaluation.returns[number], rel=1e-4)


def test_report_holds_no_number_that_json_cannot():
    def none_of(value):
        return np.full(2, value)

    report = Evaluation(
        outcome=none_of(OUTCOMES.index("timed_out")),
        returns=none_of(-5.0),
        steps=none_of(3),
        times=none_of(0.15),
        min_pursuer_clearance=none_of(0.4),
        min_obstacle_clearance=none_of(np.inf),
        interventions=none_of(0),
        infeasible=none_of(0),
        invalid=none_of(0),
        mean_correction=none_of(0.0),
        max_correction=none_of(0.0),
    ).to_dict()
    text = json.dumps(report, allow_nan=False)
    assert json.loads(text) == report
    assert report["timed_out"] == 2
    assert report["reach_time_median"] is None
    assert report["min_obstacle_clearance"] is None
    assert set(report["obstacle_clearance_quantiles"].values()) == {None}


def test_report_has_bounds_for_every_rate(evaluation):
    report = evaluation.to_dict()
    for name in (*OUTCOMES, "safe"):
        assert (
            0.0 <= report[f"{name}_rate_low"] <= report[f"{name}_rate"] <= report[f"{name}_rate_high"] <= 1.0
        )
        assert report[f"{name}_rate_low"] < report[f"{name}_rate_high"]


def test_shield_steps_are_counted(scenario):
    shielded = evaluate(scenario, "goal-seeking", "paper", "turn-then-drive", 40, 1, batch=32)
    assert 0 < shielded.intervention_rate < 1
    assert np.all(shielded.infeasible <= shielded.interventions)
    assert shielded.invalid_rate == 0.0
    assert np.all(shielded.mean_correction <= shielded.max_correction)
    assert shielded.to_dict()["max_correction"] <= 2 * 0.1574 + 1e-6


def test_policy_that_answers_nan_is_counted_not_obeyed(scenario):
    result = evaluate(scenario, lambda obs: obs[:2] * jnp.nan, "none", "still", 4, 0, batch=32)
    assert np.array_equal(result.invalid, result.steps)
    assert np.all(np.isfinite(result.returns))
    assert np.all(np.isfinite(result.max_correction))


def test_pursuer_with_an_answer_of_the_wrong_shape_is_refused(scenario):
    with pytest.raises(ValueError, match=r"shape \(2,\)"):
        evaluate(scenario, "goal-seeking", "none", lambda s, w, k: jnp.zeros(3), 1, 0, batch=32)


def test_pursuer_that_cheats_is_kept_to_its_wheel_limits(scenario):
    trajectory = rollout(
        scenario, "goal-seeking", "none", lambda s, w, k: jnp.array([1e6, jnp.nan]), 0, steps=50
    )
    moved = np.diff(np.asarray(trajectory.worlds.pursuers), axis=0)[:, 0, :2]
    assert np.max(np.hypot(*moved.T)) <= 0.2 * 0.05 + 1e-6
    assert np.all(np.isfinite(trajectory.worlds.evader))


@pytest.mark.parametrize("bad", [0, -1, 2.5, True, "many"])
def test_a_number_of_episodes_that_makes_no_sense_is_refused(scenario, bad):
    with pytest.raises(ValueError, match="episodes"):
        whole_number("episodes", bad)


def test_unknown_names_are_named(scenario):
    with pytest.raises(ValueError, match="sliding"):
        evaluate(scenario, "goal-seeking", "sliding", "nash", 1, 0)
    with pytest.raises(ValueError, match="sneaky"):
        evaluate(scenario, "goal-seeking", "none", "sneaky", 1, 0)
    with pytest.raises(ValueError, match="clever"):
        evaluate(scenario, "clever", "none", "nash", 1, 0)


def test_policy_is_asked_only_when_a_decision_is_due(scenario):
    class Slow(eqx.Module):
        decision_steps: int = eqx.field(static=True)

        def __call__(self, observation):
            return goal_seeking(observation)

    slow = evaluate(scenario, Slow(7), "paper", "turn-then-drive", 20, 3, batch=32)
    for number in (0, 11):
        trajectory = rollout(scenario, Slow(7), "paper", "turn-then-drive", episode_key(3, number))
        assert trajectory.length == slow.steps[number]
        changes = np.flatnonzero(np.any(np.diff(np.asarray(trajectory.nominal), axis=0) != 0.0, axis=-1)) + 1
        assert len(changes)
        assert np.all(changes % 7 == 0)


def test_progress_never_goes_back_and_ends_at_all(scenario):
    seen = []
    run = lambda progress: evaluate(  # noqa: E731
        scenario, "goal-seeking", "none", "turn-then-drive", 40, 0, batch=32, progress=progress
    )
    run(lambda *count: seen.append(count))
    assert seen == sorted(seen)
    assert seen[-1] == (40, 40)


def test_an_error_in_the_progress_display_ends_all_threads(scenario, monkeypatch):
    monkeypatch.setattr(monte_carlo, "useful_threads", lambda most: min(3, most))

    def broken(finished, episodes):
        raise RuntimeError("the display is broken")

    before = threading.active_count()
    with pytest.raises(RuntimeError, match="display is broken"):
        evaluate(scenario, "goal-seeking", "none", "turn-then-drive", 90, 0, batch=96, progress=broken)
    assert threading.active_count() == before


@pytest.mark.parametrize("bad", [0, -1, True])
def test_a_number_of_threads_that_makes_no_sense_is_refused(scenario, bad):
    with pytest.raises(ValueError, match="threads"):
        evaluate(scenario, "goal-seeking", "none", "turn-then-drive", 4, 0, threads=bad)
