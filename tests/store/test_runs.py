"""Hazards of the run folder: lost results, silent overwriting, files torn by a kill."""

import json
import os
import signal
import subprocess
import sys
import time

import numpy as np
import pytest

from sidestep.store.files import OutputError, json_safe, read_json, write_json
from sidestep.store.runs import (
    RunError,
    append_metrics,
    converged_episode,
    create_run,
    longest_convergence,
    moving_mean,
    open_run,
    read_metrics,
    read_summary,
    stays_converged_from,
    summarise,
    truncate_metrics,
    write_summary,
    writing,
)


def episode(number=1, outcome="reached", total=990.0, steps=100, **more):
    return {
        "episode": number,
        "outcome": outcome,
        "return": total,
        "steps": steps,
        "env_steps": number * steps,
        "min_pursuer_clearance": 0.3,
        "min_obstacle_clearance": None,
        "interventions": 10,
        "infeasible": 1,
        "invalid": 2,
        "pursuer_invalid": 3,
        "mean_correction": 0.01,
        **more,
    }


def test_existing_run_is_never_overwritten(tmp_path):
    run = create_run(tmp_path / "run", {"seed": 1})
    with pytest.raises(RunError, match=r"--resume.*--out"):
        create_run(run, {"seed": 2})
    assert open_run(run)["seed"] == 1
    (tmp_path / "other").mkdir()
    (tmp_path / "other" / "thesis.txt").write_text("years of work")
    with pytest.raises(RunError, match="--out"):
        create_run(tmp_path / "other", {})
    with pytest.raises(RunError, match="is a file"):
        create_run(tmp_path / "other" / "thesis.txt", {})


def test_empty_folder_may_be_used(tmp_path):
    assert open_run(create_run(tmp_path, {"seed": 3})) == {"seed": 3}
    assert (tmp_path / "checkpoints").is_dir()
    assert (tmp_path / "figures").is_dir()


def test_resuming_where_no_run_is_says_so(tmp_path):
    with pytest.raises(RunError, match="holds no run"):
        open_run(tmp_path)
    with pytest.raises(RunError, match="does not exist"):
        read_summary(tmp_path)


def test_failed_write_keeps_the_old_file(tmp_path, monkeypatch):
    path = tmp_path / "summary.json"
    write_json(path, {"value": 1})

    def fail(*_):
        raise OSError("disk full")

    monkeypatch.setattr(os, "fsync", fail)
    with pytest.raises(OutputError, match="could not be written: disk full"):
        write_json(path, {"value": 2})
    monkeypatch.undo()
    assert read_json(path) == {"value": 1}
    assert [file.name for file in tmp_path.iterdir()] == ["summary.json"]


def test_kill_in_the_middle_of_writing_leaves_a_whole_file(tmp_path):
    path = tmp_path / "state.json"
    write_json(path, {"round": 0, "payload": []})
    code = (
        "import sys; from sidestep.store.files import write_json\n"
        "i = 0\n"
        "while True:\n"
        "    i += 1; write_json(sys.argv[1], {'round': i, 'payload': [i] * 200_000})\n"
    )
    for pause in (0.0, 0.013, 0.029):
        child = subprocess.Popen(
            [sys.executable, "-c", code, str(path)], env={**os.environ, "JAX_PLATFORMS": "cpu"}
        )
        before = read_json(path)["round"]
        deadline = time.monotonic() + 60.0
        while read_json(path)["round"] == before and time.monotonic() < deadline:
            time.sleep(0.01)
        time.sleep(pause)
        child.send_signal(signal.SIGKILL)
        child.wait()
        content = read_json(path)
        assert content["round"] >= 1
        assert set(content["payload"]) == {content["round"]}


