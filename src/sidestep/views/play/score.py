"""The visitor's score against each shield."""

from __future__ import annotations

from dataclasses import asdict, dataclass, field
from typing import Any


@dataclass
class Tally:
    """Against one shield: captures, collisions with obstacles, targets reached, longest survival (s)."""

    captured: int = 0
    collided: int = 0
    reached: int = 0
    longest: float = 0.0


@dataclass
class Score:
    """One tally per shield, and the time (s) since the present start."""

    tallies: dict[str, Tally] = field(default_factory=dict)
    survived: float = 0.0

    def of(self, shield: str) -> Tally:
        """The tally against this shield."""
        return self.tallies.setdefault(shield, Tally())

    def lasted(self, shield: str, period: float) -> None:
        """Add one survived period."""
        self.survived += period
        tally = self.of(shield)
        tally.longest = max(tally.longest, self.survived)

    def restart(self) -> None:
        """Restart the survival time."""
        self.survived = 0.0

    def to_dict(self) -> dict[str, Any]:
        """JSON values."""
        tallies = {name: asdict(tally) for name, tally in self.tallies.items()}
        for tally in tallies.values():
            tally["longest"] = round(tally["longest"], 2)
        return {"survived": round(self.survived, 2), "tallies": tallies}
