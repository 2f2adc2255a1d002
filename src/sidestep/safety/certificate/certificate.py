"""What does a certificate say?"""

from __future__ import annotations

import math
from dataclasses import asdict, dataclass
from typing import Any

from sidestep.safety.certificate.nearest_changes import Change, PairChange
from sidestep.safety.certificate.obstacles import ObstacleClearance
from sidestep.safety.certificate.shield_check import ShieldLevel
from sidestep.safety.certificate.situation import Situation
from sidestep.safety.certificate.survival import Survival
from sidestep.safety.sampled.sampled_game import Design


@dataclass(frozen=True)
class Claim:
    """One statement; `kind` is `proved`, `computed`, `measured` or `not claimed`."""

    kind: str
    text: str


@dataclass(frozen=True)
class Certificate:
    """What is guaranteed. Lengths in m; an infinite length means that there is no limit.

    - `guaranteed`: capture within the capture distance is impossible, for ever, from every start outside
      `start_set`; `reason` says why, or why not
    - `guaranteed_clearance`: the largest distance that can be guaranteed with these robots, errors and
      period, whatever the capture distance; 0 where nothing is guaranteed
    - `margin` = `guaranteed_clearance` - capture distance; negative: by how much the guarantee fails
    - `budget`: parts of l' - l, their `total`, and `required` = l'
    - `control_set`: what the certified law never lets the evader into (true positions), or None;
      `start_set` the same grown by the measurement errors (measured positions)
    - `start_margin`: signed distance of the asked start from `start_set`, or None
    - `nearest_changes` of each parameter alone that would make it hold, `nearest_pairs` of two of mine
    - `grid_error`: how much the computed clearance may still be below the true one (it is never above)
    - `shield`: the level of the `game` shield, `survival` where the pursuer wins
    - `obstacles`: what can be kept from an obstacle beside the pursuer, where asked for; or `no_obstacles`,
    why
      nothing can be said
    """

    situation: Situation
    guaranteed: bool
    reason: str
    pursuer_wins: bool
    guaranteed_clearance: float
    largest_capture_distance: float
    budget: dict[str, float]
    grid_error: float
    nearest_changes: tuple[Change, ...]
    nearest_pairs: tuple[PairChange, ...]
    control_set: Design | None
    start_set: Design | None
    start: tuple[float, float] | None = None
    start_margin: float | None = None
    shield: ShieldLevel | None = None
    survival: Survival | None = None
    target_distance: float | None = None
    obstacles: ObstacleClearance | None = None
    no_obstacles: str | None = None
    claims: tuple[Claim, ...] = ()

    @property
    def margin(self) -> float:
        """Guaranteed clearance less the capture distance, m."""
        return self.guaranteed_clearance - self.situation.capture_distance

    @property
    def target(self) -> str | None:
        """Whether the target is reached before capture: see `Survival.target`; None where not asked."""
        if self.target_distance is None or self.survival is None:
            return None
        return self.survival.target(self.target_distance, self.situation.game.evader_speed)

    def to_dict(self) -> dict[str, Any]:
        """All figures as plain values; `sidestep certify --json` writes them, infinite ones as null."""
        figures = asdict(self)
        figures["situation"] = {**figures["situation"].pop("game"), **figures["situation"]}
        figures |= {"margin": self.margin, "target": self.target}
        for shown, change in zip(figures["nearest_changes"], self.nearest_changes, strict=True):
            shown["share"] = change.share
        figures["unlimited"] = math.isinf(self.guaranteed_clearance)
        for name in ("control_set", "start_set"):
            design = getattr(self, name)
            if design is not None:
                figures[name] = {"radius": design.level, "tip": design.tip, "angle": design.angle}
        return figures