def test_metrics_line_cut_by_a_kill_is_dropped_and_not_glued_to_the_next(tmp_path):
    append_metrics(tmp_path, [episode(1), episode(2)])
    with open(tmp_path / "metrics.jsonl", "ab") as file:
        file.write(b'{"episode": 3, "outc')
    assert [entry["episode"] for entry in read_metrics(tmp_path)] == [1, 2]
    append_metrics(tmp_path, [episode(3)])
    assert [entry["episode"] for entry in read_metrics(tmp_path)] == [1, 2, 3]


def test_long_cut_line_is_dropped_whole(tmp_path):
    append_metrics(tmp_path, [episode(1)])
    with open(tmp_path / "metrics.jsonl", "ab") as file:
        file.write(b'{"episode": 2, "note": "' + b"x" * 10_000)
    append_metrics(tmp_path, [episode(2)])
    assert read_metrics(tmp_path) == [episode(1), episode(2)]


def test_damaged_metrics_name_the_line(tmp_path):
    append_metrics(tmp_path, [episode(1)])
    with open(tmp_path / "metrics.jsonl", "ab") as file:
        file.write(b"garbage\n")
    with pytest.raises(RunError, match="line 2"):
        read_metrics(tmp_path)


@pytest.mark.parametrize("numbers", [[1, 2, 2], [1, 3], [2, 3], [1, 2, 1, 2]])
def test_episodes_doubled_or_out_of_order_are_not_counted(tmp_path, numbers):
    """As two writers leave them: figures would be of 260 episodes where there were 200."""
    append_metrics(tmp_path, [episode(number) for number in numbers])
    wrong = next(line for line, number in enumerate(numbers, start=1) if number != line)
    words = rf"line {wrong} of .*metrics.jsonl is episode {numbers[wrong - 1]} where episode {wrong} belongs"
    with pytest.raises(RunError, match=words + r".*--out"):
        read_metrics(tmp_path)


def test_rounds_of_a_search_are_numbered_for_each_attack(tmp_path):
    lines = [{"attack": attack, "round": number} for attack, number in [("a", 0), ("b", 0), ("a", 1)]]
    append_metrics(tmp_path, lines)
    assert read_metrics(tmp_path) == lines
    append_metrics(tmp_path, [{"attack": "b", "round": 0}])
    with pytest.raises(RunError, match=r"line 4 of .* is b round 0 where b round 1 belongs"):
        read_metrics(tmp_path)


def test_half_files_of_killed_processes_are_swept_and_no_others(tmp_path):
    run = create_run(tmp_path / "run", {})
    gone = subprocess.Popen([sys.executable, "-c", ""])
    gone.wait()
    for name in (f".summary.json.{gone.pid}.tmp", f".summary.json.{os.getpid()}.tmp", ".mine.tmp"):
        (run / name).touch()
    with writing(run, resume=True):
        pass
    assert sorted(path.name for path in run.glob(".*.tmp")) == [
        ".mine.tmp",
        f".summary.json.{os.getpid()}.tmp",
    ]


def test_resume_from_an_older_checkpoint_drops_later_episodes(tmp_path):
    append_metrics(tmp_path, [episode(i) for i in range(1, 6)])
    whole = (tmp_path / "metrics.jsonl").read_bytes()
    truncate_metrics(tmp_path, 3)
    assert [entry["episode"] for entry in read_metrics(tmp_path)] == [1, 2, 3]
    append_metrics(tmp_path, [episode(4), episode(5)])
    assert (tmp_path / "metrics.jsonl").read_bytes() == whole
    with pytest.raises(RunError, match=r"5 episodes.*after 6"):
        truncate_metrics(tmp_path, 6)


def test_metrics_missing_means_no_episodes(tmp_path):
    assert read_metrics(tmp_path) == []
    with pytest.raises(RunError, match="0 episodes"):
        truncate_metrics(tmp_path, 1)


def test_numbers_json_cannot_hold_become_null(tmp_path):
    write_json(
        tmp_path / "a.json", {"a": np.float32("inf"), "b": [float("nan"), np.int64(3)], "c": np.arange(2)}
    )
    text = (tmp_path / "a.json").read_text()
    assert json.loads(text, parse_constant=lambda name: pytest.fail(name)) == {
        "a": None,
        "b": [None, 3],
        "c": [0, 1],
    }
    assert json_safe(np.bool_(True)) is True


