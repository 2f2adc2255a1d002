"""The command line: what it writes, what it refuses, and that a refusal touches nothing."""

import inspect
import json
import re
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from sidestep.cli import main
from sidestep.commands.common import parse_overrides
from sidestep.commands.falsify import Falsify
from sidestep.commands.reproduce import Reproduce
from sidestep.commands.train import Train
from sidestep.learning import train
from sidestep.safety.shields.catalogue import SHIELDS
from sidestep.trials import load_survey
from sidestep.trials.campaign import load_campaign, run_task
from sidestep.trials.campaign.jobs import figure_names, flat
from sidestep.trials.reproduction import COMPARED, reproduce

LEARNER = ["hidden=[8, 8]", "batch_size=8", "warmup_decisions=10", "replay_capacity=12"]
# The look-ahead of the default shield takes long to compile; what is tested here is the same under any.
SMALL = ["--shield", "game", "--episodes", "2", "--set", "episode_steps=60", "--learner", *LEARNER]

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
    "invalid_rate",
    "pursuer_invalid",
    "mean_correction",
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
    assert set(figures["yardsticks"]) == {"goal-seeking", "share_of_planner"}
    assert figures["yardsticks"]["goal-seeking"]["difference"]["low"] is not None
    assert figures["shield"] == "game"


def test_times_are_printed_beside_goal_seeking_and_the_planner(capsys, monkeypatch):
    monkeypatch.setenv("COLUMNS", "200")
    small = ["--set", "episode_steps=400", "--episodes", "10", "--batch", "10"]
    small += ["--shield", "game", "--pursuer", "interceptor"]
    assert main(["evaluate", "goal-seeking", "--planner", *small]) == 0
    words = " ".join(capsys.readouterr().out.split())
    assert "within 15 s" in words
    assert "within 30 s" not in words
    assert "An episode that does not reach the target counts 20 s." in words
    assert "Mean difference to planner, start by start: +" in words
    assert main(["evaluate", "planner", *small]) == 0
    assert "Mean difference to goal-seeking, start by start: -" in " ".join(capsys.readouterr().out.split())


def test_untrained_policy_is_evaluated_under_the_joint_shield_by_default(tmp_path):
    path = tmp_path / "evaluation.json"
    # Without obstacles there is nothing to look ahead for, nor to compile.
    small = ["--set", "episode_steps=30", "obstacle_count=0", "--episodes", "2", "--batch", "2"]
    assert main(["evaluate", *small, "--json", str(path)]) == 0
    figures = json.loads(path.read_text())
    assert figures["shield"] == "joint"
    assert figures["timed_out"] == figures["episodes"] == 2
    # A job of a campaign is the command that it stands for.
    (tmp_path / "grid.toml").write_text(
        '[grid]\nscenario = "calm"\n[scenarios.calm]\nepisode_steps = 30\nobstacle_count = 0\n'
        "[settings]\nepisodes = 2\n"
    )
    (job,) = load_campaign(tmp_path / "grid.toml").jobs
    of_job = run_task(job.task, None)
    assert of_job == {name: figures[name] for name in of_job}


def test_resumed_run_is_the_longer_run(run, tmp_path):
    out, _ = run
    shutil.copytree(out, tmp_path / "run")
    assert main(["train", "--out", str(tmp_path / "run"), "--resume", "--episodes", "3"]) == 0
    summary = json.loads((tmp_path / "run" / "summary.json").read_text())
    assert (summary["episodes"], summary["seed"]) == (3, 5)
    longer, shorter = (folder / "metrics.jsonl" for folder in (tmp_path / "run", out))
    assert longer.read_bytes().startswith(shorter.read_bytes())
    assert len(longer.read_text().splitlines()) == 3


CHILD = """
import signal, sys
signal.signal(signal.SIGINT, signal.default_int_handler)  # A background shell has its children ignore it.
from sidestep.cli import main
sys.exit(main(sys.argv[1:]))
"""


def test_interrupt_stops_cleanly_and_the_run_goes_on_from_there(run, tmp_path):
    out = tmp_path / "run"
    arguments = ["train", "--out", str(out), "--seed", "5", *SMALL, "--episodes", "1500"]
    with subprocess.Popen(
        [sys.executable, "-c", CHILD, *arguments], stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True
    ) as child:
        while child.poll() is None and not (out / "metrics.jsonl").exists():
            time.sleep(0.005)
        child.send_signal(signal.SIGINT)
        try:
            shown = child.communicate(timeout=120.0)[0]
        except subprocess.TimeoutExpired:
            child.kill()
            raise
    assert child.returncode == 130, shown
    assert "Traceback" not in shown
    assert "--resume" in shown
    done = len((out / "metrics.jsonl").read_text().splitlines())
    assert 0 < done < 1500
    assert json.loads((out / "summary.json").read_text())["episodes"] == done
    assert main(["evaluate", str(out), "--episodes", "1"]) == 2
    assert main(["train", "--out", str(out), "--resume", "--episodes", "1500"]) == 0
    lines = (out / "metrics.jsonl").read_text().splitlines()
    assert [json.loads(line)["episode"] for line in lines] == list(range(1, 1501))
    # The first episodes are those of the run that was asked for two only.
    assert lines[:2] == (run[0] / "metrics.jsonl").read_text().splitlines()


