"""The advice that names a missing package: it must work, though no index has `sidestep`."""

import importlib.metadata
import importlib.util
import json
import shlex
import shutil
import sys
from pathlib import Path

import pytest

from sidestep import _packages

PIP = ["-m", "pip", "install"]


@pytest.fixture
def installed_from(monkeypatch):
    """Makes `sidestep` seem installed from what `direct_url.json` says; None: there is no such file."""

    def pretend(origin):
        class Distribution:
            requires = importlib.metadata.requires("sidestep")

            def read_text(self, name):
                assert name == "direct_url.json"
                return None if origin is None else json.dumps(origin)

        monkeypatch.setattr(importlib.metadata, "distribution", lambda name: Distribution())

    return pretend


def advice(extra="gym"):
    words = shlex.split(_packages.install_extra(extra))
    assert words[1:4] == PIP
    return words[4:]


def test_from_an_editable_clone_the_advice_names_the_clone(installed_from, tmp_path):
    clone = tmp_path / "my clone"
    clone.mkdir()
    installed_from({"url": clone.as_uri(), "dir_info": {"editable": True}})
    assert advice() == ["-e", f"{clone}[gym]"]


def test_from_a_wheel_the_advice_names_that_very_file(installed_from, tmp_path):
    wheel = tmp_path / "sidestep-0.1.0-py3-none-any.whl"
    wheel.touch()
    installed_from({"url": wheel.as_uri(), "archive_info": {}})
    assert advice("logs") == [f"{wheel}[logs]"]


def test_from_a_repository_the_advice_names_its_commit(installed_from):
    installed_from({"url": "https://x.org/s.git", "vcs_info": {"vcs": "git", "commit_id": "ab12"}})
    assert advice() == ["sidestep[gym] @ git+https://x.org/s.git@ab12"]


@pytest.mark.parametrize("origin", [None, {"url": "file:///no/such/folder/sidestep.whl", "archive_info": {}}])
def test_when_the_origin_is_gone_or_unknown_the_advice_names_the_packages_themselves(installed_from, origin):
    installed_from(origin)
    named = advice("logs")
    assert sorted(requirement.split("<")[0] for requirement in named) == ["mcap", "mcap-ros2-support"]
    assert all(">=" in requirement for requirement in named)


def test_run_from_a_clone_without_installing_the_advice_names_the_clone(monkeypatch):
    def missing(name):
        raise importlib.metadata.PackageNotFoundError(name)

    monkeypatch.setattr(importlib.metadata, "distribution", missing)
    assert advice() == ["-e", f"{Path(_packages.__file__).parents[2]}[gym]"]


@pytest.mark.parametrize("uv", [True, False])
def test_an_environment_without_pip_is_not_sent_to_pip(monkeypatch, uv):
    """Those that uv makes have none."""
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None)
    monkeypatch.setattr(shutil, "which", lambda name: "/usr/bin/uv" if uv and name == "uv" else None)
    monkeypatch.setattr(sys, "executable", "/an env/bin/python")
    line = _packages.install("mcap>=1,<2")
    if uv:
        assert line == "uv pip install --python '/an env/bin/python' 'mcap>=1,<2'"
    else:
        assert line == "'/an env/bin/python' -m ensurepip && '/an env/bin/python' -m pip install 'mcap>=1,<2'"


def test_the_error_names_package_and_command_and_has_the_callers_class(monkeypatch):
    monkeypatch.setitem(sys.modules, "mcap", None)
    with pytest.raises(ZeroDivisionError, match=r"logs need the package 'mcap'.*pip install .*\[logs\]"):
        _packages.needed("mcap", "logs", "logs need", ZeroDivisionError)
