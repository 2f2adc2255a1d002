"""Hazards of the policy that comes with the package: one that does not fit, or that learned nothing."""

import numpy as np
import pytest

from sidestep.commands.common import policy_and_scenario
from sidestep.learning import PRETRAINED, PRETRAINED_SCENARIO, load_policy, policy_file
from sidestep.trials import evaluate
from sidestep.world import load_scenario


def _times(shield, pursuer, episodes, **changes):
    """Mean times to the target (s), of the policy and of a straight drive."""
    scenario = load_scenario("paper", episode_steps=2400, **PRETRAINED_SCENARIO, **changes)
    return [
        np.mean(evaluate(scenario, policy, shield, pursuer, episodes, 3).times_to_target)
        for policy in (load_policy(PRETRAINED), "goal-seeking")
    ]


def test_it_is_faster_than_driving_straight_behind_the_same_shield():
    """Against the pursuer that costs a straight drive most, behind the shield it was trained with."""
    learned, straight = _times("joint:table", "interceptor", 48)
    assert learned < 0.75 * straight


@pytest.mark.slow
@pytest.mark.parametrize("pursuer", ["nash", "turn-then-drive", "interceptor"])
def test_it_is_faster_where_the_shield_looks_ahead_too(pursuer):
    learned, straight = _times("joint", pursuer, 128)
    assert learned < straight


def test_its_name_brings_the_scenario_that_it_was_trained_in():
    policy, scenario, config = policy_and_scenario(PRETRAINED, None, ())
    assert (scenario.name, scenario.observation, config) == ("paper", "motion", {})
    assert policy_and_scenario(PRETRAINED, "paper-test", ())[1].observation == "motion"
    with pytest.raises(ValueError, match="observation"):
        evaluate(load_scenario("paper"), policy, "none", "still", 2, 0)


def test_a_folder_of_that_name_is_reached_by_its_path(tmp_path, monkeypatch):
    (tmp_path / PRETRAINED).mkdir()
    monkeypatch.chdir(tmp_path)
    assert policy_file(PRETRAINED).is_file()
    with pytest.raises(ValueError, match="holds no run"):
        policy_file("./pretrained")


def test_it_ships_small():
    assert policy_file(PRETRAINED).stat().st_size < 2_000_000