def test_training_of_a_campaign_is_the_run_and_goes_on_where_it_was_left(run, tmp_path):
    out, _ = run
    file = tmp_path / "grid.toml"
    learner = "\n".join(pair.replace("=", " = ") for pair in LEARNER)
    file.write_text(
        'kind = "train"\n[grid]\nshield = "game"\nseed = 5\nscenario = "brief"\nlearner = "small"\n'
        f"[scenarios.brief]\nepisode_steps = 60\n[learners.small]\n{learner}\n"
        "[settings]\nepisodes = 2\nevaluation_episodes = 4\nbatch = 512\n"
    )
    (job,) = load_campaign(file).jobs
    # Trained already, and killed before its result was kept.
    folder = tmp_path / "job"
    shutil.copytree(out, folder)
    (folder / "policy.npz").unlink()
    figures = run_task(job.task, folder)
    assert set(figure_names("train")) == set(flat(figures))
    assert figures["training_episodes"] == 2
    assert figures["training_env_steps"] == json.loads((out / "summary.json").read_text())["env_steps"]
    assert figures["episodes"] == 4
    assert (folder / "metrics.jsonl").read_bytes() == (out / "metrics.jsonl").read_bytes()
    assert (folder / "policy.npz").is_file()


@pytest.mark.slow
def test_report_of_a_run_needs_no_network(run, monkeypatch):
    out, _ = run
    assert main(["report", str(out), "--episodes", "2"]) == 0
    page = (out / "report.html").read_text()
    assert 'src="http' not in page
    assert "data:image/png" in page
    # What the training left out was run, once, and kept.
    assert "The worst episodes" in page
    measured = (out / "episodes.npz").stat().st_mtime_ns
    survey = load_survey(out)
    assert survey is not None
    assert survey.evaluation.episodes == 2
    monkeypatch.setattr("sidestep.views.write_report", lambda *_, **__: out)
    assert main(["report", str(out), "--episodes", "3"]) == 0
    assert (out / "episodes.npz").stat().st_mtime_ns == measured


def test_report_counts_no_run_twice_and_writes_over_nothing_but_a_report(run, tmp_path, capsys):
    out, _ = run
    assert main(["report", str(out), str(out / ".." / out.name)]) == 2
    assert "given twice" in capsys.readouterr().err
    notes = tmp_path / "notes.html"
    notes.write_text("<title>mine</title>")
    assert main(["report", str(out), "--out", str(notes)]) == 2
    assert "give --out another name" in capsys.readouterr().err
    assert notes.read_text() == "<title>mine</title>"
    assert main(["report", str(out), "--out", str(tmp_path)]) == 2
    assert "is a folder" in capsys.readouterr().err
    (tmp_path / "config.json").write_text('{"study": ["none", "game"]}')
    assert main(["report", str(tmp_path)]) == 2
    assert "not begun to train" in capsys.readouterr().err


@pytest.mark.parametrize(
    "arguments, named",
    [
        (["train", "--out", "{out}", "--shield", "shiny"], "shiny"),
        (["train", "--out", "{out}", "--pursuer", "nobody"], "nobody"),
        (["train", "--out", "{out}", "--set", "evader_sped=1"], "evader_speed"),
        (["train", "--out", "{out}", "--set", "evader_speed"], "NAME=VALUE"),
        (["train", "--out", "{out}", "--set", "evader_speed=-1"], "greater than 0"),
        (["train", "--out", "{out}", "--learner", "discount=2"], "discount"),
        (["train", "--out", "{out}", "--learner", "batch_size=NaN"], "batch_size"),
        (["train", "--out", "{out}", "--learner", "decision_steps=Infinity"], "decision_steps"),
        (["train", "--out", "{out}", "--seed", "-1"], "seed"),
        (["train", "--out", "{out}", "--seed", "99999999999999999999"], "seed"),
        (["train", "--out", "{out}", "--episodes", "0"], "episodes"),
        (["train", "--out", "{out}", "--resume"], "does not exist; leave out --resume"),
        (["evaluate", "{out}"], "does not exist; name a run folder"),
        (["report", "{out}"], "no run"),
        (["report"], "at least one run"),
        (["report", "{out}", "--episodes", "-1"], "episodes"),
    ],
)
def test_bad_input_is_named_and_nothing_is_written(arguments, named, tmp_path, capsys):
    out = tmp_path / "run"
    assert main([argument.replace("{out}", str(out)) for argument in arguments]) == 2
    assert named in capsys.readouterr().err
    assert not out.exists()


@pytest.mark.parametrize(
    "command",
    [[], ["train"], ["evaluate"], ["reproduce"], ["certify"], ["falsify"], ["report"], ["campaign"]],
)
def test_help_of_every_command(command, capsys):
    with pytest.raises(SystemExit) as stop:
        main([*command, "--help"])
    assert stop.value.code == 0
    assert "sidestep" in capsys.readouterr().out


@pytest.mark.parametrize("command", ["train", "evaluate", "falsify"])
def test_help_says_which_shield_is_taken_unless_told_otherwise(command, capsys):
    with pytest.raises(SystemExit):
        main([command, "--help"])
    words = re.sub(r"[^\w:,;' ]+", " ", capsys.readouterr().out)
    assert re.search(r"default:\s+joint|joint,\s+by\s+default", words)


def test_every_command_takes_the_same_default_shield():
    assert Train(out=Path("x")).shield == Falsify().shield == "joint"
    assert inspect.signature(train).parameters["shield"].default == "joint"
    assert inspect.signature(reproduce).parameters["shields"].default == Reproduce().shields == COMPARED
    assert set(COMPARED) <= set(SHIELDS)


def test_overrides_are_numbers_lists_or_text():
    assert parse_overrides(("a=1", "b=[0, 1.5]", "c=heading", "d=true")) == {
        "a": 1, "b": [0, 1.5], "c": "heading", "d": True,
    }  # fmt: skip
