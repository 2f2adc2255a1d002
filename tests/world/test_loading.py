"""Loading: is a scenario that cannot be run refused with a message that says what to mend?"""

import json
import re
from dataclasses import fields

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from sidestep.world import PRESETS, Scenario, ScenarioError, load_scenario, scenario_to_dict

POSITIVE = [
    "evader_speed", "pursuer_speed", "pursuer_half_axle", "capture_distance", "collision_distance",
    "reach_distance", "control_period", "arena_side",
]  # fmt: skip
NOT_NEGATIVE = [
    "pursuer_gain", "obstacle_gain", "reach_reward", "distance_cost", "initial_separation",
    "obstacle_separation", "target_separation",
]  # fmt: skip
COUNTS = ["pursuer_count", "obstacle_count", "episode_steps"]
CHOICES = ["action", "obstacle_directions", "obstacle_motion", "frame", "observation"]
ARRAYS = ["obstacle_velocity", "evader_start", "target_start", "pursuer_starts", "obstacle_starts"]


def refused(*mentions, **overrides):
    """Checks that the overrides are refused with a message naming the field and every mention."""
    with pytest.raises(ScenarioError) as caught:
        load_scenario("paper", **overrides)
    for mention in (*overrides, *mentions):
        assert str(mention) in str(caught.value)


def test_every_field_is_covered_here():
    assert {field.name for field in fields(Scenario)} == {
        *POSITIVE, *NOT_NEGATIVE, *COUNTS, *CHOICES, *ARRAYS, "name", "evader_model", "pursuer_model",
    }  # fmt: skip


@pytest.mark.parametrize("field", POSITIVE)
@pytest.mark.parametrize(
    "value", [0.0, -1.0, float("nan"), float("inf"), "fast", True, None, [1.0, 2.0], 1e60, 1e-60]
)
def test_constant_that_must_be_positive(field, value):
    refused(repr(value), "greater than 0", **{field: value})


@pytest.mark.parametrize("field", NOT_NEGATIVE)
@pytest.mark.parametrize("value", [-1e-9, float("nan"), float("inf"), "wide", False, None, 1e60])
def test_constant_that_must_not_be_negative(field, value):
    refused(repr(value), "0 or more", **{field: value})


@pytest.mark.parametrize("field", COUNTS)
@pytest.mark.parametrize("value", [-1, 1.5, 2.0, "two", True, None, float("nan")])
def test_count_that_is_no_count(field, value):
    refused(repr(value), "whole number", **{field: value})


@pytest.mark.parametrize("field", ["pursuer_count", "episode_steps"])
def test_count_of_zero_where_one_is_needed(field):
    refused("at least 1", **{field: 0})


@pytest.mark.parametrize("field", CHOICES)
@pytest.mark.parametrize("value", ["sideways", 1, None, ["velocity"]])
def test_unknown_mode_lists_the_known_ones(field, value):
    known = {
        "action": "'heading'",
        "obstacle_directions": "'random'",
        "obstacle_motion": "'adversarial'",
        "frame": "'world'",
        "observation": "'motion'",
    }[field]
    refused(repr(value), known, **{field: value})


@pytest.mark.parametrize("field", ARRAYS)
@pytest.mark.parametrize(
    "value",
    [[float("nan")] * 2, [[1.0, float("inf"), 0.0]], "here", 3.0, [[[1.0]]], [1, 2, 3, 4], [[1], [2, 3]]],
)
def test_position_that_is_none(field, value):
    refused("finite numbers", **{field: value})


def test_name_must_be_text():
    refused("text", name=3)


def test_unknown_field_suggests_the_one_meant():
    with pytest.raises(
        ScenarioError, match="unknown scenario field 'evader_sped'; did you mean 'evader_speed'"
    ):
        load_scenario("paper", evader_sped=0.1)
    with pytest.raises(ScenarioError, match="Known fields: action, arena_side"):
        load_scenario("paper", zzz=1)


def test_every_error_is_a_value_error():
    assert issubclass(ScenarioError, ValueError)


def test_unknown_scenario_lists_the_presets():
    with pytest.raises(
        ScenarioError,
        match=r"no scenario 'papr': neither a preset \(paper, paper-test, paper-0\.10, paper-0\.15, "
        r"quadrotor, quadrotor-test\) nor",
    ):
        load_scenario("papr")


