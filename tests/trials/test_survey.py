"""Hazards of looking closer: periods counted in the wrong place, a record of other episodes than measured."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from sidestep.loop import Period
from sidestep.safety import ShieldResult, Status
from sidestep.store.runs import OUTCOMES, RunError
from sidestep.trials import Evaluation, InterventionMap, load_survey, save_survey, take_survey
from sidestep.trials.intervention_map import CELLS, add_periods, map_reach, no_periods
from sidestep.trials.survey import worst_numbers
from sidestep.world import Scenario, World, load_scenario

PAPER = Scenario()


def counted(evader, pursuers, nominal, action, status, running):
    """The map of one period of these lanes (all with their axis first here)."""
    lanes = len(evader)
    places = [jnp.asarray(each, float) for each in (evader, pursuers)]
    worlds = jax.vmap(World)(*places, jnp.zeros((lanes, 0, 4)), jnp.zeros((lanes, 2)))
    world = jax.tree.map(lambda leaf: jnp.moveaxis(leaf, 0, -1), worlds)
    nominal, action = jnp.asarray(nominal, float).T, jnp.asarray(action, float).T
    change = jnp.where(jnp.isfinite(nominal), action - nominal, 0.0)
    result = ShieldResult(
        action=action,
        status=jnp.asarray(status, jnp.int32),
        barriers=jnp.zeros((1, lanes)),
        slack=jnp.zeros(lanes),
        intervention=jnp.hypot(change[0], change[1]),
    )
    # Wheel speeds and events are not read.
    period = Period(world, world, nominal, result, None, None, jnp.asarray(running))
    sums = add_periods(no_periods(), PAPER, period)
    return InterventionMap.of_sums(float(map_reach(PAPER)), np.asarray(sums, np.float64))


def test_a_period_is_counted_where_the_nearest_pursuer_sees_the_evader():
    # Both pursuers look along +y; the near one has the evader 0.3 m ahead and 0.1 m to its right.
    near, far = [1.0, 2.0, np.pi / 2], [1.0, 4.0, np.pi / 2]
    one = counted(
        [[1.1, 2.3]], [[far, near]], [[0.1, 0.0]], [[0.1, 0.12]], [Status.CORRECTED], [True]
    )  # fmt: skip
    (row,), (column,) = np.nonzero(one.periods)
    width = 2 * one.reach / CELLS
    assert -one.reach + width * column <= 0.3 <= -one.reach + width * (column + 1)
    assert -one.reach + width * row <= -0.1 <= -one.reach + width * (row + 1)
    assert one.corrected[row, column] == 1
    assert one.infeasible.sum() == one.outside == 0
    assert one.correction[row, column] == pytest.approx(0.12)
    # Along +y in the world is straight ahead of that pursuer.
    assert one.ahead[row, column] == pytest.approx(0.12)
    assert one.left[row, column] == pytest.approx(0.0, abs=1e-7)


def test_what_has_ended_or_is_far_away_or_asks_for_nothing_finite_leaves_no_mark():
    pursuer = [[0.0, 0.0, 0.0]]
    one = counted(
        [[0.3, 0.0], [0.3, 0.0], [9.0, 0.0]],
        [pursuer] * 3,
        [[np.nan, 0.0], [0.1, 0.0], [0.1, 0.0]],
        [[0.0, 0.0], [0.0, 0.0], [0.0, 0.0]],
        [Status.INVALID, Status.INFEASIBLE, Status.CORRECTED],
        [True, False, True],
    )
    assert one.periods.sum() == 1
    assert one.outside == 1
    assert one.infeasible.sum() == 0
    assert np.all(np.isfinite(one.correction))
    assert one.ahead.sum() == 0.0


def test_maps_of_other_regions_are_not_added_up():
    one = InterventionMap.of_sums(0.5, np.ones((CELLS**2 + 1, 6)))
    both = one + one
    assert both.periods.sum() == 2 * CELLS**2
    assert both.outside == 2
    with pytest.raises(ValueError, match="same region"):
        one + dataclasses.replace(one, reach=0.6)


@pytest.fixture(scope="module")
def survey():
    scenario = load_scenario("paper", arena_side=2.0, obstacle_count=2, episode_steps=220)
    return take_survey(scenario, "goal-seeking", "paper", "turn-then-drive", 32, 1)


def test_every_period_is_counted_once(survey):
    evaluation = survey.evaluation
    assert evaluation.map.periods.sum() + evaluation.map.outside == evaluation.steps.sum()
    assert 0 < evaluation.map.corrected.sum() <= evaluation.interventions.sum()
    assert np.all(evaluation.map.infeasible <= evaluation.map.corrected)
    assert np.all(evaluation.map.corrected <= evaluation.map.periods)
    total = np.sum(evaluation.mean_correction * evaluation.steps)
    assert 0 < evaluation.map.correction.sum() <= total * (1 + 1e-5)


def test_worst_episodes_are_those_measured_and_the_worst_of_them(survey):
    evaluation = survey.evaluation
    assert len(survey.worst) == 4
    for episode in survey.worst:
        name = {"capture": "pursuer", "collision": "obstacle"}[episode.hazard]
        measured = getattr(evaluation, f"min_{name}_clearance")
        recorded = getattr(episode.trajectory.events, f"{name}_clearance")
        assert episode.trajectory.outcome == OUTCOMES[evaluation.outcome[episode.number]]
        assert float(recorded.min()) == pytest.approx(measured[episode.number], abs=1e-4)
        assert np.sum(measured < measured[episode.number]) < 4
    assert {episode.hazard for episode in survey.worst} == {"capture", "collision"}


def test_hazard_without_a_robot_gives_no_worst_episode(survey):
    alone = dataclasses.replace(survey.evaluation, min_obstacle_clearance=np.full(32, np.inf))
    order = worst_numbers(alone)
    assert {hazard for _, hazard in order} == {"capture"}
    assert [number for number, _ in order[:1]] == [int(np.argmin(alone.min_pursuer_clearance))]


def test_survey_comes_back_from_disk_as_it_was(survey, tmp_path):
    save_survey(tmp_path, survey)
    again = load_survey(tmp_path)
    for field in dataclasses.fields(Evaluation):
        if field.name != "map":
            assert np.array_equal(
                getattr(again.evaluation, field.name), getattr(survey.evaluation, field.name)
            )
    assert np.array_equal(again.evaluation.map.periods, survey.evaluation.map.periods)
    assert again.evaluation.map.reach == survey.evaluation.map.reach
    assert again.seed == survey.seed
    assert [one.number for one in again.worst] == [one.number for one in survey.worst]
    assert (tmp_path / "episodes.npz").stat().st_size < 60_000


def test_survey_of_a_policy_that_was_trained_further_since_is_not_shown(survey, tmp_path):
    (tmp_path / "policy.npz").write_bytes(b"as it was")
    save_survey(tmp_path, survey)
    assert load_survey(tmp_path) is not None
    (tmp_path / "policy.npz").write_bytes(b"trained further")
    assert load_survey(tmp_path) is None


def test_folder_from_before_has_no_survey_and_a_damaged_one_is_named(survey, tmp_path):
    assert load_survey(tmp_path) is None
    save_survey(tmp_path, survey)
    whole = (tmp_path / "episodes.npz").read_bytes()
    (tmp_path / "episodes.npz").write_bytes(whole[: len(whole) // 2])
    with pytest.raises(RunError, match=r"episodes\.npz is not readable"):
        load_survey(tmp_path)
