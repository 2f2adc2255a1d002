"""Hazards of commands whose outputs cannot be written: work lost, half a file, a traceback."""

import errno
import os

import pytest

from sidestep.cli import main
from sidestep.learning import make_options, resume_settings, train
from sidestep.store import runs as records
from sidestep.store.files import OutputError
from sidestep.world import load_scenario

BELOW, FOLDER = "{file}/below", "{folder}"


@pytest.mark.parametrize(
    "words",
    [
        ["train", "--out", BELOW],
        ["train", "--out", "{free}", "--json", FOLDER],
        ["evaluate", "--json", BELOW],
        ["evaluate", "--json", FOLDER],
        ["evaluate", "--log", BELOW],
        ["evaluate", "--video", BELOW + ".gif"],
        ["evaluate", "--json", "{free}", "--log", "{free}"],
        ["reproduce", "--out", BELOW],
        ["reproduce", "--out", "{free}", "--json", FOLDER],
        ["certify", "--figure", BELOW],
        ["certify", "--json", FOLDER],
        ["falsify", "--out", BELOW],
        ["falsify", "--out", "{free}", "--json", FOLDER],
        ["campaign", "{none}.toml", "--out", BELOW],
        ["campaign", "{none}.toml", "--json", FOLDER],
        ["export", "{none}", "--out", BELOW],
        ["export", "{none}", "--out", "{free}", "--json", FOLDER],
        ["report", "{none}.npz", "--out", BELOW],
        ["report", "{none}.npz", "--out", FOLDER],
        ["twin", "--json", BELOW],
        ["twin", "--out", BELOW],
        ["twin", "--log", BELOW],
        ["twin", "--video", BELOW + ".gif"],
        ["fly", "--json", FOLDER],
        ["fly", "--out", BELOW],
    ],
    ids=" ".join,
)
def test_output_that_cannot_be_written_is_refused_before_any_work(words, tmp_path, capsys):
    (tmp_path / "file").write_text("mine")
    (tmp_path / "folder").mkdir()
    places = {name: tmp_path / name for name in ("file", "folder", "free", "none")}
    assert main([word.format(**places) for word in words]) == 2
    captured = capsys.readouterr()
    assert captured.err.startswith("sidestep: ")
    assert captured.err.count("\n") == 1
    assert captured.out == ""
    assert any(
        words in captured.err for words in ("could not be written", "is a folder", "named for two outputs")
    )
    assert sorted(path.name for path in tmp_path.iterdir()) == ["file", "folder"]


@pytest.fixture
def disk(monkeypatch):
    """A disk that can be filled: then no file reaches it."""

    def fill():
        def full(_):
            raise OSError(errno.ENOSPC, "No space left on device")

        monkeypatch.setattr(os, "fsync", full)

    yield fill
    monkeypatch.undo()


@pytest.fixture
def settings():
    """The same for every training, so that one program does for all."""
    options = make_options(hidden=[8, 8], batch_size=8, warmup_decisions=4, replay_capacity=50)
    return {"shield": "none", "options": options, "checkpoint_seconds": 0.0, "chunk": 4}


def test_training_on_a_full_disk_says_what_is_kept_and_goes_on_from_there(
    tmp_path, disk, settings, monkeypatch
):
    scenario = load_scenario("paper", obstacle_count=0, episode_steps=40)

    def fill(progress):
        if progress.episode == 2:
            disk()

    out = tmp_path / "run"
    with pytest.raises(
        OutputError, match=r"metrics\.jsonl could not be written: no space left.* Kept: .*0002"
    ):
        train(scenario, episodes=4, out=out, progress=fill, **settings)
    monkeypatch.undo()
    assert not list(out.rglob("*.tmp"))
    kept = resume_settings(out)
    resumed = train(**{**kept, **settings}, out=out, resume=True)
    assert [line["episode"] for line in records.read_metrics(out)] == [1, 2, 3, 4]
    whole = train(scenario, episodes=4, **settings)
    assert resumed.metrics == whole.metrics


def test_first_error_is_said_where_the_last_checkpoint_fails_too(tmp_path, disk, settings):
    def fail(_):
        disk()
        raise RuntimeError("what went wrong first")

    scenario = load_scenario("paper", obstacle_count=0, episode_steps=40)
    with pytest.raises(RuntimeError, match="what went wrong first"):
        train(scenario, episodes=4, out=tmp_path / "run", progress=fail, **settings)


def test_log_that_does_not_fit_leaves_no_torso(tmp_path, disk, monkeypatch):
    pytest.importorskip("mcap")
    from sidestep.bridges.logs import save_log
    from sidestep.loop import rollout

    scenario = load_scenario("paper", obstacle_count=0, episode_steps=10)
    trajectory = rollout(scenario, "goal-seeking", "none", "still", 0)
    path = tmp_path / "episode.mcap"
    disk()
    with pytest.raises(OutputError, match=r"episode\.mcap could not be written: no space left"):
        save_log(trajectory, scenario, path)
    assert list(tmp_path.iterdir()) == []
    monkeypatch.undo()
    assert save_log(trajectory, scenario, path).is_file()
