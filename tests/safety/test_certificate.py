"""What the certificate says, and that it says so in every special case."""

import json
import math
from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from sidestep.cli import main
from sidestep.safety import make_shield
from sidestep.safety.certificate import certify
from sidestep.safety.certificate.nearest_changes import PARAMETERS
from sidestep.safety.certificate.shield_check import shield_level
from sidestep.safety.certificate.survival import certain_run
from sidestep.safety.sampled.flow_map import seen_from, side_value, turn_drive_turn
from sidestep.safety.sampled.sampled_design import FINE, delay_cost, holds
from sidestep.safety.sampled.sampled_game import SampledGame
from sidestep.world import World, load_scenario


@pytest.fixture(scope="module")
def paper():
    return certify(load_scenario("paper"), start=(0.3, 0.1), check_shield=False)


def test_the_papers_setting_is_not_guaranteed_at_20_hz_but_a_little_less_is(paper):
    assert not paper.guaranteed
    assert not paper.pursuer_wins
    np.testing.assert_allclose(paper.largest_capture_distance, 0.2007832, atol=1e-7)
    assert 0.1982 < paper.guaranteed_clearance < 0.1984
    np.testing.assert_allclose(paper.margin, paper.guaranteed_clearance - 0.2, atol=1e-12)
    np.testing.assert_allclose(
        paper.budget["sampling"], paper.largest_capture_distance - paper.guaranteed_clearance
    )
    assert 0.0 < paper.grid_error < 1e-4


def test_each_nearest_change_makes_it_hold_and_less_of_it_does_not(paper):
    game, wanted = paper.situation.game, 0.2
    names = {"pursuer_half_axle": "half_axle"}
    needed = {change.parameter: change.needed for change in paper.nearest_changes}
    assert set(needed) == set(PARAMETERS)
    assert needed["position_error"] is needed["heading_error"] is needed["delay"] is None
    assert 0.0 <= paper.guaranteed_clearance - needed["capture_distance"] < 1e-6
    assert 0.015 < needed["control_period"] < 0.017
    for parameter in ("evader_speed", "pursuer_half_axle", "control_period"):
        name = names.get(parameter, parameter)
        now, value = getattr(game, name), needed[parameter]
        assert holds(replace(game, **{name: value}), wanted)
        assert not holds(replace(game, **{name: now + 0.95 * (value - now)}), wanted, FINE)


def test_errors_and_delay_are_budgeted_and_leave_a_certified_start():
    scenario = load_scenario("paper", capture_distance=0.17)
    found = certify(
        scenario, position_error=3e-3, heading_error=0.01, delay=0.03, start=(0.0, 0.2), check_shield=False
    )
    assert found.guaranteed
    budget = found.budget
    np.testing.assert_allclose(budget["position"], 3e-3)
    np.testing.assert_allclose(budget["heading"], 0.2 * 0.787 * 0.01)
    np.testing.assert_allclose(budget["delay"], 0.1574 * 0.03, rtol=1e-6)
    parts = [budget[name] for name in ("position", "heading", "delay", "sampling", "tracking", "sides")]
    np.testing.assert_allclose(budget["total"], sum(parts))
    np.testing.assert_allclose(budget["required"], 0.17 + budget["total"])
    assert budget["required"] <= found.largest_capture_distance
    assert found.margin <= found.largest_capture_distance - budget["required"] + 1e-12
    # A start outside K(l') is outside the set that the law keeps out of, whatever the errors.
    assert found.control_set.level <= found.start_set.level < budget["required"]
    np.testing.assert_allclose(found.start_margin, 0.2 - 3e-3 - found.control_set.level)


def test_own_motion_that_is_not_added_costs_as_an_error_of_position():
    kind = SampledGame(0.1574, 0.2, 0.2, 0.05, delay=0.02)
    blind = replace(kind, own_motion_predicted=False)
    moved = replace(kind, position_error=0.1574 * 0.02)
    assert kind.offset_error == 0.0
    assert blind.offset_error == pytest.approx(moved.offset_error)
    level = 0.19
    assert holds(kind, level) and not holds(blind, level)  # noqa: PT018
    assert delay_cost(kind) == pytest.approx(0.1574 * 0.02)


