"""Hazards of outputs: refused after hours of work, tried and left behind, one written over the other."""

import os

import pytest

from sidestep.store.files import OutputError
from sidestep.store.outputs import try_outputs


def test_trying_leaves_nothing_behind(tmp_path):
    (tmp_path / "old.json").write_text("old")
    (tmp_path / "there").mkdir()
    try_outputs(
        files=[tmp_path / "old.json", tmp_path / "a" / "b" / "new.json", None],
        new=[tmp_path / "log.mcap", None],
        folders=[tmp_path / "there", tmp_path / "run" / "deep", None],
    )
    assert sorted(path.name for path in tmp_path.iterdir()) == ["old.json", "there"]
    assert (tmp_path / "old.json").read_text() == "old"
    assert not list((tmp_path / "there").iterdir())


@pytest.mark.parametrize(
    "kind, name, words",
    [
        ("files", "folder", "is a folder"),
        ("files", "file/below.json", "is not a folder"),
        ("files", "n" * 300, "too long"),
        ("new", "file", "exists already"),
        ("new", "folder", "exists already"),
        ("folders", "file", "is a file, not a folder"),
        ("folders", "file/below/deep", "is not a folder"),
    ],
)
def test_what_cannot_be_written_is_refused(tmp_path, kind, name, words):
    (tmp_path / "file").write_text("mine")
    (tmp_path / "folder").mkdir()
    with pytest.raises(OutputError, match=words):
        try_outputs(**{kind: [tmp_path / name]})
    assert (tmp_path / "file").read_text() == "mine"
    assert sorted(path.name for path in tmp_path.iterdir()) == ["file", "folder"]


def test_two_outputs_of_one_name_are_refused(tmp_path):
    with pytest.raises(OutputError, match="two outputs"):
        try_outputs(files=[tmp_path / "a"], new=[tmp_path / "b" / ".." / "a"])
    with pytest.raises(OutputError, match=r"to be a folder, and .* a file"):
        try_outputs(files=[tmp_path / "a"], folders=[tmp_path / "a" / "run"])


@pytest.mark.skipif(os.geteuid() == 0, reason="root writes where it likes")
def test_folder_without_permission_is_refused(tmp_path):
    tmp_path.chmod(0o500)
    with pytest.raises(OutputError, match="permission denied"):
        try_outputs(files=[tmp_path / "a"])


def test_devices_and_pipes_are_outputs(tmp_path):
    os.mkfifo(tmp_path / "pipe")
    try_outputs(files=[tmp_path / "pipe", "/dev/null", "/dev/null"], new=["/dev/null", "/dev/stdout"])
    if os.path.exists("/dev/full"):
        with pytest.raises(OutputError, match="no space left"):
            try_outputs(files=["/dev/full"])
