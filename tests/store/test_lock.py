"""Hazards of a folder with two writers, and of a lock that outlives its holder."""

import json
import os
import signal
import socket
import subprocess
import sys
import threading
import time
from contextlib import contextmanager
from pathlib import Path

import pytest

from sidestep.store import lock
from sidestep.store.lock import FolderInUseError, hold

# Loaded by itself: importing the package would take longer than everything else here.
CHILD = """
import importlib.util, os, sys
spec = importlib.util.spec_from_file_location("lock", sys.argv[1])
lock = importlib.util.module_from_spec(spec)
spec.loader.exec_module(lock)
with lock.hold(*sys.argv[3:]):
    if sys.argv[2] == "fork" and (child := os.fork()) == 0:
        sys.exit()  # through the end of the block
    if sys.argv[2] == "fork":
        os.waitpid(child, 0)
    print("held", flush=True)
    sys.stdin.read()
"""


@contextmanager
def held_elsewhere(*folders, how="plain"):
    """Another process holds these folders; gives it."""
    with subprocess.Popen(
        [sys.executable, "-c", CHILD, lock.__file__, how, *map(str, folders)],
        stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True,
    ) as child:  # fmt: skip
        assert child.stdout is not None
        assert child.stdout.readline() == "held\n"
        yield child
        if child.poll() is None:
            child.communicate()


def test_second_writer_is_refused_and_learns_who_the_first_is(tmp_path):
    folder = tmp_path / "run"
    with held_elsewhere(folder) as child:
        note = json.loads((folder / ".lock.json").read_text())
        with (
            pytest.raises(
                FolderInUseError, match=rf"{folder} is in use by process {child.pid} on this host"
            ) as no,
            hold(folder),
        ):
            pass
        assert socket.gethostname() in str(no.value)
        assert note["since"] in str(no.value)
        assert json.loads((folder / ".lock.json").read_text()) == note
    assert not folder.exists(), "nothing was put there"
    with hold(folder):
        assert (folder / ".lock.json").is_file()


def test_lock_of_a_killed_process_blocks_nobody(tmp_path):
    with held_elsewhere(tmp_path) as child:
        child.send_signal(signal.SIGKILL)
        child.wait()
        assert json.loads((tmp_path / ".lock.json").read_text())["process"] == child.pid
        with hold(tmp_path):
            assert json.loads((tmp_path / ".lock.json").read_text())["process"] == os.getpid()
    assert not (tmp_path / ".lock.json").exists()


def test_fork_of_the_holder_neither_holds_nor_lets_go(tmp_path):
    with held_elsewhere(tmp_path, how="fork"):
        assert (tmp_path / ".lock.json").exists()
        with pytest.raises(FolderInUseError), hold(tmp_path):
            pass


def test_one_folder_of_several_in_use_is_enough_and_none_is_kept(tmp_path):
    with held_elsewhere(tmp_path / "study" / "game"):
        with pytest.raises(FolderInUseError, match="game"), hold(tmp_path / "study", tmp_path / "study/game"):
            pass
        with hold(tmp_path / "study"):
            pass
    with (
        held_elsewhere(tmp_path / "study", tmp_path / "study" / "game"),
        pytest.raises(FolderInUseError, match="game"),
        hold(tmp_path / "study" / "game"),
    ):
        pass


@pytest.fixture
def another_host(tmp_path):
    """A note as a process on another host would leave it, whose locks do not reach here."""
    note = tmp_path / ".lock.json"
    note.write_text(json.dumps({"process": 7, "host": "far", "since": "2026-01-01 00:00:00+00:00"}))
    return note


def test_live_holder_on_another_host_is_told_from_a_dead_one(tmp_path, another_host):
    words = r"process 7 on far since 2026-01-01.*sign of life was \d+ s ago.*killed, try again in 60 s"
    with pytest.raises(FolderInUseError, match=words), hold(tmp_path):
        pass
    assert another_host.exists()
    long_ago = time.time() - 61.0
    os.utime(another_host, (long_ago, long_ago))
    with hold(tmp_path):
        assert json.loads(another_host.read_text())["process"] == os.getpid()


def test_holder_shows_life_while_it_works(tmp_path, monkeypatch):
    monkeypatch.setattr(lock, "_SIGN_SECONDS", 0.01)
    with hold(tmp_path):
        note = tmp_path / ".lock.json"
        os.utime(note, (0.0, 0.0))
        deadline = time.monotonic() + 30.0
        while note.stat().st_mtime == 0.0 and time.monotonic() < deadline:
            time.sleep(0.01)
        assert note.stat().st_mtime > 0.0


def test_job_waits_until_the_other_is_silent(tmp_path, another_host, monkeypatch):
    monkeypatch.setattr(lock, "_SILENT_SECONDS", 0.5)
    with hold(tmp_path, wait=True):
        assert json.loads(another_host.read_text())["host"] == socket.gethostname()


def test_same_thread_may_enter_again_and_another_may_not(tmp_path):
    refused = []

    def enter():
        try:
            with hold(tmp_path):
                pass
        except FolderInUseError as error:
            refused.append(str(error))

    with hold(tmp_path):
        with hold(tmp_path), hold(tmp_path / ".." / tmp_path.name):
            pass
        thread = threading.Thread(target=enter)
        thread.start()
        thread.join()
    assert len(refused) == 1
    assert f"process {os.getpid()}" in refused[0]
    enter()
    assert len(refused) == 1


def test_folder_made_for_nothing_is_taken_away_and_another_is_not(tmp_path):
    with hold(tmp_path / "a" / "b"):
        pass
    assert list(tmp_path.iterdir()) == []
    (tmp_path / "mine").mkdir()
    with hold(tmp_path / "mine"), hold(tmp_path / "a" / "b"):
        (tmp_path / "a" / "b" / "result").touch()
    assert (tmp_path / "mine").is_dir()
    assert (tmp_path / "a" / "b" / "result").is_file()


def test_place_that_cannot_be_written_in_is_one_sentence(tmp_path):
    (tmp_path / "file").write_text("mine")
    with pytest.raises(ValueError, match=r"cannot write in .*file/run: Not a directory; choose another"):
        hold(tmp_path / "file" / "run").__enter__()
    assert Path(tmp_path / "file").read_text() == "mine"
