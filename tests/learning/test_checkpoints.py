"""Hazard: a training that a kill, a full disk or a bad file turns into another one, or loses."""

import json
import os
import pickle
import shutil
import signal
import subprocess
import sys
import time
import zipfile
from pathlib import Path

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from sidestep.learning import load_policy, make_options, options_to_dict, resume_settings, train
from sidestep.learning.training import start
from sidestep.safety import as_shield
from sidestep.store.checkpoints import (
    CheckpointError,
    list_checkpoints,
    read_checkpoint,
    read_named,
    write_arrays,
    write_checkpoint,
)
from sidestep.store.damage import DamageWarning
from sidestep.store.files import read_json
from sidestep.store.runs import RunError, open_run, read_metrics, read_summary
from sidestep.world import scenario_to_dict


def contents(folder):
    """Every file below a folder with its bytes; the curves carry times of day."""
    return {
        str(path.relative_to(folder)): path.read_bytes()
        for path in sorted(Path(folder).rglob("*"))
        if path.is_file()
    }


def fresh_state(small, scenario=None, options=None, capacity=64):
    """Something shaped like a state at its start, without compiling one."""
    scenario, options = scenario or small.scenario(), options or small.options()
    shapes = eqx.filter_eval_shape(
        start, scenario, as_shield("game", scenario), options, jax.random.key(0), capacity
    )

    def blank(leaf):
        key = jnp.issubdtype(leaf.dtype, jax.dtypes.prng_key)
        return jax.random.key(0) if key else jnp.zeros(leaf.shape, leaf.dtype)

    return jax.tree.map(blank, shapes)


@pytest.fixture(scope="module")
def whole(small, tmp_path_factory):
    """An uninterrupted run on disk, with a checkpoint after every chunk. Not to be written to."""
    folder = tmp_path_factory.mktemp("whole") / "run"
    return small.train(out=folder, checkpoint_seconds=0.0)


def same_run(small, training, whole):
    """Weights, targets, moments, replay, world, random state, and the metrics file: bit for bit."""
    assert small.differences(training.state, whole.state) == []
    assert training.metrics == whole.metrics
    assert (training.folder / "metrics.jsonl").read_bytes() == (whole.folder / "metrics.jsonl").read_bytes()
    assert small.differences(load_policy(training.folder), whole.policy) == []
    ours, theirs = read_summary(training.folder), read_summary(whole.folder)
    assert ours.pop("wall_seconds") > 0.0
    theirs.pop("wall_seconds")
    assert ours == theirs


# Bit-exact resume --------------------------------------------------------------------------------------


def test_training_in_two_parts_is_the_training_in_one(small, whole, tmp_path):
    # Three episodes first: their replay has room for 24 decisions, the longer training's for 64.
    first = small.train(out=tmp_path / "run", episodes=3)
    assert first.state.replay.capacity < whole.state.replay.capacity
    assert len(first.metrics) == 3
    second = small.train(out=tmp_path / "run", episodes=8, resume=True)
    same_run(small, second, whole)
    assert read_json(tmp_path / "run" / "config.json")["episodes"] == 8


def test_keeping_no_folder_changes_nothing(small, small_run, whole):
    assert small.differences(small_run.state, whole.state) == []


@pytest.mark.parametrize("after", [1, 4])
def test_interrupt_leaves_a_checkpoint_that_goes_on_as_if_nothing_had_been(small, whole, tmp_path, after):
    calls = []

    def interrupt(progress):
        calls.append(progress)
        if len(calls) == after:
            raise KeyboardInterrupt

    stopped = small.train(out=tmp_path / "run", progress=interrupt)
    assert stopped.interrupted
    assert int(stopped.state.decisions) == 10 * after
    assert read_summary(tmp_path / "run")["episodes"] == len(stopped.metrics) < 8
    with pytest.raises(RunError, match=r"no policy yet.*--resume"):
        load_policy(tmp_path / "run")
    settings = resume_settings(tmp_path / "run")
    finished = train(**settings, out=tmp_path / "run", resume=True, chunk=10)
    assert not finished.interrupted
    same_run(small, finished, whole)


