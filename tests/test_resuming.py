"""Hazards of going on: two writers in one folder, advice that does something else, settings that change."""

import json
import re
import shutil
import subprocess
import sys
import threading
from contextlib import contextmanager

import pytest

from sidestep.cli import main
from sidestep.commands.falsify import SearchBar
from sidestep.learning import resume_settings, train
from sidestep.store.checkpoints import list_checkpoints
from sidestep.store.lock import hold
from sidestep.store.runs import read_metrics, read_summary
from sidestep.trials.reproduction import reproduce, study_settings

LEARNER = ["hidden=[8, 8]", "batch_size=8", "warmup_decisions=10", "replay_capacity=12"]
SETTINGS = ["--seed", "5", "--episodes", "40", "--set", "episode_steps=60", "--learner", *LEARNER]
BEGIN = {
    "train": ["train", "--shield", "none", *SETTINGS],
    "reproduce": ["reproduce", "--shields", "none", "--evaluation-episodes", "4", *SETTINGS],
    "falsify": [
        "falsify", "--shield", "none", "--attacks", "pursuers", "--batch", "4", "--seconds", "2",
        "--episodes", "12", "--most", "1", "--set", "obstacle_count=0",
    ],
}  # fmt: skip
FIGURES = {"wall_seconds", "seconds", "at", "first", "first_seconds", "minutes"}


def timeless(value):
    if isinstance(value, dict):
        return {key: timeless(item) for key, item in value.items() if key not in FIGURES}
    return [timeless(item) for item in value] if isinstance(value, list) else value


def contents(folder):
    return {path: path.read_bytes() for path in sorted(folder.rglob("*")) if path.is_file()}


