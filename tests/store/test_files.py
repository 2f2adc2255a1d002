"""Hazards of writing: a full disk, half a file, a device replaced by a file, an error nobody understands."""

import errno
import os
import pickle
import resource
import subprocess
import sys
from contextlib import contextmanager

import pytest

from sidestep.store.files import (
    OutputError,
    UnreadableError,
    append_bytes,
    make_folder,
    read_json,
    sweep,
    whole_file,
    write_bytes,
    write_json,
)


@contextmanager
def largest_file(size):
    """What a full disk does to a file, without one: no file may grow beyond `size` bytes."""
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, before[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)


@pytest.fixture
def small_disk(tmp_path):
    """A disk of 64 kB."""
    folder = tmp_path / "disk"
    folder.mkdir()
    options = ["-t", "tmpfs", "-o", "size=64k", "tmpfs"]
    if sys.platform != "linux" or subprocess.run(["mount", *options, folder], capture_output=True).returncode:
        pytest.skip("mounting a tmpfs is not permitted here")
    yield folder
    subprocess.run(["umount", "-l", folder], check=True)


def test_full_disk_is_one_sentence_and_keeps_the_old_file(small_disk):
    path = small_disk / "deep" / "summary.json"
    write_json(path, [1, 2, 3])
    with pytest.raises(OutputError, match=r"could not be written: no space left.*200\.0 kB needed, .* free"):
        write_bytes(path, bytes(200_000))
    assert read_json(path) == [1, 2, 3]
    assert [file.name for file in path.parent.iterdir()] == ["summary.json"]


def test_disk_full_only_when_synced_is_the_same_error(tmp_path, monkeypatch):
    def full(_):
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(os, "fsync", full)
    with pytest.raises(OutputError, match="no space left") as error:
        write_bytes(tmp_path / "a", b"a")
    assert error.value.full
    assert list(tmp_path.iterdir()) == []


def test_append_that_does_not_fit_leaves_what_was_there(tmp_path):
    path = tmp_path / "metrics.jsonl"
    path.write_bytes(b"one\n")
    with largest_file(1000), pytest.raises(OutputError, match="file too large"):
        append_bytes(path, b"x" * 2000)
    assert path.read_bytes() == b"one\n"
    append_bytes(path, b"two\n")
    assert path.read_bytes() == b"one\ntwo\n"


def test_error_of_a_library_that_writes_is_about_the_file_asked_for(tmp_path):
    path = tmp_path / "table.parquet"

    def write(beside):
        raise OutputError(beside, f"{beside} could not be written")

    with pytest.raises(OutputError) as error, whole_file(path) as beside:
        write(beside)
    assert str(error.value) == f"{path} could not be written"

    def fail(beside):
        beside.write_bytes(b"half")
        raise OSError("Error writing bytes to file: [Errno 28] No space left on device")

    words = r"table\.parquet could not be written: .*space"
    with pytest.raises(OutputError, match=words), whole_file(path) as beside:
        fail(beside)
    assert list(tmp_path.iterdir()) == []


def test_folder_below_a_file_is_one_sentence(tmp_path):
    (tmp_path / "file").write_text("")
    with pytest.raises(OutputError, match="could not be written"):
        make_folder(tmp_path / "file" / "below")
    with pytest.raises(OutputError, match="could not be written"):
        write_json(tmp_path / "file" / "below" / "a.json", {})


def test_standard_output_is_written_to_and_not_replaced(tmp_path):
    code = (
        "import sys; from sidestep.store.files import write_json; print('before');"
        "write_json('/dev/stdout', {'a': 1}); print('after')"
    )
    with open(tmp_path / "out", "wb") as out:
        subprocess.run([sys.executable, "-c", code], stdout=out, check=True)
    assert (tmp_path / "out").read_text().split() == ["before", "{", '"a":', "1", "}", "after"]
    assert not os.path.isfile("/dev/stdout") or os.path.islink("/dev/stdout")


@pytest.mark.skipif(not os.path.exists("/dev/full"), reason="there is no /dev/full")
def test_full_device_is_no_place_for_a_file():
    with pytest.raises(OutputError, match="/dev/full could not be written: no space left"):
        write_json("/dev/full", {})


def test_link_is_followed(tmp_path):
    (tmp_path / "elsewhere").mkdir()
    (tmp_path / "link.json").symlink_to(tmp_path / "elsewhere" / "file.json")
    write_json(tmp_path / "link.json", 1)
    assert (tmp_path / "link.json").is_symlink()
    assert read_json(tmp_path / "elsewhere" / "file.json") == 1


def test_error_crosses_from_a_worker_to_the_command():
    error = pickle.loads(pickle.dumps(OutputError("a", "a is full", full=True).and_kept("Kept: b")))
    assert (str(error), error.path.name, error.full) == ("a is full. Kept: b", "a", True)


def test_file_that_is_missing_or_no_json_is_named(tmp_path):
    with pytest.raises(UnreadableError, match=r"a\.json does not exist"):
        read_json(tmp_path / "a.json")
    (tmp_path / "a.json").write_text("{")
    with pytest.raises(UnreadableError, match=r"a\.json is not readable JSON"):
        read_json(tmp_path / "a.json")


def test_what_kills_left_is_swept_and_what_is_in_use_stays(tmp_path):
    gone = subprocess.Popen([sys.executable, "-c", ""])
    gone.wait()
    deep = tmp_path / "results"
    deep.mkdir()
    for process in (gone.pid, os.getpid()):
        (deep / f".summary.json.{process}.tmp").touch()
        (deep / f".sidestep-{process}-x" / "below").mkdir(parents=True)
        (deep / f".sidestep-{process}-x" / "below" / f".probe.{process}.tmp").touch()
    result, old = (f".job.{letter * 32}.tmp" for letter in "ab")
    for name in (result, old, ".somebodys.tmp", "kept.tmp"):
        (deep / name).touch()
    for name in (old, ".somebodys.tmp", "kept.tmp"):
        os.utime(deep / name, (0, 0))
    sweep(tmp_path)
    assert sorted(path.name for path in deep.iterdir()) == [
        result,
        f".sidestep-{os.getpid()}-x",
        ".somebodys.tmp",
        f".summary.json.{os.getpid()}.tmp",
        "kept.tmp",
    ]
    assert list((deep / f".sidestep-{os.getpid()}-x").rglob("*.tmp"))


def test_sweep_passes_over_a_folder_that_vanishes_meanwhile(tmp_path, monkeypatch):
    (tmp_path / "a").mkdir()
    (tmp_path / "b").mkdir()
    scandir = os.scandir

    def vanishing(place):
        if os.fspath(place).endswith("b"):
            os.rmdir(place)
        return scandir(place)

    monkeypatch.setattr(os, "scandir", vanishing)
    sweep(tmp_path)
    assert [path.name for path in tmp_path.iterdir()] == ["a"]