@pytest.mark.parametrize(
    "options, fields, word",
    [({"walls": True}, {}, "walls"), ({}, {"pursuer_count": 2}, "2 pursuers")],
)
def test_nothing_is_guaranteed_inside_walls_or_against_several(options, fields, word):
    scenario = load_scenario("paper", capture_distance=0.1, **fields)
    found = certify(scenario, check_shield=False, **options)
    assert not found.guaranteed
    assert found.guaranteed_clearance == 0.0
    assert found.control_set is None
    assert word in found.reason
    assert all(change.needed is None for change in found.nearest_changes)
    assert any(claim.kind == "not claimed" and word in claim.text for claim in found.claims)


@pytest.mark.slow
def test_where_the_pursuer_wins_time_and_targets_are_answered():
    scenario = load_scenario("paper", pursuer_speed=0.25)
    found = certify(scenario, check_shield=False, start=(0.6, 0.0), target_distance=0.1)
    assert found.pursuer_wins
    assert not found.guaranteed
    # Head on, the run ends when the two have closed the gap.
    run = 0.1574 * 0.4 / (0.1574 + 0.25)
    assert 0.98 * run <= found.survival.certain_run <= run
    assert 4.0 < found.survival.shortest == found.survival.longest < 6.0
    assert found.target == "certain"
    assert found.survival.target(10.0, 0.1574) == "out of reach"
    assert found.survival.target(0.5, 0.1574) == "open"


@pytest.mark.parametrize("direction", [0.0, 1.0, np.pi])
def test_no_pursuer_catches_an_evader_on_its_certain_run(direction):
    game = SampledGame(0.1574, 0.25, 0.2, 0.05)
    start = np.array([0.5, 0.1])
    run = certain_run(game, 0.2, start, direction)
    assert run > 0.05
    for time in np.linspace(0.0, run / 0.1574, 40):
        evader = start + 0.1574 * time * np.array([np.cos(direction), np.sin(direction)])
        poses = turn_drive_turn(time, 0.25, 0.2, 30)
        assert np.min(np.hypot(*(evader - poses[:, :2]).T)) > 0.2


def test_a_pursuer_that_turns_at_no_cost_always_wins_if_it_is_faster():
    scenario = load_scenario("paper")
    found = certify(scenario, half_axle=0.0, check_shield=False)
    assert found.pursuer_wins
    assert found.guaranteed_clearance == found.largest_capture_distance == 0.0
    np.testing.assert_allclose(found.survival.shortest, 0.4 / (0.2 - 0.1574), rtol=1e-5)
    changes = {change.parameter: change.needed for change in found.nearest_changes}
    assert changes["control_period"] is changes["capture_distance"] is None
    np.testing.assert_allclose(changes["evader_speed"], 0.2, rtol=1e-4)
    faster = load_scenario("paper", evader_speed=0.21)
    assert certify(faster, half_axle=0.0).guaranteed


def test_an_evader_that_is_faster_keeps_any_distance_unless_errors_turn_it():
    scenario = load_scenario("paper", evader_speed=0.21)
    found = certify(scenario, heading_error=0.05, delay=0.2, check_shield=False)
    assert found.guaranteed
    assert math.isinf(found.guaranteed_clearance)
    assert found.to_dict()["unlimited"]
    astray = certify(scenario, heading_error=0.5, check_shield=False)
    assert not astray.guaranteed
    needed = {change.parameter: change.needed for change in astray.nearest_changes}
    assert 0.0 < needed["heading_error"] < 0.5
    assert needed["delay"] is None


def test_a_period_of_zero_is_continuous_time():
    scenario = load_scenario("paper", capture_distance=0.2007)
    assert certify(scenario, control_period=0.0, check_shield=False).guaranteed


