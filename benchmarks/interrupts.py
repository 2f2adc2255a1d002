"""What does Ctrl-C leave behind? Every long command, interrupted at random moments.

    python benchmarks/interrupts.py --out interrupts.json
    python benchmarks/interrupts.py train falsify --count 12 --busy 4

Each command is run once to its end, which gives the time within which it is interrupted later, imports and
compilation included. An interrupt is a fault unless the command ends with status 130, without a traceback, a
warning of Python or a core dump, leaves no half file, and everything that it left can be read. Where it says
how to go on, that line is pasted into a shell now and then and must finish the work.

`--busy` starts so many processes per core that only compute: on a loaded machine other moments are hit.
"""

from __future__ import annotations

import argparse
import json
import os
import random
import re
import resource
import shutil
import signal
import statistics
import subprocess
import sys
import tempfile
import time
from collections import Counter
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from sidestep.store.files import write_json

SMALL = ["--set", "episode_steps=200", "--learner", "hidden=[32, 32]", "batch_size=32", "warmup_decisions=40"]
CAMPAIGN = """kind = "evaluate"
[grid]
shield = ["none", "game"]
seed = [0, 1, 2, 3]
[settings]
episodes = 64
"""


@dataclass(frozen=True)
class Command:
    """`words` after `sidestep`; `{run}` is a small trained run, `{out}` what the command may write."""

    words: list[str]
    seconds: float | None = None
    """When to interrupt at the latest, for a command that does not end by itself."""


COMMANDS = {
    "train": Command(["train", "--out", "{out}/a run", "--shield", "game", "--episodes", "100", *SMALL]),
    "evaluate": Command(["evaluate", "--shield", "joint", "--episodes", "32", "--json", "{out}/e.json"]),
    "reproduce": Command(
        ["reproduce", "--out", "{out}/a study", "--shields", "none", "game", "--episodes", "8",
         "--evaluation-episodes", "32", *SMALL]
    ),
    "falsify": Command(
        ["falsify", "--out", "{out}/a search", "--shield", "game", "--episodes", "64", "--batch", "16",
         "--seconds", "6", "--attacks", "pursuers", "cross-entropy"]
    ),
    "campaign": Command(["campaign", "{run}/../grid.toml", "--out", "{out}/a grid", "--workers", "2"]),
    "twin": Command(
        ["twin", "--shield", "game", "--seeds", "3", "--steps", "200", "--out", "{out}/t", "--json",
         "{out}/t.json"]
    ),
    "fly": Command(
        ["fly", "--shield", "game", "--seeds", "3", "--steps", "150", "--out", "{out}/f", "--json",
         "{out}/f.json"]
    ),
    "play": Command(["play", "--port", "0", "--shield", "game"], seconds=12.0),
    "certify": Command(["certify", "--json", "{out}/c.json", "--figure", "{out}/c"]),
    "report": Command(["report", "{run}", "--out", "{out}/report.html", "--episodes", "40"]),
}  # fmt: skip
ADVICE = re.compile(r"(?:Continue|go on) with: (.+)")
TROUBLE = re.compile(r"Traceback|Segmentation fault|Fatal|core dumped|Exception ignored|Error\b|leaked")


def start(words: list[str], folder: Path) -> subprocess.Popen[str]:
    """`sidestep` with these words in a session of its own, so that nothing else hears its Ctrl-C."""
    return subprocess.Popen(
        [sys.executable, "-m", "sidestep", *words], cwd=folder, text=True, start_new_session=True,
        stdout=subprocess.PIPE, stderr=subprocess.STDOUT, env={**os.environ, "PYTHONFAULTHANDLER": "1"},
    )  # fmt: skip


def unreadable(folder: Path) -> list[str]:
    """Files below a folder that are cut off, damaged or left half written."""
    found = []
    for path in sorted(folder.rglob("*")):
        if path.suffix == ".tmp" or path.name.startswith("core"):
            found.append(f"{path.name} was left")
        elif path.is_file():
            try:
                if path.suffix == ".json":
                    json.loads(path.read_text())
                elif path.suffix == ".jsonl":
                    [json.loads(line) for line in path.read_text().splitlines()]
                elif path.suffix == ".npz":
                    with np.load(path, allow_pickle=False) as file:
                        [file[name] for name in file.files]
                elif path.suffix == ".png":
                    assert path.read_bytes().endswith(b"IEND\xaeB`\x82")
                elif path.suffix == ".html":
                    assert path.read_text().rstrip().endswith("</html>")
            except Exception as error:
                found.append(f"{path.name} is damaged ({error})")
    return found