def test_resuming_a_finished_run_changes_nothing(small, whole, tmp_path):
    shutil.copytree(whole.folder, tmp_path / "run")
    again = small.train(out=tmp_path / "run", resume=True)
    same_run(small, again, whole)


def test_failure_outside_leaves_a_run_that_can_be_resumed(small, whole, tmp_path):
    def fail(progress):
        if progress.episode >= 2:
            raise RuntimeError("the screen is gone")

    with pytest.raises(RuntimeError, match="the screen"):
        small.train(out=tmp_path / "run", progress=fail)
    same_run(small, small.train(out=tmp_path / "run", resume=True), whole)


def test_kill_at_any_write_leaves_a_run_that_can_be_resumed(small, whole, tmp_path, monkeypatch):
    """The folder is copied around every change on disk, as a kill would leave it; each copy goes on."""
    copies = {}

    def watched(function):
        def call(*arguments, **more):
            keep()
            try:
                return function(*arguments, **more)
            finally:
                keep()

        return call

    def keep():
        if (tmp_path / "run").exists():
            found = contents(tmp_path / "run")
            key = tuple((name, content) for name, content in found.items() if not name.startswith("curves"))
            if key not in copies:
                copies[key] = tmp_path / f"copy{len(copies)}"
                shutil.copytree(tmp_path / "run", copies[key])

    for name in ("fsync", "replace", "unlink", "mkdir"):
        monkeypatch.setattr(os, name, watched(getattr(os, name)))
    small.train(out=tmp_path / "run", checkpoint_seconds=0.0)
    monkeypatch.undo()
    assert len(copies) > 25
    unstarted = 0
    for copy in copies.values():
        begun = (copy / "config.json").exists()
        if not begun:
            with pytest.raises(RunError, match="leave out --resume"):
                small.train(out=copy, resume=True)
            unstarted += 1
        training = small.train(out=copy, resume=begun)
        same_run(small, training, whole)
    assert 1 <= unstarted <= 5


def test_run_killed_before_its_first_checkpoint_and_again_before_its_next_goes_on(
    small, whole, tmp_path, monkeypatch
):
    class Killed(BaseException):
        pass

    def kill(*_, **__):
        raise Killed

    monkeypatch.setattr(sys.modules["sidestep.learning.run"], "write_checkpoint", kill)
    with pytest.raises(Killed):
        small.train(out=tmp_path / "run")
    monkeypatch.undo()
    assert not list((tmp_path / "run" / "checkpoints").iterdir())

    def copy(progress):
        if progress.episode >= 1 and not (tmp_path / "again").exists():
            shutil.copytree(tmp_path / "run", tmp_path / "again")

    same_run(small, small.train(out=tmp_path / "run", resume=True, progress=copy), whole)
    assert read_metrics(tmp_path / "again")
    same_run(small, small.train(out=tmp_path / "again", resume=True), whole)


CHILD = """
import json, sys
from sidestep.learning import make_options, train
from sidestep.world import load_scenario

scenario, options, episodes, folder, resume = json.loads(sys.argv[1])
train(
    load_scenario("paper", **scenario), shield="game", pursuer="turn-then-drive", episodes=episodes,
    out=folder, options=make_options(**options), resume=resume, chunk=10, checkpoint_seconds=0.0,
    progress=lambda progress: print(progress.episode, flush=True),
)
"""


@pytest.mark.slow
def test_kill_of_the_process_at_random_moments_changes_no_bit_of_the_run(small, tmp_path):
    """Chunks take milliseconds here, so that most kills fall into a write."""
    episodes, folder = 60, tmp_path / "killed"
    expected = small.train(out=tmp_path / "whole", episodes=episodes)
    scenario = {k: v for k, v in scenario_to_dict(small.scenario()).items() if v is not None}
    rng = np.random.default_rng()
    for attempt in range(2):
        given = json.dumps([scenario, options_to_dict(small.options()), episodes, str(folder), attempt > 0])
        with subprocess.Popen(
            [sys.executable, "-c", CHILD, given], stdout=subprocess.PIPE, text=True
        ) as child:
            assert child.stdout is not None
            for _ in range(int(rng.integers(1, 8))):
                assert child.stdout.readline(), "the training ended before it could be killed"
            time.sleep(rng.uniform(0.0, 0.05))
            child.send_signal(signal.SIGKILL)
        assert child.returncode == -signal.SIGKILL
        assert list_checkpoints(folder)
        assert not (folder / "summary.json").exists()
    finished = small.train(out=folder, episodes=episodes, resume=True)
    same_run(small, finished, expected)
    assert [path.name for path in (folder / "checkpoints").glob(".*")] == []


