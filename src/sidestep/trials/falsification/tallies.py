"""The plan, the counts and the result of a search."""

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
"""Fields that a `Tally` sums over rounds."""
LEAST = ("pursuer_clearance", "obstacle_clearance", "margin")
"""Fields of which a `Tally` keeps the minimum."""


@dataclass(frozen=True)
class Plan:
    """The settings of a search, which a resume must not change.

    `batch` chases or plans at once; `seconds` the longest chase; `most` counterexamples kept per attack and
    outcome (more only if they are 0.1 mm deeper, or broke no assumption).
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
    """The totals of one attack. Clearances and margin: the least, m. `first`: time (s) of the first
    counterexample; `pursuer_invalid`: control periods in which the attack's wheel speeds were not finite."""

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
        """Add one round, given by its line of `metrics.jsonl`."""
        for name in COUNTERS:
            setattr(self, name, getattr(self, name) + (1 if name == "rounds" else line.get(name, 0)))
        for name in LEAST:
            value = line[name]
            setattr(self, name, min(getattr(self, name), np.inf if value is None else value))
        self.kept += line["counterexamples"]
        if self.first is None and line["counterexamples"]:
            self.first = line["at"]

    def deepest(self, outcome: str) -> tuple[int, float]:
        """The number of counterexamples kept with this outcome, and the least clearance (m) among them."""
        name = clearance_of(outcome)
        depths = [entry[name] for entry in self.kept if entry["outcome"] == outcome]
        return len(depths), min(depths, default=np.inf)


@dataclass(frozen=True)
class Progress:
    """The progress of a search: the attack that has just finished a round, its tally, and all tallies."""

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
    """The result of a search. `folder/counterexamples` holds one file per counterexample kept.

    `had_ended`: the search was resumed but had already used its time or its episodes.
    """

    folder: Path
    summary: Mapping[str, Any]
    tallies: Mapping[str, Tally]
    interrupted: bool
    had_ended: bool = False

    @property
    def counterexamples(self) -> list[Path]:
        """Files of the counterexamples kept, in the order of discovery."""
        entries = [entry for tally in self.tallies.values() for entry in tally.kept]
        return [self.folder / entry["file"] for entry in sorted(entries, key=lambda entry: entry["at"])]

    @property
    def inside(self) -> list[Path]:
        """Files of the counterexamples that broke no assumption."""
        entries = [entry for tally in self.tallies.values() for entry in tally.kept]
        return [self.folder / entry["file"] for entry in entries if entry["assumption"] is None]


def clearance_of(outcome: str) -> str:
    """The name of the clearance that measures the depth of an outcome."""
    return "pursuer_clearance" if outcome == "captured" else "obstacle_clearance"