def test_target_or_start_inside_an_obstacle():
    with pytest.raises(
        ScenarioError, match=r"'target_start' = .*0.1 m from the obstacle at .*collision distance 0.2 m"
    ):
        load_scenario("paper-test", target_start=(1.6, 0.0))
    with pytest.raises(ScenarioError, match=r"'evader_start' = .*obstacle"):
        load_scenario("paper-test", evader_start=(1.5, 0.1))
    with pytest.raises(ScenarioError, match=r"'target_start'"):
        load_scenario(
            "paper", obstacle_count=2, obstacle_starts=[(0.0, 1.0), (1.0, 0.0)], target_start=(1.0, 0.1)
        )


def test_start_already_captured():
    with pytest.raises(ScenarioError, match=r"'evader_start' = .*already captured by the pursuer at"):
        load_scenario("paper-test", evader_start=(1.0, -0.4))
    # Ahead of the pursuer the capture set reaches 0.254 m, beyond the capture distance.
    with pytest.raises(ScenarioError, match="already captured"):
        load_scenario("paper-test", evader_start=(1.25, -0.5))
    assert load_scenario("paper-test", evader_start=(1.0, -0.25)).evader_start is not None


def test_target_already_reached():
    with pytest.raises(ScenarioError, match="reached already"):
        load_scenario("paper-test", target_start=(0.03, 0.0))


def test_square_too_small_for_its_separations():
    with pytest.raises(ScenarioError, match=r"no start satisfies.*'arena_side' = 0.3 m is too small.*0.6 m"):
        load_scenario("paper", arena_side=0.3)


def test_more_robots_than_fixed_starts():
    with pytest.raises(ScenarioError, match="'obstacle_count' = 2: only 1 fixed starts"):
        load_scenario("paper-test", obstacle_count=2)
    with pytest.raises(ScenarioError, match="'pursuer_count' = 3: only 1 fixed starts"):
        load_scenario("paper-test", pursuer_count=3)


def test_fewer_robots_than_fixed_starts_keeps_the_first():
    scenario = load_scenario("paper-test", obstacle_count=0)
    assert scenario.reset(jax.random.key(0)).obstacles.shape == (0, 4)
    scenario = load_scenario("paper", obstacle_starts=[[1.0, 1.0], [-1.0, -1.0]])
    assert scenario.obstacle_count == 2
    scenario = load_scenario("paper", obstacle_starts=[[1.0, 1.0], [-1.0, -1.0]], obstacle_count=1)
    np.testing.assert_allclose(scenario.obstacle_starts, [[1.0, 1.0]])
    scenario = load_scenario("paper", obstacle_starts=[])
    assert scenario.obstacle_count == 0


def test_presets_hold_the_papers_numbers(precision):
    for name in ("paper", "paper-test"):
        scenario = load_scenario(name)
        assert scenario.name == name
        values = scenario_to_dict(scenario)
        assert {
            "evader_speed": 0.1574, "pursuer_speed": 0.2, "capture_distance": 0.2, "collision_distance": 0.2,
            "reach_distance": 0.05, "obstacle_velocity": [0.02, 0.0], "pursuer_gain": 1.2,
            "obstacle_gain": 1.0, "reach_reward": 1000.0, "distance_cost": 0.01, "episode_steps": 5000,
            "pursuer_half_axle": 0.2, "control_period": 0.05, "pursuer_count": 1, "obstacle_count": 1,
            "action": "velocity",
        }.items() <= values.items()  # fmt: skip


CHANGED = {
    "evader_speed": 0.16,
    "action": "heading",
    "frame": "world",
    "observation": "motion",
    "obstacle_directions": "random",
    "obstacle_motion": "adversarial",
    "episode_steps": 77,
    "obstacle_starts": [[0.7, 0.1], [-0.7, 0.3]],
    "evader_start": [0.1, 0.2],
}


def assert_same(one, two):
    assert jax.tree.structure(one) == jax.tree.structure(two)
    for a, b in zip(jax.tree.leaves(one), jax.tree.leaves(two), strict=True):
        assert np.asarray(a).dtype == np.asarray(b).dtype
        np.testing.assert_array_equal(a, b)


