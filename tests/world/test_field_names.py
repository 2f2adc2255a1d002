"""Names: do the words of a data sheet reach the field that they mean, or the right advice?"""

import json

import pytest

from sidestep.commands.common import scenario_of_run, scenario_overrides
from sidestep.world import ALIASES, ScenarioError, load_scenario, scenario_to_dict, without_aliases


@pytest.mark.parametrize("value", [0.16, 1])
def test_wheel_separation_is_twice_the_half_axle_and_is_not_stored(value):
    scenario = load_scenario("paper", wheel_separation=value)
    stored = scenario_to_dict(scenario)
    assert stored["pursuer_half_axle"] == value / 2.0
    assert not set(ALIASES) & set(stored)


@pytest.mark.parametrize("suffix", [".toml", ".json"])
def test_wheel_separation_in_a_file_and_an_override_over_it(suffix, tmp_path):
    path = tmp_path / f"robots{suffix}"
    path.write_text(json.dumps({"wheel_separation": 0.3}) if suffix == ".json" else "wheel_separation = 0.3")
    assert float(load_scenario(path).pursuer_half_axle) == pytest.approx(0.15)
    assert float(load_scenario(path, pursuer_half_axle=0.1).pursuer_half_axle) == pytest.approx(0.1)
    path.write_text(
        json.dumps({"pursuer_half_axle": 0.3}) if suffix == ".json" else "pursuer_half_axle = 0.3"
    )
    assert float(load_scenario(path, wheel_separation=0.16).pursuer_half_axle) == pytest.approx(0.08)


def test_wheel_separation_replaces_the_half_axle_that_a_run_was_trained_with():
    """`evaluate run --set wheel_separation=...` merges it with the run's stored, complete fields."""
    stored = scenario_to_dict(load_scenario("paper"))
    merged = {**stored, **scenario_overrides(("wheel_separation=0.16",))}
    assert float(load_scenario("paper", **merged).pursuer_half_axle) == pytest.approx(0.08)
    scenario, _ = scenario_of_run(None, "paper", ("wheel_separation=0.16",))
    assert float(scenario.pursuer_half_axle) == pytest.approx(0.08)


def test_alias_beside_its_field_is_refused_by_name():
    with pytest.raises(ScenarioError, match="give one of them") as caught:
        load_scenario("paper", wheel_separation=0.16, pursuer_half_axle=0.1)
    for word in ("'wheel_separation' = 0.16", "'pursuer_half_axle' = 0.1"):
        assert word in str(caught.value)


@pytest.mark.parametrize("value", [-0.1, 0.0, float("nan"), float("inf"), True, "wide", "0.16", None, [0.16]])
def test_impossible_wheel_separation_is_refused_under_its_own_name(value):
    with pytest.raises(ScenarioError, match=r"'wheel_separation' = .*greater than 0"):
        load_scenario("paper", wheel_separation=value)


def test_only_a_certificate_takes_wheels_at_one_point():
    assert without_aliases({"wheel_separation": 0}, zero=True) == {"pursuer_half_axle": 0.0}
    with pytest.raises(ScenarioError, match="0 or more"):
        without_aliases({"wheel_separation": -1}, zero=True)


@pytest.mark.parametrize(
    "name, meant",
    [
        ("wheel_seperation", "did you mean 'wheel_separation'"),
        ("track_width", "'wheel_separation'"),
        ("wheelbase", "'wheel_separation'"),
        ("max_speed", "'evader_speed' .* or 'pursuer_speed'"),
        ("max_linear_velocity", "'evader_speed' .* or 'pursuer_speed'"),
        ("max_angular_velocity", "'pursuer_speed' / 'pursuer_half_axle'"),
        ("robot_radius", "'capture_distance'"),
        ("Robot-Radius", "'capture_distance'"),
        ("dt", "'control_period'"),
        ("delay", "--delay"),
        ("goal_tolerance", "'reach_distance'"),
        ("evader_sped", "did you mean 'evader_speed'"),
    ],
)
def test_word_of_a_data_sheet_is_answered_with_what_it_means_not_with_how_it_is_spelled(name, meant):
    with pytest.raises(ScenarioError, match=f"unknown scenario field '{name}'.*{meant}.*Known fields: "):
        load_scenario("paper", **{name: 1.0})


def test_what_has_no_likeness_is_answered_with_the_known_fields_alone():
    with pytest.raises(ScenarioError, match=r"unknown scenario field 'zzz'\. Known fields: action, "):
        load_scenario("paper", zzz=1)
