"""Every case runs in a child process of its own, one after the other: no side warms up or slows down another.

In the folder `benchmarks`

    python -m speed.children '{"section": "filter", "settings": {...}}'

prints progress to the error stream and one line of JSON, the case's figures, to standard output.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
import time
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from machine import load
from sidestep._compiled import cores
from speed import process

_BENCHMARKS = Path(__file__).parents[1]
MOST_SECONDS = 300
"""A case that takes longer is ended and says so."""


@dataclass(frozen=True)
class Case:
    """One side of a comparison: what `run(settings)` of the section is told, and how many threads it has.

    `environment` holds what the side's authors advise to set.
    """

    section: str
    name: str
    settings: dict[str, Any]
    threads: int = field(default_factory=cores)
    environment: dict[str, str] = field(default_factory=dict)


def run_case(case: Case) -> dict[str, Any]:
    """The figures of a case, with its settings, or with `missing` or `error` where it could not run."""
    about = {
        "name": case.name,
        "threads": case.threads,
        "settings": case.settings,
        "load_before": load(),
    }
    environment = process.thread_environment(case.threads, **case.environment)
    about["environment"] = {
        name: environment[name] for name in process.THREAD_SETTINGS if name in environment
    }
    task = json.dumps({"section": case.section, "settings": case.settings})
    begun = time.monotonic()
    try:
        done = subprocess.run(
            [sys.executable, "-m", "speed.children", task],
            env=environment,
            cwd=_BENCHMARKS,
            capture_output=True,
            text=True,
            timeout=MOST_SECONDS,
        )
    except subprocess.TimeoutExpired:
        return {**about, "error": f"took longer than {MOST_SECONDS} s"}
    lines = done.stdout.splitlines()
    if done.returncode or not lines:
        return {
            **about,
            "error": (done.stderr.strip().splitlines() or [f"exit status {done.returncode}"])[-1],
        }
    return {**about, **json.loads(lines[-1]), "wall_seconds": time.monotonic() - begun}


def _child(task: str) -> dict[str, Any]:
    from speed.peers import MissingPeer
    from speed.sections import section

    what = json.loads(task)
    try:
        figures = section(what["section"]).run(what["settings"])
    except MissingPeer as error:
        return {"missing": str(error)}
    # Not before: it imports JAX, and `startup` measures children of a small process.
    from sidestep.store.files import json_safe

    return json_safe({"peak_memory_mib": process.peak_memory_mib(), **figures})


def main() -> None:
    """Run one case; libraries that print do so to the error stream."""
    answer = os.dup(1)
    os.dup2(2, 1)
    figures = _child(sys.argv[1])
    os.write(answer, (json.dumps(figures) + "\n").encode())


if __name__ == "__main__":
    main()
