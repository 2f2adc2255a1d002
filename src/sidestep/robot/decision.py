"""The decision core's answer."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from jaxtyping import Float

from sidestep.world import World

LEVELS = ("normal", "degraded", "evade", "stop")
"""Levels of operation, from normal to stopped."""


@dataclass(frozen=True)
class Decision:
    """One command, with the data of its decision.

    - `velocity (2,)` to drive now, m/s, world axes: finite, within the speed limit, always filtered
    - `nominal (2,)` velocity of the policy or the caller, m/s; NaN if there was none
    - `status` see `sidestep.safety.Status`; `INVALID` if no decision was possible
    - `level` one of `LEVELS`; `reactions`: each fault and the reaction to it, in words
    - `barriers (m + k,)` h in m; `slack` m/s; `intervention` |velocity - nominal| in m/s; `clearance` least
      distance (m) to contact, as estimated
    - `latency` from the newest pose used to the end of the decision, s; `compute_seconds` of it spent here
    """

    velocity: Float[np.ndarray, "2"]
    nominal: Float[np.ndarray, "2"]
    status: int
    level: str
    reactions: tuple[str, ...]
    barriers: Float[np.ndarray, "n"]
    slack: float
    intervention: float
    clearance: float
    latency: float
    compute_seconds: float
    _seen: Any = field(repr=False, compare=False)
    _plan: Callable[[], Float[np.ndarray, "n 2"]] = field(repr=False, compare=False)

    @property
    def world(self) -> World | None:
        """The estimated world at actuation time, on which the decision is based; None if there was none."""
        return None if self._seen is None else self._seen.world()

    @property
    def plan(self) -> Float[np.ndarray, "n 2"]:
        """Positions (m) along the escape plan of the shield `joint` against a pursuer that plays `nash`,
        computed on access. Empty for other shields, and if no decision was possible."""
        return self._plan()
