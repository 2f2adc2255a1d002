"""Advice that is printed must work when it is pasted."""

import shlex
import subprocess
import sys
from pathlib import Path

import pytest

from sidestep import _program


def environment(folder, with_script=True):
    """A folder like an environment's bin/, with a script that prints its arguments, one a line."""
    folder.mkdir(parents=True)
    if with_script:
        script = folder / "sidestep"
        script.write_text('#!/bin/sh\nprintf "%s\\n" "$@"\n')
        script.chmod(0o755)
    return folder


@pytest.mark.parametrize("on_path", [True, False])
def test_a_command_with_spaces_and_quotes_works_when_pasted(tmp_path, monkeypatch, on_path):
    bin_folder = environment(tmp_path / "my env" / "bin")
    monkeypatch.setattr(sys, "executable", str(bin_folder / "python"))
    monkeypatch.setenv("PATH", f"{bin_folder}:/usr/bin:/bin" if on_path else "/usr/bin:/bin")
    monkeypatch.chdir(tmp_path)
    line = _program.command("train", "--out", "it's here", 3)
    assert shlex.split(line)[0] == ("sidestep" if on_path else "my env/bin/sidestep")
    pasted = subprocess.run(["sh", "-c", line], capture_output=True, text=True, check=True)
    assert pasted.stdout.splitlines() == ["train", "--out", "it's here", "3"]


def test_another_environments_script_on_the_path_is_not_named(tmp_path, monkeypatch):
    ours, other = environment(tmp_path / "a/bin"), environment(tmp_path / "b/bin")
    monkeypatch.setattr(sys, "executable", str(ours / "python"))
    monkeypatch.setenv("PATH", str(other))
    assert _program.command() == str(ours / "sidestep")


def test_without_a_script_the_module_is_named(tmp_path, monkeypatch):
    ours = environment(tmp_path / "a/bin", with_script=False)
    monkeypatch.setattr(sys, "executable", str(ours / "python"))
    monkeypatch.setenv("PATH", str(tmp_path))
    assert _program.command("play") == f"{ours}/python -m sidestep play"


def test_this_environments_own_script_exists():
    assert Path(shlex.split(_program.command())[0]).name in ("sidestep", Path(sys.executable).name)


@pytest.mark.parametrize("active", [True, False])
def test_the_python_named_is_this_environments(tmp_path, monkeypatch, active):
    """The interpreters of two environments are links to one file: the file does not tell them apart."""
    for name in ("ours", "other"):
        (tmp_path / name / "bin").mkdir(parents=True)
        (tmp_path / name / "bin/python").symlink_to(sys.executable)
    monkeypatch.setattr(sys, "executable", str(tmp_path / "ours/bin/python"))
    monkeypatch.setenv("PATH", str(tmp_path / ("ours" if active else "other") / "bin"))
    monkeypatch.chdir(tmp_path)
    assert _program.python() == ("python" if active else "ours/bin/python")