@pytest.fixture(scope="module", autouse=True)
def _no_figures():
    """Figures take longer than all else here; the processes that are started draw them."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("sidestep.views.write_report", lambda runs, path, **_: path)
        yield


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    """Each command, run to its end. Not to be written to."""
    folder = tmp_path_factory.mktemp("whole")
    for name, words in BEGIN.items():
        out = ["--out", str(folder / name), "--json", str(folder / f"{name}.json")]
        assert main([*words, *out]) in (0, 1)
    return folder


@contextmanager
def held_by_another(folder):
    """Another thread, which is another writer, holds the folder."""
    held, finish = threading.Event(), threading.Event()

    def other():
        with hold(folder):
            held.set()
            finish.wait(120)

    thread = threading.Thread(target=other)
    thread.start()
    assert held.wait(60)
    try:
        yield
    finally:
        finish.set()
        thread.join()


@pytest.mark.parametrize(
    "words,held",
    [
        (["train", "--resume", "--out", "{}/train", "--episodes", "50"], "train"),
        (["reproduce", "--resume", "--out", "{}/reproduce"], "reproduce"),
        (["reproduce", "--resume", "--out", "{}/reproduce"], "reproduce/none"),
        (["train", "--resume", "--out", "{}/reproduce/none"], "reproduce/none"),
        (["falsify", "--resume", "--out", "{}/falsify", "--episodes", "99"], "falsify"),
        (["report", "{}/train", "--episodes", "0"], "train"),
        (["twin", "--out", "{}/train"], "train"),
        (["fly", "--out", "{}/train"], "train"),
    ],
)
def test_second_writer_ends_before_it_touches_anything(whole, words, held, capsys):
    before = contents(whole)
    with held_by_another(whole / held):
        assert main([word.format(whole) for word in words]) == 2
    assert f"{whole / held} is in use by process" in capsys.readouterr().err
    assert contents(whole) == before


def test_library_callers_are_refused_too(whole):
    before = contents(whole)
    with held_by_another(whole / "train"), pytest.raises(ValueError, match="in use by process"):
        train(**resume_settings(whole / "train"), out=whole / "train", resume=True)
    with held_by_another(whole / "reproduce" / "none"), pytest.raises(ValueError, match="in use by process"):
        reproduce(whole / "reproduce", **study_settings(whole / "reproduce"), resume=True)
    assert contents(whole) == before


def test_two_fresh_trainings_in_one_folder_leave_one(whole, tmp_path):
    out = tmp_path / "run"
    command = [sys.executable, "-m", "sidestep", *BEGIN["train"], "--out", str(out)]
    both = [
        subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True)
        for _ in range(2)
    ]
    shown = [child.communicate(timeout=300.0)[0] for child in both]
    assert sorted(child.returncode for child in both) == [0, 2], shown
    assert any("in use by process" in text or "already holds a run" in text for text in shown)
    assert (out / "metrics.jsonl").read_bytes() == (whole / "train" / "metrics.jsonl").read_bytes()


# The advice after an interrupt -----------------------------------------------------------------------------


def interrupt_after(calls, monkeypatch):
    """Ctrl-C at that call of a progress display."""
    from sidestep.commands.common import TrainingBar

    left = [calls]

    def update(self, *values):
        left[0] -= 1
        if left[0] == 0:
            raise KeyboardInterrupt

    monkeypatch.setattr(TrainingBar, "update", update)
    monkeypatch.setattr(SearchBar, "update", update)


@pytest.mark.parametrize("name", ["train", "falsify", pytest.param("reproduce", marks=pytest.mark.slow)])
def test_advice_after_an_interrupt_pasted_into_a_shell_does_the_rest(
    whole, name, tmp_path, monkeypatch, capsys
):
    out, figures = tmp_path / "my runs" / name, tmp_path / "my figures.json"
    monkeypatch.chdir(tmp_path)
    with monkeypatch.context() as patch:
        interrupt_after(1, patch)
        assert main([*BEGIN[name], "--out", f"my runs/{name}", "--json", "my figures.json"]) == 130
    (advice,) = re.findall(r"Interrupted. Continue with: (.*)", capsys.readouterr().out)
    figures.unlink(missing_ok=True)
    pasted = subprocess.run(["sh", "-c", advice], cwd=tmp_path, capture_output=True, text=True)
    assert pasted.returncode in ((0, 1) if name == "falsify" else (0,)), pasted.stdout + pasted.stderr
    assert timeless(json.loads(figures.read_text())) == timeless(
        json.loads((whole / f"{name}.json").read_text())
    )
    assert timeless(read_summary(out)) == timeless(read_summary(whole / name))
    for metrics in (whole / name).rglob("metrics.jsonl"):
        folder = metrics.parent
        ours = read_metrics(out / folder.relative_to(whole / name))
        assert timeless(ours) == timeless(read_metrics(folder))


@pytest.mark.parametrize("name", BEGIN)
def test_interrupt_before_anything_is_written_advises_nothing_that_is_not_there(
    name, tmp_path, monkeypatch, capsys
):
    def interrupt(*_):
        raise KeyboardInterrupt

    for module in ("sidestep.store.runs", "sidestep.trials.falsification.search"):
        monkeypatch.setattr(sys.modules[module], "create_run", interrupt)
    assert main([*BEGIN[name], "--out", str(tmp_path / "run")]) == 130
    assert "Interrupted before anything was written" in capsys.readouterr().out
    assert not (tmp_path / "run").exists()


# Settings beside --resume ----------------------------------------------------------------------------------

CONTRADICTIONS = [
    ("train", ["--seed", "0"], r"seed = 5, not 0"),
    ("train", ["--shield", "joint"], r"shield = 'none', not 'joint'"),
    ("train", ["--pursuer", "still"], r"pursuer = 'nash', not 'still'"),
    ("train", ["--set", "evader_speed=0.3"], r"scenario, evader_speed = 0\.1574\d*, not 0\.3"),
    ("train", ["--scenario", "quadrotor"], r"scenario, .* not "),
    ("train", ["--learner", "batch_size=16"], r"learner, batch_size = 8, not 16"),
    ("train", ["--episodes", "2"], r"begun for 40 episodes.*fewer \(2\)"),
    ("reproduce", ["--seed", "0"], r"seed = 5, not 0"),
    ("reproduce", ["--shields", "none", "game"], r"study = \['none'\], not \['none', 'game'\]"),
    ("reproduce", ["--episodes", "200"], r"episodes = 40, not 200"),
    ("reproduce", ["--evaluation-episodes", "1000"], r"evaluation_episodes = 4, not 1000"),
    ("reproduce", ["--set", "evader_speed=0.3"], r"scenario, evader_speed = 0\.1574\d*, not 0\.3"),
    ("falsify", ["--seed", "1"], r"seed = 0, not 1"),
    ("falsify", ["--shield", "joint"], r"shield = 'none', not 'joint'"),
    ("falsify", ["--goal", "capture"], r"goal = 'both', not 'capture'"),
    ("falsify", ["--attacks", "pursuers", "herder"], r"attacks = \['pursuers'\], not"),
    ("falsify", ["--batch", "256"], r"batch = 4, not 256"),
    ("falsify", ["--policy", "{}/train"], r"policy = 'goal-seeking', not '.*train'"),
    ("falsify", ["--episodes", "8"], r"begun for 12 episodes.*fewer \(8\)"),
]


@pytest.mark.parametrize("name,words,named", CONTRADICTIONS, ids=lambda value: str(value)[:40])
def test_option_that_contradicts_the_folder_is_refused_by_name(whole, name, words, named, capsys):
    before = contents(whole)
    given = [word.format(whole) for word in words]
    assert main([name, "--out", str(whole / name), "--resume", *given]) == 2
    assert re.search(named, capsys.readouterr().err)
    assert contents(whole) == before


@pytest.mark.parametrize("name", BEGIN)
def test_options_that_agree_are_fine_and_a_finished_run_is_left_as_it_is(whole, name, tmp_path, capsys):
    shutil.copytree(whole / name, tmp_path / name)
    skipped = ("report.html", ".lock")
    before = {path: content for path, content in contents(tmp_path).items() if path.name not in skipped}
    status = main([*BEGIN[name], "--out", str(tmp_path / name), "--resume"])
    assert status in ((0, 1) if name == "falsify" else (0,))
    after = {path: content for path, content in contents(tmp_path).items() if path.name not in skipped}
    assert after == before
    if name != "reproduce":
        assert re.search(r"had its 40 episodes already|had already used its time", capsys.readouterr().out)


@pytest.mark.parametrize(
    "name,other", [("train", "falsify"), ("reproduce", "train"), ("falsify", "reproduce")]
)
def test_folder_of_another_command_is_not_resumed(whole, name, other, capsys):
    before = contents(whole)
    assert main([name, "--out", str(whole / other), "--resume"]) == 2
    assert re.search(r"holds no .* but a ", capsys.readouterr().err)
    assert contents(whole) == before


def test_run_trained_on_by_itself_is_no_part_of_its_study_any_more(whole, tmp_path, capsys):
    shutil.copytree(whole / "reproduce", tmp_path / "study")
    assert main(["train", "--out", str(tmp_path / "study" / "none"), "--resume", "--episodes", "41"]) == 0
    assert main(["reproduce", "--out", str(tmp_path / "study"), "--resume"]) == 2
    assert re.search(r"none was begun with other settings: episodes = 41, not 40", capsys.readouterr().err)


# Damage ----------------------------------------------------------------------------------------------------


def test_damaged_checkpoint_is_named_on_the_error_stream_and_the_run_ends_the_same(whole, tmp_path, capsys):
    shutil.copytree(whole / "train", tmp_path / "run")
    for name in ("policy.npz", "summary.json"):
        (tmp_path / "run" / name).unlink()
    newest = list_checkpoints(tmp_path / "run")[-1]
    newest.write_bytes(newest.read_bytes()[:-200])
    assert main(["train", "--out", str(tmp_path / "run"), "--resume"]) == 0
    shown = capsys.readouterr().err
    found = re.search(
        rf"sidestep: warning: {newest} is damaged.*goes on from .*, after episode (\d+). Lost: the (\d+)",
        shown,
    )
    # How many checkpoints there are depends on how fast the machine is.
    assert found is not None
    assert int(found[1]) + int(found[2]) == 40
    metrics = (folder / "metrics.jsonl" for folder in (tmp_path / "run", whole / "train"))
    assert len({path.read_bytes() for path in metrics}) == 1
