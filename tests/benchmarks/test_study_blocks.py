"""Hazards of a study in blocks: two programs write one report, or one goes on with another's settings."""

import json
import subprocess
import sys
from pathlib import Path

import pytest

import study_blocks

CODE = "import sys, pathlib, study_blocks; study_blocks.earlier(pathlib.Path(sys.argv[1]), {})"


def test_a_second_study_ends_while_one_is_at_work(tmp_path):
    report = tmp_path / "report.json"
    assert study_blocks.earlier(report, {}) == {}
    command = [sys.executable, "-c", CODE, str(report)]
    second = subprocess.run(command, cwd=Path(study_blocks.__file__).parent, capture_output=True, text=True)
    assert second.returncode == 1
    assert "another study writes there" in second.stderr
    other = tmp_path / "other.json"
    assert subprocess.run([*command[:-1], str(other)], cwd=Path(study_blocks.__file__).parent).returncode == 0


def test_other_settings_are_refused(tmp_path):
    report = tmp_path / "report.json"
    report.write_text(json.dumps({"settings": {"seed": 1}}))
    with pytest.raises(SystemExit, match="other settings"):
        study_blocks.earlier(report, {"seed": 2})