def test_obstacles_are_proved_alone_and_never_together_with_the_pursuer(paper):
    kinds = {claim.kind: claim.text for claim in paper.claims if "obstacle" in claim.text}
    assert set(kinds) == {"proved", "not claimed"}
    assert "together" in kinds["not claimed"]
    fast = load_scenario("paper", obstacle_velocity=[0.3, 0.0], evader_speed=0.21)
    claims = certify(fast, check_shield=False).claims
    assert not any(claim.kind == "proved" and "obstacle" in claim.text for claim in claims)
    assert {claim.kind for claim in paper.claims} <= {"proved", "computed", "measured", "not claimed"}


@pytest.mark.parametrize(
    "options, named",
    [
        ({"position_error": -1.0}, "position_error"),
        ({"heading_error": 2.0}, "heading_error"),
        ({"delay": math.nan}, "delay"),
        ({"target_distance": math.inf}, "target_distance"),
        ({"half_axle": -0.1}, "half_axle"),
        ({"start": (math.nan, 0.0)}, "start"),
    ],
)
def test_bad_input_is_named(options, named):
    with pytest.raises(ValueError, match=named):
        certify(load_scenario("paper"), **options)


def test_the_game_shield_itself_keeps_the_level_computed_for_it():
    """The shipped shield, with a policy that wants something new every period, against greedy pursuers."""
    scenario = load_scenario("paper", capture_distance=0.19, obstacle_count=0)
    found = shield_level(scenario)
    assert 0.18 < found.level < 0.19
    shield, angle, period = make_shield("game", scenario), float(scenario.usable_angle), 0.05
    count, rng = 64, np.random.default_rng(0)

    @jax.jit
    @jax.vmap
    def act(z, memory, nominal):
        world = World(z, jnp.zeros((1, 3)), jnp.zeros((0, 4)), jnp.zeros(2))
        result, memory = shield(world, nominal, memory)
        return result.action, memory

    z = np.stack([0.19 / np.cos(angle) + 0.002 * rng.random(count), 0.01 * rng.normal(size=count)], -1)
    memory = np.ones((count, 1))
    poses = turn_drive_turn(period, 0.2, 0.2, 9)
    least = np.inf
    for _ in range(150):
        nominal = 0.3 * rng.normal(size=(count, 2))
        action, memory = act(*(jnp.asarray(value, float) for value in (z, memory, nominal)))
        after = seen_from((z + period * np.asarray(action, float))[:, None], poses[None])
        value = np.maximum(side_value(after, angle, 1.0), side_value(after, angle, -1.0))
        z = after[np.arange(count), np.argmin(value, axis=1)]
        least = min(least, float(np.min(value)))
    assert least >= found.level - found.error


def test_command_line_answers_in_json_and_exit_status(tmp_path, capsys):
    path = tmp_path / "deep" / "certificate.json"
    quick = ["certify", "--no-shield", "--set", "evader_speed=0.21"]
    assert main([*quick, "--start", "0.5,0.1", "--json", str(path), "--strict"]) == 0
    figures = json.loads(path.read_text())
    assert figures["guaranteed"] is True
    assert figures["guaranteed_clearance"] is None
    assert figures["unlimited"] is True
    assert figures["start_margin"] > 0.0
    assert set(figures) >= {"budget", "margin", "nearest_changes", "grid_error", "claims", "situation"}
    assert "GUARANTEED" in capsys.readouterr().out
    walls = ["certify", "--no-shield", "--walls", "--set", "evader_speed=0.21"]
    assert main(walls) == 0
    assert "NOT GUARANTEED" in capsys.readouterr().out
    assert main([*walls, "--strict"]) == 1
    assert main(["certify", "--no-shield", "--set", "pursuer_half_axle=0", "evader_speed=0.21"]) == 0


@pytest.mark.parametrize(
    "arguments, named",
    [
        (["--start", "1;2"], "start"),
        (["--delay", "-1"], "delay"),
        (["--set", "pursuer_half_axle=-1"], "pursuer_half_axle"),
        (["--set", "evader_sped=1"], "evader_speed"),
        (["--scenario", "nowhere"], "nowhere"),
    ],
)
def test_command_line_names_bad_input_and_writes_nothing(arguments, named, tmp_path, capsys):
    path = tmp_path / "certificate.json"
    assert main(["certify", *arguments, "--json", str(path)]) == 2
    assert named in capsys.readouterr().err
    assert not path.exists()
