"""Compiled programs are kept between processes, where the user wants it and nowhere else."""

import os
import subprocess
import sys

import pytest

from sidestep._compiled import cache_folder, keep_compiled_programs

PROGRAM = """
from sidestep._compiled import keep_compiled_programs
keep_compiled_programs()
import jax, jax.monitoring
events = []
jax.monitoring.register_event_listener(lambda event, **_: events.append(event))
answer = float(jax.jit(lambda x: (x @ x).sum())(jax.numpy.ones((3, 3))))
print(answer, sum("cache_hits" in event for event in events))
"""


def _run(**environment):
    kept = {name: value for name, value in os.environ.items() if not name.startswith(("JAX_", "SIDESTEP"))}
    done = subprocess.run(
        [sys.executable, "-W", "error", "-c", PROGRAM],
        env={
            **kept,
            "JAX_PLATFORMS": "cpu",
            "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS": "0",
            **environment,
        },
        capture_output=True,
        text=True,
    )
    assert done.returncode == 0, done.stderr
    answer, hits = done.stdout.split()
    assert float(answer) == 27.0
    return int(hits)


def test_a_second_process_loads_what_the_first_compiled(tmp_path):
    folder = tmp_path / "kept"
    assert _run(SIDESTEP_CACHE=str(folder)) == 0
    assert any(folder.iterdir())
    assert _run(SIDESTEP_CACHE=str(folder)) > 0


def test_a_folder_that_cannot_be_made_is_done_without(tmp_path):
    (tmp_path / "file").write_text("", encoding="utf-8")
    assert _run(SIDESTEP_CACHE=str(tmp_path / "file" / "below")) == 0


@pytest.mark.parametrize(
    "environment, ends",
    [
        ({"SIDESTEP_CACHE": "off"}, None),
        ({"SIDESTEP_CACHE": "/elsewhere"}, "/elsewhere"),
        ({"XDG_CACHE_HOME": "/caches"}, "/caches/sidestep"),
        ({"HOME": "/home/somebody"}, "sidestep"),
    ],
)
def test_the_folder_is_the_users_to_choose(monkeypatch, environment, ends):
    for name in ("SIDESTEP_CACHE", "XDG_CACHE_HOME"):
        monkeypatch.delenv(name, raising=False)
    for name, value in environment.items():
        monkeypatch.setenv(name, value)
    folder = cache_folder()
    assert folder is None if ends is None else str(folder).endswith(ends)


def test_a_library_user_who_has_imported_jax_keeps_their_own_settings(monkeypatch, tmp_path):
    monkeypatch.delenv("JAX_COMPILATION_CACHE_DIR", raising=False)
    monkeypatch.setenv("SIDESTEP_CACHE", str(tmp_path / "kept"))
    keep_compiled_programs()
    assert "JAX_COMPILATION_CACHE_DIR" not in os.environ
    assert not (tmp_path / "kept").exists()