class Study:
    """One command, interrupted again and again."""

    def __init__(self, name: str, run: Path, chance: random.Random, paste_every: int):
        self.command, self.run, self.chance, self.paste_every = COMMANDS[name], run, chance, paste_every
        self.within = 0.0
        self.faults: list[str] = []
        self.statuses: Counter[int] = Counter()
        self.waits: list[float] = []
        self.pasted = self.early = 0

    def words(self, out: Path) -> list[str]:
        return [word.format(run=self.run, out=out) for word in self.command.words]

    def measure(self) -> None:
        """How long the command takes when left alone; compiled programs are kept by it."""
        if self.command.seconds is not None:
            self.within = self.command.seconds
            return
        with tempfile.TemporaryDirectory() as out:
            begun = time.monotonic()
            child = start(self.words(Path(out)), Path(out))
            text, _ = child.communicate()
            if child.returncode:
                raise SystemExit(f"left alone it ended with {child.returncode}: {text[-2000:]}")
            self.within = time.monotonic() - begun

    def interrupt(self, number: int) -> None:
        """Once, at a random moment; a command that has ended by then is started again, and the next are
        interrupted within the time that it took: less than the first run, which compiled."""
        while True:
            out = Path(tempfile.mkdtemp())
            child, begun = start(self.words(out), out), time.monotonic()
            delay = self.chance.uniform(0.15, self.within)
            while child.poll() is None and time.monotonic() < begun + delay:
                time.sleep(0.005)
            ended = child.poll() is not None
            if ended and child.returncode == 0:
                self.within = time.monotonic() - begun
            begun = time.monotonic()
            child.send_signal(signal.SIGINT)
            text, _ = child.communicate()
            if not ended and child.returncode != 0:
                break
            shutil.rmtree(out)
        self.waits.append(time.monotonic() - begun)
        self.statuses[child.returncode] += 1
        # Until the first line of this package runs, Ctrl-C is Python's own affair. When the work is done, and
        # Python shuts down, it is the system's: a shell shows 130 for that too.
        if child.returncode != 130 and "sidestep" not in text:
            self.early += 1
        else:
            trouble = [f"status {child.returncode}"] if child.returncode not in (130, -signal.SIGINT) else []
            trouble += [line for line in text.splitlines() if TROUBLE.search(line)][:3] + unreadable(out)
            self.faults += [f"{delay:.2f} s: {what}" for what in trouble]
            advice = ADVICE.search(text)
            if advice is not None and number % self.paste_every == 0:
                self.paste(advice[1], out, delay)
        shutil.rmtree(out)

    def result(self) -> dict[str, object]:
        return {
            "interrupts": len(self.waits),
            "statuses": {str(status): count for status, count in self.statuses.items()},
            "before_the_first_line": self.early,
            "faults": self.faults,
            "advice_pasted": self.pasted,
            "seconds_alone": self.within,
            "seconds_to_end_median": statistics.median(self.waits),
            "seconds_to_end_longest": max(self.waits),
        }

    def paste(self, line: str, out: Path, delay: float) -> None:
        """What was printed, in a shell, must finish the work."""
        self.pasted += 1
        done = subprocess.run(["sh", "-c", line], cwd=out, capture_output=True, text=True)
        if done.returncode != 0 or unreadable(out):
            self.faults.append(
                f"{delay:.2f} s: pasted `{line}` ended with {done.returncode}: {done.stderr[-300:]}"
            )


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("commands", nargs="*", metavar="COMMAND", help=", ".join(COMMANDS))
    parser.add_argument("--count", type=int, default=50, help="interrupts of each command (50)")
    parser.add_argument("--busy", type=int, default=0, help="processes per core that only compute (0)")
    parser.add_argument("--paste-every", type=int, default=10, help="go on after every so manieth (10)")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--out", type=Path, help="JSON file to write")
    options = parser.parse_args()
    names = options.commands or list(COMMANDS)
    if unknown := set(names) - set(COMMANDS):
        parser.error(f"unknown: {', '.join(sorted(unknown))}; use some of {', '.join(COMMANDS)}")
    # Handed on to children: a background shell ignores Ctrl-C, and most systems write no core by default.
    signal.signal(signal.SIGINT, signal.default_int_handler)
    hard = resource.getrlimit(resource.RLIMIT_CORE)[1]
    resource.setrlimit(resource.RLIMIT_CORE, (hard, hard))
    busy = [
        subprocess.Popen([sys.executable, "-c", "while True: sum(range(100000))"])
        for _ in range(options.busy * len(os.sched_getaffinity(0)))
    ]
    results = {}
    with tempfile.TemporaryDirectory() as folder:
        run = Path(folder) / "run"
        (Path(folder) / "grid.toml").write_text(CAMPAIGN)
        try:
            prepare = start(
                ["train", "--out", str(run), "--shield", "game", "--episodes", "5", *SMALL], run.parent
            )
            if prepare.wait():
                raise SystemExit("the small run that others need could not be trained")
            for name in names:
                study = Study(name, run, random.Random(f"{options.seed} {name}"), options.paste_every)
                # Twice: the first time compiles what the others find compiled.
                study.measure()
                study.measure()
                for number in range(options.count):
                    study.interrupt(number)
                    results[name] = study.result()
                    if options.out is not None:
                        write_json(options.out, results)
                    if sys.stderr.isatty():
                        print(f"\r{name}: {number + 1} of {options.count}", end="", file=sys.stderr)
                print(
                    f"{name}: {options.count} interrupts within {study.within:.1f} s, "
                    f"{len(study.faults)} faults, {study.early} before the first line, "
                    f"{study.pasted} pasted; ended after {statistics.median(study.waits):.2f} s (median), "
                    f"{max(study.waits):.1f} s (longest)",
                    flush=True,
                )
                for fault in study.faults:
                    print(f"  {fault}", flush=True)
        finally:
            for process in busy:
                process.kill()
    return 1 if any(result["faults"] for result in results.values()) else 0


if __name__ == "__main__":
    sys.exit(main())
