"""What a search is told, what it counts, and what it gives back."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from sidestep._bounds import DURATION, SEED, SIDE_BY_SIDE, bounded
from sidestep.trials.falsification.attacks import ATTACKS

COUNTERS = (
    "rounds",
    "episodes",
    "control_periods",
    "seconds",
    "captured",
    "collided",
    "unconfirmed",
    "pursuer_invalid",
)
"""What a `Tally` adds up over rounds."""
LEAST = ("pursuer_clearance", "obstacle_clearance", "margin")
"""What a `Tally` keeps the least of."""


@dataclass(frozen=True)
class Plan:
    """What is searched for, and how: everything that a resumed search must not change.

    `batch` chases or plans at once; `seconds` the longest chase; `most` counterexamples kept per attack and
    outcome (more only if they get 0.1 mm deeper, or broke no assumption).
    """

    seed: int = bounded(0, SEED)
    goal: str = "both"
    attacks: tuple[str, ...] = ATTACKS
    batch: int = bounded(256, SIDE_BY_SIDE)
    seconds: float = bounded(60.0, DURATION)
    most: int = bounded(5, least=1)
    guaranteed_clearance: float | None = bounded(None, infinite=True)


@dataclass
class Tally:
    """What one attack has come to. Clearances and margin: the least, m. `first` s into the search;
    `pursuer_invalid` periods in which an attack's wheel speeds were not finite."""

    rounds: int = 0
    episodes: int = 0
    control_periods: int = 0
    seconds: float = 0.0
    captured: int = 0
    collided: int = 0
    unconfirmed: int = 0
    pursuer_invalid: int = 0
    pursuer_clearance: float = np.inf
    obstacle_clearance: float = np.inf
    margin: float = np.inf
    first: float | None = None
    kept: list[dict[str, Any]] = field(default_factory=list)

    def add(self, line: Mapping[str, Any]) -> None:
        """Count one round, as its line in `metrics.jsonl` says."""
        for name in COUNTERS:
            setattr(self, name, getattr(self, name) + (1 if name == "rounds" else line.get(name, 0)))
        for name in LEAST:
            value = line[name]
            setattr(self, name, min(getattr(self, name), np.inf if value is None else value))
        self.kept += line["counterexamples"]
        if self.first is None and line["counterexamples"]:
            self.first = line["at"]

    def deepest(self, outcome: str) -> tuple[int, float]:
        """How many counterexamples with this outcome are kept, and the least clearance among them."""
        name = clearance_of(outcome)
        depths = [entry[name] for entry in self.kept if entry["outcome"] == outcome]
        return len(depths), min(depths, default=np.inf)


@dataclass(frozen=True)
class Progress:
    """Where the search is: the attack that has just played a round, its tally, and all of them."""

    attack: str
    tally: Tally
    tallies: Mapping[str, Tally]
    seconds: float
    budget: float | None

    @property
    def counterexamples(self) -> int:
        """Counterexamples kept so far."""
        return sum(len(tally.kept) for tally in self.tallies.values())


@dataclass(frozen=True)
class Falsification:
    """A search and what it found. `folder/counterexamples` holds one file per counterexample kept.

    `had_ended`: it was resumed, but had had its time or its episodes.
    """

    folder: Path
    summary: Mapping[str, Any]
    tallies: Mapping[str, Tally]
    interrupted: bool
    had_ended: bool = False

    @property
    def counterexamples(self) -> list[Path]:
        """Files of the counterexamples kept, in the order in which they were found."""
        entries = [entry for tally in self.tallies.values() for entry in tally.kept]
        return [self.folder / entry["file"] for entry in sorted(entries, key=lambda entry: entry["at"])]

    @property
    def inside(self) -> list[Path]:
        """Files of those that broke no assumption."""
        entries = [entry for tally in self.tallies.values() for entry in tally.kept]
        return [self.folder / entry["file"] for entry in entries if entry["assumption"] is None]


def clearance_of(outcome: str) -> str:
    """Which clearance says how deep an outcome went."""
    return "pursuer_clearance" if outcome == "captured" else "obstacle_clearance"