# Damaged and foreign files ---------------------------------------------------------------------------------


def damage(path, how):
    content = bytearray(path.read_bytes())
    if how == "cut in half":
        content = content[: len(content) // 2]
    elif how == "empty":
        content = bytearray()
    elif how == "not an archive":
        content = bytearray(b"\x00" * 4096)
    elif how == "one bit":
        # In the middle of the largest array: some bits of an archive mean nothing.
        with zipfile.ZipFile(path) as archive:
            largest = max(archive.infolist(), key=lambda member: member.compress_size)
        content[largest.header_offset + largest.compress_size // 2] ^= 0x10
    path.write_bytes(content)


@pytest.mark.parametrize("how", ["cut in half", "empty", "not an archive", "one bit"])
def test_damaged_newest_checkpoint_falls_back_on_the_one_before_it(small, whole, tmp_path, how):
    shutil.copytree(whole.folder, tmp_path / "run")
    for name in ("policy.npz", "summary.json"):
        (tmp_path / "run" / name).unlink()
    older, newest = list_checkpoints(tmp_path / "run")
    damage(newest, how)
    with pytest.warns(DamageWarning) as warned:
        state, _ = read_checkpoint(tmp_path / "run", fresh_state(small))
    (said,) = (str(one.message) for one in warned)
    begin = int(state.episodes)
    assert str(newest) in said
    assert f"after episode {begin}" in said
    assert f"{8 - begin} episodes" in said
    assert newest.stem.endswith(f"{8:06d}")
    assert older.stem.endswith(f"{int(state.episodes):06d}")
    with pytest.warns(DamageWarning, match=newest.name):
        again = small.train(out=tmp_path / "run", resume=True)
    same_run(small, again, whole)
    for path in list_checkpoints(tmp_path / "run"):
        damage(path, how)
    before = contents(tmp_path / "run")
    with pytest.raises(CheckpointError, match="damaged"):
        small.train(out=tmp_path / "run", resume=True)
    assert contents(tmp_path / "run") == before


def test_no_damage_is_ever_read_as_a_checkpoint(small, tmp_path):
    """Each flipped bit is either without effect on what is read, or found."""
    tree = {"weights": jnp.arange(6.0), "count": jnp.asarray(3, int), "key": jax.random.key(4)}
    path = tmp_path / "checkpoints" / "episodes-000001.npz"
    path.parent.mkdir()
    write_arrays(path, tree, episodes=1)
    whole, rng = path.read_bytes(), np.random.default_rng(0)
    found = 0
    for place in np.concatenate([np.arange(0, len(whole), 7), np.arange(len(whole) - 100, len(whole))]):
        torn = bytearray(whole)
        torn[place] ^= 1 << int(rng.integers(8))
        path.write_bytes(torn)
        try:
            read, _ = read_checkpoint(tmp_path, tree)
        except CheckpointError:
            found += 1
        else:
            assert small.differences(read, tree) == []
    assert found > 100
    for length in range(0, len(whole), 101):
        path.write_bytes(whole[:length])
        with pytest.raises(CheckpointError, match="damaged"):
            read_checkpoint(tmp_path, tree)


class Malicious:
    """Pickles to a command that leaves a trace when it is loaded."""

    def __init__(self, trace):
        self.trace = trace

    def __reduce__(self):
        return os.mkdir, (str(self.trace),)


def test_pickled_objects_in_a_file_are_never_loaded(small, whole, tmp_path):
    trace = tmp_path / "executed"
    shutil.copytree(whole.folder, tmp_path / "run")
    for path in [*list_checkpoints(tmp_path / "run"), tmp_path / "run" / "policy.npz"]:
        with np.load(path) as file:
            stored = {name: file[name] for name in file.files}
        for name in ("manifest", "names", "leaf0"):
            np.savez(path, **{**stored, name: np.array([Malicious(trace)], dtype=object)})
            with pytest.raises(CheckpointError, match="damaged"):
                read_named(path)
            with pytest.raises(CheckpointError, match="damaged"):
                load_policy(path)
    path.write_bytes(pickle.dumps(Malicious(trace)))
    with pytest.raises(CheckpointError, match="damaged"):
        load_policy(path)
    assert not trace.exists()
    with (
        np.load(list_checkpoints(tmp_path / "run")[0]) as file,
        pytest.raises(ValueError, match="allow_pickle"),
    ):
        file["leaf0"]


def test_checkpoint_of_another_kind_of_training_is_refused_and_says_what_differs(small, whole):
    wider = fresh_state(small, options=small.options(hidden=[16, 24]))
    with pytest.raises(CheckpointError, match=r"weights\[1\].*other options"):
        read_checkpoint(whole.folder, wider)
    deeper = fresh_state(small, options=small.options(hidden=[16, 16, 16]))
    with pytest.raises(CheckpointError, match=r"weights"):
        read_checkpoint(whole.folder, deeper)
    with pytest.raises(CheckpointError, match=r"path.*another scenario"):
        read_checkpoint(whole.folder, fresh_state(small, options=small.options(decision_steps=4)))


def test_resume_in_another_float_precision_is_refused_before_anything_is_written(small, whole, tmp_path):
    shutil.copytree(whole.folder, tmp_path / "run")
    before = contents(tmp_path / "run")
    settings = resume_settings(tmp_path / "run")
    with jax.enable_x64(True), pytest.raises(CheckpointError, match="float precision"):
        train(**{**resume_settings(tmp_path / "run"), "episodes": 9}, out=tmp_path / "run", resume=True)
    assert contents(tmp_path / "run") == before
    assert settings["episodes"] == 8


CHANGES = {
    "scenario": lambda small: {"scenario": small.scenario(evader_speed=0.29)},
    "learner": lambda small: {"options": small.options(discount=0.98)},
    "shield": lambda small: {"shield": "none"},
    "pursuer": lambda small: {"pursuer": "still"},
    "seed": lambda small: {"seed": 3},
    "fewer": lambda small: {"episodes": 7},
}


@pytest.mark.parametrize("what", CHANGES)
def test_resume_with_another_setting_is_refused_and_names_it(small, whole, what):
    before = contents(whole.folder)
    with pytest.raises(RunError, match=what):
        small.train(**CHANGES[what](small), out=whole.folder, resume=True)
    assert contents(whole.folder) == before


def test_two_strategies_of_ones_own_are_not_taken_for_each_other(small, tmp_path, monkeypatch):
    def timid(scenario, world, key):
        return jnp.zeros(2)

    def bold(scenario, world, key):
        return jnp.ones(2)

    def stop(*_):
        raise KeyboardInterrupt

    monkeypatch.setattr(sys.modules["sidestep.learning.run"], "run_chunk", stop)
    assert small.train(pursuer=timid, out=tmp_path / "run").interrupted
    with pytest.raises(RunError, match=r"pursuer.*timid.*bold"):
        small.train(pursuer=bold, out=tmp_path / "run", resume=True)


def test_existing_run_or_folder_is_never_overwritten(small, whole, tmp_path):
    before = contents(whole.folder)
    with pytest.raises(RunError, match=r"--resume.*--out"):
        small.train(out=whole.folder, seed=9)
    assert contents(whole.folder) == before
    (tmp_path / "checkpoints").mkdir()
    (tmp_path / "checkpoints" / "mine.npz").write_text("not yours")
    with pytest.raises(RunError, match="--out"):
        small.train(out=tmp_path)
    assert contents(tmp_path) == {"checkpoints/mine.npz": b"not yours"}
    with pytest.raises(RunError, match="does not exist; leave out --resume"):
        small.train(out=tmp_path / "nowhere", resume=True)
    assert not (tmp_path / "nowhere").exists()


@pytest.mark.parametrize(
    "name,value",
    [("episodes", 0), ("seed", -1), ("seed", 2**64), ("chunk", 0), ("seed", True)],
)
def test_bad_numbers_are_named_before_a_folder_is_made(small, tmp_path, name, value):
    with pytest.raises(ValueError, match=f"{name} = {value!r}"):
        small.train(**{name: value}, out=tmp_path / "run")
    assert not (tmp_path / "run").exists()


# What a checkpoint holds -------------------------------------------------------------------------------


def test_only_the_filled_part_of_the_replay_is_stored(small, tmp_path):
    (tmp_path / "checkpoints").mkdir()
    state = fresh_state(small, capacity=100_000)
    path = write_checkpoint(tmp_path, state, wall_seconds=0.0)
    assert path.stat().st_size < 200_000
    again, manifest = read_checkpoint(tmp_path, state)
    assert small.differences(again, state) == []
    assert manifest["wall_seconds"] == 0.0


def test_two_checkpoints_are_kept(whole):
    assert len(list_checkpoints(whole.folder)) == 2
    assert len(read_metrics(whole.folder)) == 8


def test_resume_settings_are_those_the_run_was_begun_with(small, whole):
    settings = resume_settings(whole.folder)
    assert small.differences(settings["scenario"], small.scenario()) == []
    assert settings["scenario"] == small.scenario() or settings["scenario"].name == small.scenario().name
    assert options_to_dict(settings["options"]) == options_to_dict(small.options())
    assert options_to_dict(make_options(**options_to_dict(settings["options"]))) == options_to_dict(
        small.options()
    )
    assert (settings["shield"], settings["pursuer"], settings["seed"], settings["episodes"]) == (
        "game",
        "turn-then-drive",
        0,
        8,
    )


# Warm starts --------------------------------------------------------------------------------------------


def test_warm_start_begins_with_the_networks_of_the_other_run_and_an_empty_replay(small, tmp_path):
    first = small.train(out=tmp_path / "first")
    steps = []
    second = small.train(
        shield="none", out=tmp_path / "second", warm_start=tmp_path / "first", progress=steps.append
    )
    assert int(second.state.learner.updates) > int(first.state.learner.updates)
    begun, _ = read_checkpoint(tmp_path / "second", second.state)
    assert small.differences(begun.learner, second.state.learner) == []
    alone = small.train(shield="none")
    assert small.differences(alone.policy, second.policy) != []
    config = open_run(tmp_path / "second")
    assert config["warm_start"] == str(tmp_path / "first")
    # From the first decision on it is the learned policy that acts, not a random one.
    assert second.metrics[0] != alone.metrics[0]


def test_warm_start_interrupted_and_resumed_is_the_same_training(small, tmp_path):
    small.train(out=tmp_path / "first")
    whole = small.train(out=tmp_path / "whole", warm_start=tmp_path / "first")

    def interrupt(progress):
        if progress.episode >= 3:
            raise KeyboardInterrupt

    small.train(out=tmp_path / "parts", warm_start=tmp_path / "first", progress=interrupt)
    settings = resume_settings(tmp_path / "parts")
    assert settings["warm_start"] == str(tmp_path / "first")
    again = small.train(out=tmp_path / "parts", warm_start=settings["warm_start"], resume=True)
    assert again.metrics == whole.metrics
    assert small.differences(again.state, whole.state) == []
    with pytest.raises(RunError, match="warm_start"):
        small.train(out=tmp_path / "parts", resume=True)


def test_warm_start_that_does_not_fit_is_refused_before_anything_is_written(small, tmp_path):
    small.train(out=tmp_path / "first", episodes=1)
    other = small.scenario(obstacle_count=2)
    with pytest.raises(CheckpointError, match="needed"):
        small.train(other, out=tmp_path / "second", warm_start=tmp_path / "first")
    with pytest.raises(RunError, match="name the run folder of a training"):
        small.train(out=tmp_path / "second", warm_start=tmp_path / "nothing")
    assert not (tmp_path / "second").exists()
