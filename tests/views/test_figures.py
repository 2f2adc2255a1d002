"""Hazards of figures: blank or huge files, crashes on short or odd runs, lines nobody can tell apart."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import matplotlib
import numpy as np
import pytest
from PIL import Image

from sidestep.trials import wilson_interval
from sidestep.views import (
    capture_figure,
    outcome_figure,
    reward_figure,
    safety_rows,
    safety_table,
    scenes_figure,
    style,
    time_figure,
    trajectory_figure,
)
from sidestep.views.scene import capture_set_outline, mark_periods
from sidestep.world import Scenario
from sidestep.world.capture_geometry import capture_set_distance

PAPER = Scenario()
SHIELDS = ("none", "paper", "game", "joint")


def assert_fine(written):
    """A PNG that shows something and is small enough, and a PDF."""
    png, pdf = written
    assert png.stat().st_size < 300_000
    pixels = np.asarray(Image.open(png).convert("L"))
    assert min(pixels.shape) > 200
    assert 0.005 < np.mean(pixels < 200) < 0.6
    assert pdf.read_bytes().startswith(b"%PDF")


@pytest.mark.parametrize("count", [0, 1, 19, 20, 200])
def test_reward_figure_of_a_run_of_any_length(tmp_path, count, run_of):
    mixed = [("captured", "collided", "reached", "timed_out")[i % 4] for i in range(count)]
    assert_fine(reward_figure([run_of(outcomes=mixed)], tmp_path / "reward"))


def test_reward_figure_of_many_seeds_of_different_length(tmp_path, run_of):
    runs = [
        run_of(shield, ("reached",) * (25 + 10 * seed), seed)
        for shield in ("none", "paper", "game", "ours")
        for seed in range(3)
    ]
    assert_fine(reward_figure(runs, tmp_path / "reward.png"))


@pytest.mark.parametrize("count", [0, 1, 19, 60])
@pytest.mark.parametrize("seeds", [1, 3])
def test_time_figure_of_runs_of_any_length(tmp_path, count, seeds, run_of):
    outcomes = ("reached", "captured", "timed_out") * count
    assert_fine(time_figure([run_of("none", outcomes, seed) for seed in range(seeds)], tmp_path / "t"))


def test_time_figure_counts_every_episode_that_did_not_arrive_as_the_limit(run_of, drawn):
    outcomes = ("reached", "captured", "collided", "timed_out") * 10
    metrics = [{**line, "straight_time": 4.0} for line in run_of(outcomes=outcomes).metrics]
    old = run_of("none")
    run = replace(
        run_of(outcomes=outcomes), metrics=metrics, evaluation={"time_mean": 7.0},
        untrained_evaluation={"time_mean": 9.0},
    )  # fmt: skip
    lines = drawn(lambda path: time_figure([old, run], path)).axes[0].get_lines()
    curves = {line.get_label(): np.asarray(line.get_ydata()) for line in lines}
    assert curves["game shield"][-1] == pytest.approx((5.0 + 3 * 250.0) / 4)
    # The other run was recorded by a version without these times.
    assert curves["straight there, alone"][-1] == pytest.approx(4.0)
    assert len(curves["straight there, alone"]) == len(outcomes)
    marks = [
        (float(line.get_ydata()[0]), line.get_markerfacecolor())
        for line in lines
        if len(line.get_ydata()) == 1
    ]
    assert marks == [(7.0, style.shield_colour("game")), (9.0, "white")]


def test_same_data_give_the_same_files(tmp_path, run_of):
    first = reward_figure([run_of()], tmp_path / "a")
    second = reward_figure([run_of()], tmp_path / "b")
    assert [path.read_bytes() for path in first] == [path.read_bytes() for path in second]


def test_users_own_matplotlib_settings_are_left_alone_and_ignored(tmp_path, run_of):
    plain = reward_figure([run_of()], tmp_path / "plain")
    with matplotlib.rc_context({"font.size": 31.0, "axes.facecolor": "red"}):
        before = dict(matplotlib.rcParams)
        styled = reward_figure([run_of()], tmp_path / "styled")
        assert dict(matplotlib.rcParams) == before
    assert plain[0].read_bytes() == styled[0].read_bytes()


def test_outcomes_and_shields_differ_in_shape_as_well_as_in_colour():
    assert len(set(style.OUTCOME_MARKERS.values())) == len(set(style.OUTCOME_COLOURS.values())) == 4
    assert len({style.shield_colour(name) for name in SHIELDS}) == len(SHIELDS)
    assert len({str(style.shield_dashes(name)) for name in SHIELDS}) == len(SHIELDS)


def test_each_shield_keeps_its_colour_whichever_others_are_shown(run_of, drawn):
    for shields in (("joint", "none", "game", "paper"), ("joint",), ("game", "joint")):
        runs = [run_of(shield) for shield in shields]
        figure = drawn(lambda path, runs=runs: reward_figure(runs, path))
        lines = {line.get_label(): line for line in figure.axes[0].get_lines()}
        for shield in shields:
            assert lines[style.shield_words(shield)].get_color() == style.shield_colour(shield)


def test_safety_table_counts_what_the_metrics_say(tmp_path, run_of):
    runs = [
        run_of("paper", ["captured"] * 3 + ["collided"] + ["reached"] * 6, seed=0),
        run_of("paper", ["timed_out"] * 10, seed=1),
        run_of("game", []),
    ]
    paper_reports, paper_shield, game = safety_rows(runs)
    assert paper_reports["safe"] == paper_reports["episodes"] == 200
    assert paper_reports["low"] < 0.99
    counts = [paper_shield[name] for name in ("episodes", "safe", "captured", "collided")]
    assert counts == [20, 16, 3, 1]
    assert (paper_shield["low"], paper_shield["high"]) == wilson_interval(16, 20)
    assert game["ratio"] is None
    assert_fine(safety_table(runs, tmp_path / "safety"))


def test_outcome_figure_shows_zero_and_all(tmp_path, drawn):
    evaluations = {}
    for shield, captured in (("none", 100), ("paper", 30), ("game", 0), ("joint", 0)):
        evaluations[shield] = report = {}
        counts = {"captured": captured, "collided": 0, "timed_out": 0, "reached": 100 - captured}
        for name, count in counts.items():
            low, high = wilson_interval(count, 100)
            report |= {
                name: count,
                f"{name}_rate": count / 100,
                f"{name}_rate_low": low,
                f"{name}_rate_high": high,
            }
    assert_fine(outcome_figure(evaluations, tmp_path / "outcomes"))
    untrained = {shield: evaluations[shield] for shield in ("game", "joint")}
    assert_fine(outcome_figure(evaluations, tmp_path / "both", untrained))
    figure = drawn(lambda path: outcome_figure(evaluations, path, untrained))
    faces = [line.get_markerfacecolor() for line in figure.axes[0].get_lines() if line.get_marker() == "o"]
    assert len(faces) == 6
    assert faces.count("white") == 2


@pytest.mark.parametrize("shield", ["", "paper", "joint"])
def test_trajectory_figure(tmp_path, shield, chase):
    assert_fine(trajectory_figure(PAPER, chase(), tmp_path / "scene", shield=shield))


@pytest.mark.parametrize("obstacles, pursuers, steps", [(0, 1, 400), (3, 2, 400), (1, 1, 1)])
def test_trajectory_figure_of_any_company_and_length(tmp_path, obstacles, pursuers, steps, chase):
    trajectory = chase(obstacles=obstacles, pursuers=pursuers, steps=steps)
    assert_fine(trajectory_figure(PAPER, trajectory, tmp_path / "scene", moment=1e9))


def test_trace_shows_every_status_with_its_share(chase, drawn):
    trajectory = chase(gap=0.5)
    status = np.zeros(trajectory.length, np.int32)
    status[10:15], status[30], status[-1:] = 1, 2, 3
    status[20:22] = 1
    trajectory = replace(trajectory, status=jnp.asarray(status))
    figure = drawn(lambda path: trajectory_figure(PAPER, trajectory, path))
    answers = figure.axes[-1]
    spans = [collection.get_paths() for collection in answers.collections]
    assert [len(paths) for paths in spans] == [4, 2, 1, 1]
    corrected = [path.get_extents() for path in spans[1]]
    assert np.allclose([(box.x0, box.x1) for box in corrected], [(0.5, 0.75), (1.0, 1.1)])
    words = [text.get_text() for text in answers.get_legend().get_texts()]
    assert words[1] == f"corrected, {700 / trajectory.length:.1f} %"
    assert len(words) == 4


@pytest.mark.parametrize("shield", ["none", "paper", "game", "joint"])
def test_level_sets_are_those_of_the_shields_own_barrier(chase, monkeypatch, shield, drawn):
    asked = []
    place = "sidestep.views.trajectory_figures.draw_barrier_levels"
    monkeypatch.setattr(place, lambda *_, pursuit: asked.append(pursuit))
    drawn(
        lambda path: trajectory_figure(PAPER, chase(steps=20), path, shield=shield),
    )
    assert asked == [shield in ("game", "joint")]


def test_trajectory_with_an_unknown_world_can_be_drawn(tmp_path, chase):
    trajectory = chase()
    unknown = replace(trajectory, barriers=trajectory.barriers.at[3].set(-jnp.inf))
    assert_fine(trajectory_figure(PAPER, unknown, tmp_path / "scene"))


@pytest.mark.parametrize("shields", [("joint",), ("none", "game"), SHIELDS], ids=len)
def test_scenes_figure(tmp_path, chase, shields):
    scenes = {shield: chase(steps=50 + 100 * i) for i, shield in enumerate(shields)}
    assert_fine(scenes_figure(PAPER, scenes, tmp_path / "scenes"))


@pytest.mark.parametrize("reverse", [False, True])
@pytest.mark.parametrize("gap", [0.002, 0.15])
def test_capture_figure(tmp_path, reverse, gap, chase):
    assert_fine(capture_figure(PAPER, chase(reverse=reverse, gap=gap), tmp_path / "capture"))


def test_capture_figure_of_no_capture_is_refused(tmp_path, chase):
    with pytest.raises(ValueError, match="not in a capture"):
        capture_figure(PAPER, chase(steps=5), tmp_path / "capture")
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("evader_speed", [0.05, 0.1574, 0.2, 0.3])
def test_drawn_capture_set_is_the_barriers_zero_level(evader_speed):
    scenario = Scenario(evader_speed=evader_speed)
    outline = jnp.asarray(capture_set_outline(scenario), dtype=float)
    h = jax.vmap(lambda z: capture_set_distance(z, scenario.usable_angle, scenario.capture_distance))(outline)
    assert np.allclose(h, 0.0, atol=1e-5)


@pytest.mark.parametrize("duration", [0.05, 0.9, 3.6, 39.3, 250.0, 5000.0])
def test_time_marks_are_few_and_inside_the_episode(duration):
    marks = mark_periods(duration, 0.05)
    assert len(marks) <= 17
    assert all(0 < mark <= round(duration / 0.05) for mark in marks)
