"""What the decision core answers."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from jaxtyping import Float

from sidestep.world import World

LEVELS = ("normal", "degraded", "evade", "stop")
"""How much is left, from everything to nothing."""


@dataclass(frozen=True)
class Decision:
    """One command and how it came about.

    - `velocity (2,)` to drive now, m/s, world axes: finite and within the speed limit, never unfiltered
    - `nominal (2,)` what the policy or the caller wished, m/s; NaN where there was none
    - `status` see `sidestep.safety.Status`; `INVALID` where nothing could be decided
    - `level` one of `LEVELS`; `reactions` each fault met and what was done about it
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
        """The estimate decided on, at the time when the command acts; None where there was none."""
        return None if self._seen is None else self._seen.world()

    @property
    def plan(self) -> Float[np.ndarray, "n 2"]:
        """Where the way out that the shield `joint` counts on leads, m, against a pursuer that plays `nash`:
        computed when asked for. Empty for other shields, and where nothing could be decided."""
        return self._plan()
