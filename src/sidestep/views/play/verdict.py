"""Whether the robot can be captured with the given numbers, as far as it is fast to compute."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from sidestep.safety.sampled.sampled_design import COARSE, holds
from sidestep.safety.sampled.sampled_game import SampledGame


@dataclass(frozen=True)
class Verdict:
    """Whether capture is possible with these numbers.

    - `kind`: `caught` (the best pursuer wins), `held` (the certificate holds at this control period), or
      `open` (the evader wins the game in continuous time, but there is no certificate at this control
      period); `unsure` before the certificate has been computed
    - `largest` l_max and `margin` l_max - l, m; infinite for an evader at least as fast
    """

    kind: str
    largest: float
    margin: float

    def to_dict(self) -> dict[str, Any]:
        """JSON values; infinite lengths become None."""
        finite = math.isfinite(self.largest)
        return {
            "kind": self.kind,
            "largest": round(self.largest, 5) if finite else None,
            "margin": round(self.margin, 5) if finite else None,
        }


def quick_verdict(numbers: Mapping[str, float], period: float) -> Verdict:
    """The game's test, l <= l_max = b rho^2/sqrt(1 - rho^2), see `CaptureGame`; fast."""
    game = _game(numbers, period)
    largest, distance = game.largest_capture_distance, numbers["capture_distance"]
    return Verdict("caught" if distance > largest else "unsure", largest, largest - distance)


def verdict(numbers: Mapping[str, float], period: float, pursuers: int) -> Verdict:
    """`quick_verdict`, and whether the certificate of `sidestep certify` holds at this period; about 20 ms.

    For exact measurements and one pursuer in the unbounded plane; there is no certificate for several
    pursuers.
    """
    quick = quick_verdict(numbers, period)
    if quick.kind == "caught":
        return quick
    held = pursuers == 1 and holds(_game(numbers, period), numbers["capture_distance"], COARSE)
    return Verdict("held" if held else "open", quick.largest, quick.margin)


def _game(numbers: Mapping[str, float], period: float) -> SampledGame:
    return SampledGame(
        evader_speed=numbers["evader_speed"],
        pursuer_speed=numbers["pursuer_speed"],
        half_axle=numbers["pursuer_half_axle"],
        control_period=period,
    )
