"""How long a user waits: importing, asking for help, and the first result of commands in a fresh process."""

from __future__ import annotations

import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

from speed.children import Case
from speed.process import peak_memory_of_children_mib
from speed.timing import spread

CLI = ["-m", "sidestep"]
COMMANDS: dict[str, list[str]] = {
    "python -c pass": ["-c", "pass"],
    "import jax": ["-c", "import jax"],
    "import sidestep": ["-c", "import sidestep"],
    "from sidestep import evaluate": ["-c", "from sidestep import evaluate"],
    "sidestep --help": [*CLI, "--help"],
    "sidestep evaluate --help": [*CLI, "evaluate", "--help"],
}
FIRST_RESULTS: dict[str, list[str]] = {
    "sidestep evaluate, 100 episodes, game": [*CLI, "evaluate", "--episodes", "100", "--shield", "game"],
    "sidestep evaluate, 100 episodes, joint": [*CLI, "evaluate", "--episodes", "100", "--shield", "joint"],
    "sidestep train, 2 episodes, game": [
        *CLI,
        "train",
        "--episodes",
        "2",
        "--shield",
        "game",
        "--out",
        "RUN",
    ],
}
"""Commands that compile; timed with an empty cache folder, and once more with what that left."""


def cases(quick: bool) -> list[Case]:
    """What costs no compilation, repeated; and first results, cold and warm."""
    repeats = {"repeats": 2 if quick else 7}
    made = [Case("startup", name, {"command": name, **repeats}) for name in COMMANDS]
    return made if quick else made + [Case("startup", name, {"command": name}) for name in FIRST_RESULTS]


def run(settings: dict[str, Any]) -> dict[str, Any]:
    """Seconds of the whole process."""
    name = settings["command"]
    if name in COMMANDS:
        _seconds(COMMANDS[name], {})
        return {
            "latency": spread([_seconds(COMMANDS[name], {}) for _ in range(settings["repeats"])], "ms"),
            "peak_memory_mib": peak_memory_of_children_mib(),
        }
    with tempfile.TemporaryDirectory() as folder:
        caches = {"XDG_CACHE_HOME": str(Path(folder) / "cache")}
        seconds = []
        for time_ in ("cold", "warm"):
            command = [part.replace("RUN", str(Path(folder) / time_)) for part in FIRST_RESULTS[name]]
            seconds.append(_seconds(command, caches))
    return {
        "cold_seconds": seconds[0],
        "warm_seconds": seconds[1],
        "peak_memory_mib": peak_memory_of_children_mib(),
    }


def _seconds(arguments: list[str], environment: dict[str, str]) -> float:
    begun = time.perf_counter()
    done = subprocess.run(
        [sys.executable, *arguments],
        env={**os.environ, **environment},
        stdout=subprocess.DEVNULL,
        stderr=subprocess.PIPE,
        text=True,
    )
    spent = time.perf_counter() - begun
    if done.returncode:
        raise RuntimeError(f"{' '.join(arguments)} failed: {done.stderr.strip()[-500:]}")
    return spent


def summary(results: list[dict[str, Any]]) -> dict[str, Any]:
    """Median seconds of each, cold and warm where it compiles."""
    report: dict[str, Any] = {}
    for one in results:
        if "latency" in one:
            report[one["name"]] = one["latency"]["p50"] / 1000.0
        elif "cold_seconds" in one:
            report[one["name"]] = {"cold": one["cold_seconds"], "warm": one["warm_seconds"]}
    return report
