"""Does a kill at any moment lose or change anything? Kills a command again and again, and resumes it.

    python benchmarks/kills.py train --kills 200
    python benchmarks/kills.py reproduce --kills 200 --seed 1
    python benchmarks/kills.py campaign --kills 200

First the command runs undisturbed. Then it runs again, in another folder, and is killed (SIGKILL) at random
moments: while it starts, while it works, and while it writes a file. After each kill it is resumed: `train`
and `reproduce` with `--resume`, `campaign` with the same command. A run that comes to its end is compared
with the undisturbed one, and the next begins, until there have been as many kills as asked for; the last one
is then left to end. Metrics, policies, checkpoints, evaluations, recordings and summaries must be the same
bit for bit; only times and places may differ.

One line says what came of it; the exit status is 1 if anything differed, or a resume failed.
"""

import argparse
import json
import os
import random
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

SMALL = ["episode_steps=60"]
LEARNER = ["hidden=[8,8]", "batch_size=8", "warmup_decisions=10", "replay_capacity=64"]
CAMPAIGN = """
kind = "train"
[grid]
scenario = "short"
shield = ["none", "paper"]
seed = [0, 1]
learner = "small"
[scenarios.short]
episode_steps = 60
[learners.small]
hidden = [8, 8]
batch_size = 8
warmup_decisions = 10
replay_capacity = 64
[settings]
episodes = 20
evaluation_episodes = 8
"""
# Checkpoints every 0.2 s instead of every 20, so that short runs have many. The compiled programs are kept
# before anything imports JAX, as the command does it.
CHILD = """
import inspect, sys
from sidestep._compiled import keep_compiled_programs
keep_compiled_programs()
import sidestep.learning
inspect.unwrap(sys.modules["sidestep.learning.run"].train).__kwdefaults__["checkpoint_seconds"] = 0.2
from sidestep.cli import main
if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
"""
TIMES = {"wall_seconds", "training_wall_seconds", "seconds", "ended", "host", "process", "token"}
"""Entries of JSON files that may differ."""
OTHER = {"curves", "figures", "locks", ".lock", ".lock.json", "report.html", "results.parquet"}
"""Files and folders with times of day in them, or drawn from what is compared already."""


def words(command: str, out: Path, work: Path, episodes: int) -> list[str]:
    """The command's arguments, with `--resume` where there is something to resume."""
    if command == "campaign":
        file = work / "campaign.toml"
        file.write_text(CAMPAIGN)
        return ["campaign", str(file), "--out", str(out), "--workers", "2"]
    resume = (out / "config.json").is_file()
    if resume:
        return [command, "--out", str(out), "--resume"]
    given = ["--episodes", str(episodes), "--set", *SMALL, "--learner", *LEARNER]
    if command == "train":
        return ["train", "--out", str(out), "--shield", "none", *given]
    return [
        "reproduce",
        "--out",
        str(out),
        "--shields",
        "none",
        "paper",
        "--evaluation-episodes",
        "8",
        *given,
    ]


class Child:
    """The command in a process group of its own."""

    def __init__(self, arguments: list[str], log: Path):
        script = log.with_name("child.py")
        script.write_text(CHILD)
        with open(log, "wb") as shown:
            self.process = subprocess.Popen(
                [sys.executable, str(script), *arguments], stdout=shown, stderr=subprocess.STDOUT,
                start_new_session=True,
            )  # fmt: skip

    def ended(self) -> bool:
        return self.process.poll() is not None

    def kill(self, group: bool) -> None:
        """End the process, or with `group` those that it has started too."""
        if group:
            os.killpg(self.process.pid, signal.SIGKILL)
        else:
            self.process.kill()
        self.process.wait()


def files_in(out: Path) -> Iterator[Path]:
    """The files below a folder in which others come and go meanwhile: `rglob` raises where a folder goes."""
    return (Path(inside, name) for inside, _, names in os.walk(out) for name in names)


def measured(out: Path) -> int:
    """Bytes of what has been measured so far."""
    return sum(path.stat().st_size for path in files_in(out) if path.name == "metrics.jsonl")


def writes(out: Path) -> set[Path]:
    """The files that are being written, or were when a kill came."""
    return {path for path in files_in(out) if path.name.startswith(".") and path.suffix == ".tmp"}


def wait(child: Child, out: Path, sort: str | None, first: float, work: float, chance: random.Random) -> None:
    """Wait for a random moment of this sort, for the end without one; ends when the child does.

    **Arguments:** `first` seconds from the start to the first measurement, `work` from there to the end.
    """
    begun, left, before = time.monotonic(), writes(out), measured(out)
    if sort == "starting":
        until = begun + chance.uniform(0.0, first)
        while not child.ended() and time.monotonic() < until:
            time.sleep(0.002)
    elif sort == "working":
        while not child.ended() and measured(out) <= before:
            time.sleep(0.002)
        until = time.monotonic() + chance.uniform(0.0, work)
        while not child.ended() and time.monotonic() < until:
            time.sleep(0.002)
    elif sort == "writing":
        seen, wanted = left, len(left) + chance.randint(1, 4)
        while not child.ended() and len(seen) < wanted:
            # Names repeat: one file is written again and again.
            seen = seen | {path.with_name(f"{path.name}{measured(out)}") for path in writes(out) - left}
            time.sleep(0.0005)
    else:
        child.process.wait()


