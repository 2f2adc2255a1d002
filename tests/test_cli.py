"""The command line: what it writes, what it refuses, and that a refusal touches nothing."""

import json

import pytest

from sidestep.cli import main, parse_overrides

SMALL = ["--episodes", "2", "--set", "episode_steps=60", "--learner", "hidden=[8, 8]", "batch_size=8"]

SUMMARY_KEYS = [
    "episodes",
    "safe_episodes",
    "captured",
    "collided",
    "reached",
    "timed_out",
    "env_steps",
    "wall_seconds",
    "converged_episode",
    "final_return",
    "min_pursuer_clearance",
    "min_obstacle_clearance",
    "intervention_rate",
    "infeasible_rate",
    "scenario",
    "shield",
    "pursuer",
    "seed",
    "version",
]


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    folder = tmp_path_factory.mktemp("runs")
    out = folder / "run"
    assert main(["train", "--out", str(out), "--json", str(folder / "s.json"), "--seed", "5", *SMALL]) == 0
    return out, json.loads((folder / "s.json").read_text())


def test_training_summary_has_every_promised_figure(run):
    out, summary = run
    assert set(SUMMARY_KEYS) <= set(summary)
    assert summary["episodes"] == 2
    assert summary["seed"] == 5
    assert json.loads((out / "summary.json").read_text()) == summary
    assert len((out / "metrics.jsonl").read_text().splitlines()) == 2
    assert list((out / "curves").glob("events.out.tfevents.*"))


def test_existing_run_is_never_overwritten(run, capsys):
    out, _ = run
    before = {path: path.read_bytes() for path in out.rglob("*") if path.is_file()}
    assert main(["train", "--out", str(out), *SMALL]) == 2
    assert "--resume" in capsys.readouterr().err
    assert {path: path.read_bytes() for path in out.rglob("*") if path.is_file()} == before


def test_evaluation_reports_counts_with_their_bounds(run, tmp_path):
    out, _ = run
    path = tmp_path / "deep" / "evaluation.json"
    assert main(["evaluate", str(out), "--episodes", "4", "--json", str(path)]) == 0
    figures = json.loads(path.read_text())
    assert sum(figures[name] for name in ("captured", "collided", "reached", "timed_out")) == 4
    for name in ("captured", "collided", "reached", "timed_out"):
        assert figures[f"{name}_rate_low"] <= figures[f"{name}_rate"] <= figures[f"{name}_rate_high"]
    assert "reach_time_median" in figures
    assert figures["shield"] == "game"


def test_report_of_a_run_needs_no_network(run):
    out, _ = run
    assert main(["report", str(out)]) == 0
    page = (out / "report.html").read_text()
    assert 'src="http' not in page
    assert "data:image/png" in page


@pytest.mark.parametrize(
    "arguments, named",
    [
        (["train", "--out", "{out}", "--shield", "shiny"], "shiny"),
        (["train", "--out", "{out}", "--pursuer", "nobody"], "nobody"),
        (["train", "--out", "{out}", "--set", "evader_sped=1"], "evader_speed"),
        (["train", "--out", "{out}", "--set", "evader_speed"], "NAME=VALUE"),
        (["train", "--out", "{out}", "--set", "evader_speed=-1"], "greater than 0"),
        (["train", "--out", "{out}", "--learner", "discount=2"], "discount"),
        (["train", "--out", "{out}", "--episodes", "0"], "episodes"),
        (["train", "--out", "{out}", "--resume"], "no run"),
        (["evaluate", "{out}"], "no run"),
        (["report", "{out}"], "no run"),
    ],
)
def test_bad_input_is_named_and_nothing_is_written(arguments, named, tmp_path, capsys):
    out = tmp_path / "run"
    assert main([argument.replace("{out}", str(out)) for argument in arguments]) == 2
    assert named in capsys.readouterr().err
    assert not out.exists()


@pytest.mark.parametrize("command", [[], ["train"], ["evaluate"], ["reproduce"], ["report"]])
def test_help_of_every_command(command, capsys):
    with pytest.raises(SystemExit) as stop:
        main([*command, "--help"])
    assert stop.value.code == 0
    assert "sidestep" in capsys.readouterr().out


def test_overrides_are_numbers_lists_or_text():
    assert parse_overrides(("a=1", "b=[0, 1.5]", "c=heading", "d=true")) == {
        "a": 1, "b": [0, 1.5], "c": "heading", "d": True,
    }  # fmt: skip