def test_convergence_needs_nineteen_of_twenty():
    # 19 of 20 at 998 average 945.6, at 990 only 938: the latter needs all twenty.
    assert converged_episode([-50.0] * 10 + [998.0] * 30) == 29
    assert converged_episode([-50.0] * 10 + [990.0] * 30) == 30
    assert converged_episode([-50.0, 998.0] * 40) is None
    assert converged_episode([990.0] * 19) is None
    assert converged_episode([990.0] * 20) == 20
    assert converged_episode([]) is None
    assert np.isnan(moving_mean([1.0] * 20)[:19]).all()
    assert moving_mean([1.0] * 20)[19] == 1.0


def test_summary_counts_add_up_and_survive_no_episodes(tmp_path):
    metrics = [
        episode(1, "captured", -5.0),
        episode(2, "collided", -6.0),
        episode(3, "timed_out", -70.0, min_pursuer_clearance=0.05),
        *[episode(i, "reached", 990.0, min_obstacle_clearance=0.1 * i) for i in range(4, 30)],
    ]
    about = {"scenario": "paper", "shield": "game", "pursuer": "nash", "seed": 0, "version": "0"}
    summary = summarise(metrics, wall_seconds=1.5, **about)
    assert summary["safe_episodes"] == 27
    assert summary["episodes"] == 29
    assert [summary[name] for name in ("captured", "collided", "reached", "timed_out")] == [1, 1, 26, 1]
    assert summary["env_steps"] == 2900
    assert summary["intervention_rate"] == 0.1
    assert summary["infeasible_rate"] == 0.01
    assert summary["invalid_rate"] == 0.02
    assert summary["pursuer_invalid"] == 3 * 29
    assert summary["mean_correction"] == pytest.approx(0.01)
    # Longer episodes weigh more: the mean is over periods.
    unequal = [episode(1, steps=300, mean_correction=0.04), episode(2, steps=100, mean_correction=0.0)]
    assert summarise(unequal, wall_seconds=0.0, **about)["mean_correction"] == pytest.approx(0.03)
    assert summary["min_pursuer_clearance"] == 0.05
    assert summary["min_obstacle_clearance"] == 0.4
    assert summary["final_return"] == 990.0
    assert summary["converged_episode"] == 23
    write_summary(tmp_path, summary)
    assert read_summary(tmp_path) == summary
    empty = summarise([], wall_seconds=0.0, **about)
    assert empty["episodes"] == 0
    assert empty["final_return"] is None
    assert empty["intervention_rate"] is empty["invalid_rate"] is None
    assert empty["mean_correction"] is None
    # Episodes of a version that did not count them: not known, which is not zero.
    for name, figure in (("invalid", "invalid_rate"), ("pursuer_invalid", "pursuer_invalid")):
        older = {key: value for key, value in episode().items() if key != name}
        assert summarise([older, episode(2)], wall_seconds=0.0, **about)[figure] is None
    with pytest.raises(RunError, match="crashed"):
        summarise([episode(1, "crashed")], wall_seconds=0.0, **about)


def test_first_crossing_that_does_not_last_is_told_from_one_that_does():
    returns = [998.0] * 60 + [-10.0] * 3 + [998.0] * 40
    assert converged_episode(returns) == 20
    assert longest_convergence(returns) == (20, 61)
    assert stays_converged_from(returns) == 82
    assert stays_converged_from([998.0] * 40) == 20
    assert stays_converged_from([998.0] * 40 + [-10.0] * 5) is None
    assert longest_convergence([998.0] * 40 + [-10.0] * 5) == (20, 41)
    assert longest_convergence([-10.0] * 50) is None
    assert longest_convergence([]) is None
    assert stays_converged_from([]) is None