@pytest.mark.parametrize("preset", PRESETS)
def test_plain_values_rebuild_the_same_scenario(preset, precision):
    changed = {**CHANGED, "control_period": 1 / 3}
    for overrides in ({}, changed):
        scenario = load_scenario(preset, **overrides)
        values = json.loads(json.dumps(scenario_to_dict(scenario)))
        assert set(values) == {field.name for field in fields(Scenario)}
        assert_same(load_scenario("paper", **values), scenario)


def test_plain_values_are_the_decimals_that_were_given():
    values = scenario_to_dict(load_scenario("paper"))
    assert values["evader_speed"] == 0.1574
    assert values["control_period"] == 0.05
    assert values["evader_start"] is None


def test_files_give_the_scenario_they_hold(tmp_path):
    toml = tmp_path / "narrow.toml"
    toml.write_text(
        'preset = "paper-test"\nevader_speed = 0.16\naction = "heading"\n'
        "pursuer_starts = [[1.0, -0.6, 0.5]]\n",
        encoding="utf-8",
    )
    scenario = load_scenario(toml)
    assert scenario.name == "narrow"
    assert scenario_to_dict(scenario)["target_start"] == [2.5, 0.0]
    assert scenario_to_dict(scenario)["pursuer_starts"] == [[1.0, -0.6, 0.5]]
    assert scenario_to_dict(load_scenario(str(toml), evader_speed=0.17))["evader_speed"] == 0.17

    plain = tmp_path / "any.json"
    plain.write_text(json.dumps(scenario_to_dict(scenario)), encoding="utf-8")
    assert_same(load_scenario(plain), scenario)

    run = tmp_path / "config.json"
    run.write_text(json.dumps({"scenario": scenario_to_dict(scenario), "seed": 1}), encoding="utf-8")
    assert_same(load_scenario(run), scenario)


@pytest.mark.parametrize(
    "name, content, message",
    [
        ("broken.json", "{", "cannot be read"),
        ("broken.toml", "speed = ", "cannot be read"),
        ("list.json", "[1, 2]", "must hold fields and their values, not a list"),
        ("preset.toml", 'preset = "papr"', "'preset' = 'papr'"),
        ("preset.json", '{"preset": ["paper"]}', "'preset'"),
        ("field.toml", "evader_velocity = 0.1", "unknown scenario field 'evader_velocity'"),
        ("value.toml", "evader_speed = -0.1", "'evader_speed' = -0.1"),
    ],
)
def test_file_that_cannot_be_used_says_why(tmp_path, name, content, message):
    path = tmp_path / name
    path.write_text(content, encoding="utf-8")
    with pytest.raises(ScenarioError, match=re.escape(message)):
        load_scenario(path)


def test_file_that_is_no_text(tmp_path):
    path = tmp_path / "scenario.toml"
    path.write_bytes(b"\xff\xfe\x00")
    with pytest.raises(ScenarioError, match="cannot be read"):
        load_scenario(path)


def test_numpy_and_jax_numbers_are_accepted():
    scenario = load_scenario(
        "paper",
        evader_speed=np.float64(0.16),
        pursuer_speed=jnp.asarray(0.21),
        pursuer_count=np.int64(1),
        evader_start=np.array([0.0, 0.0]),
    )
    assert type(scenario.pursuer_count) is int
    np.testing.assert_allclose([scenario.evader_speed, scenario.pursuer_speed], [0.16, 0.21], rtol=1e-6)


def test_another_value_does_not_recompile():
    @eqx.filter_jit
    @eqx.debug.assert_max_traces(max_traces=1)
    def period(scenario, world):
        return scenario.step(world, jnp.array([0.1, 0.0]), jnp.array([0.2, 0.1]))

    world = Scenario().reset(jax.random.key(0))
    names = [*POSITIVE, *NOT_NEGATIVE]
    for scale in (1.0, 1.1):
        values = {name: float(getattr(Scenario(), name)) * scale for name in names}
        period(load_scenario("paper", obstacle_velocity=(0.01 * scale, 0.0), **values), world)