def contents(out: Path) -> dict[str, Any]:
    """What must be the same, by file."""
    found: dict[str, Any] = {}
    paths = sorted(files_in(out))
    kept = {path.parent for path in paths if path.parent.name == "checkpoints"}
    newest = {folder: max(folder.glob("*.npz"), default=None) for folder in kept}
    for path in paths:
        name = path.relative_to(out)
        # What a worker of a campaign was writing when it was killed stays beside the results.
        torn = path.suffix == ".tmp" and name.parts[0] == "results"
        if OTHER & set(name.parts) or path.suffix == ".toml" or torn:
            continue
        if path.parent in newest and path != newest[path.parent]:
            continue
        if path.suffix == ".npz":
            with np.load(path, allow_pickle=False) as file:
                # A checkpoint's manifest has the time it took in it; its digest covers all else.
                arrays = {
                    key: file[key] for key in file.files if path.parent not in newest or key != "manifest"
                }
            found[str(name)] = {key: (a.dtype.str, a.shape, a.tobytes()) for key, a in arrays.items()}
        elif path.suffix == ".json":
            found[str(name)] = timeless(json.loads(path.read_text()))
        else:
            found[str(name)] = path.read_bytes()
    return found


def timeless(value: Any) -> Any:
    if isinstance(value, dict):
        return {key: timeless(item) for key, item in value.items() if key not in TIMES | {"sha256"}}
    return [timeless(item) for item in value] if isinstance(value, list) else value


def differing(undisturbed: dict[str, Any], killed: dict[str, Any]) -> list[str]:
    """Names of the files that are missing, too many, or not the same."""
    names = sorted({*undisturbed, *killed})
    return [name for name in names if name not in undisturbed or undisturbed[name] != killed.get(name)]


def study(
    command: str, kills: int, seed: int, episodes: int, work: Path
) -> tuple[dict[str, int], int, list[str]]:
    """Kill and resume.

    **Returns** how many kills there were of which sort, how many runs came to their end, and what was wrong.
    """
    chance, log = random.Random(seed), work / "log.txt"

    def failed(child: Child) -> list[str]:
        code = child.process.returncode
        return [] if code == 0 else [f"exit status {code}: {log.read_text(errors='replace')[-2000:]}"]

    started, first = time.monotonic(), None
    child = Child(words(command, work / "undisturbed", work, episodes), log)
    try:
        while not child.ended():
            if first is None and measured(work / "undisturbed"):
                first = time.monotonic() - started
            time.sleep(0.01)
        total = time.monotonic() - started
        first = total if first is None else first
        if problems := failed(child):
            return {}, 0, problems
        undisturbed = contents(work / "undisturbed")

        counts = {"starting": 0, "working": 0, "writing": 0}
        runs, done = 1, 0
        while True:
            out = work / f"killed{runs}"
            child = Child(words(command, out, work, episodes), log)
            sort = chance.choice(list(counts)) if done < kills else None
            wait(child, out, sort, first, total - first, chance)
            if sort is not None and not child.ended():
                # Workers die with the command, or are left behind by it.
                child.kill(group=chance.random() < 0.5)
                done, counts[sort] = done + 1, counts[sort] + 1
                print(f"\r{done} of {kills} kills, run {runs}", end="", file=sys.stderr)
                continue
            wrong = failed(child) or differing(undisturbed, contents(out))
            if wrong or done >= kills:
                print(file=sys.stderr)
                return counts, runs, wrong
            runs += 1
    finally:
        if not child.ended():
            child.kill(group=True)


def main(arguments: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("command", choices=("train", "reproduce", "campaign"))
    parser.add_argument("--kills", type=int, default=20)
    parser.add_argument("--seed", type=int, default=0, help="of the moments")
    parser.add_argument("--episodes", type=int, default=60, help="training episodes of train and reproduce")
    asked = parser.parse_args(arguments)
    with tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as work:
        counts, runs, wrong = study(asked.command, asked.kills, asked.seed, asked.episodes, Path(work))
    moments = ", ".join(f"{count} while {sort}" for sort, count in counts.items())
    result = "all the same bit for bit" if not wrong else f"NOT the same: {'; '.join(wrong)}"
    print(f"{asked.command}: {sum(counts.values())} kills ({moments}), {runs} runs to the end: {result}")
    return 1 if wrong else 0


if __name__ == "__main__":
    sys.exit(main())
