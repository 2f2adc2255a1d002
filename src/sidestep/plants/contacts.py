"""The evader's least distances over an interval of time."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import final

import numpy as np
from jaxtyping import Float

from sidestep.world import Scenario


@dataclass(frozen=True)
class Contacts:
    """Least distances (m) between centres over an interval, from the true positions at every physics step.

    `pursuer_distance` and `obstacle_distance` are infinite without such a robot; `target_distance`.
    """

    pursuer_distance: float
    obstacle_distance: float
    target_distance: float
    captured: bool
    collided: bool
    reached: bool


@final
class Watch:
    """Tracks the least distances (m) to a pursuer and to an obstacle over all physics steps."""

    def __init__(self, scenario: Scenario, target: Float[np.ndarray, "2"]):
        self._pursuers, self._target = scenario.pursuer_count, target
        self._capture, self._collision, self._reach = (
            float(distance)
            for distance in (scenario.capture_distance, scenario.collision_distance, scenario.reach_distance)
        )
        self.least = (math.inf, math.inf)

    def see(self, poses: Float[np.ndarray, "n robots 3"]) -> Contacts:
        """The contacts along these poses; order: evader, pursuers, obstacles."""
        evader, m = poses[:, 0, :2], self._pursuers
        apart = np.linalg.norm(poses[:, 1:, :2] - evader[:, None], axis=-1)
        pursuer, obstacle = (float(np.min(group, initial=math.inf)) for group in (apart[:, :m], apart[:, m:]))
        to_target = float(np.min(np.linalg.norm(evader - self._target, axis=-1), initial=math.inf))
        self.least = (min(self.least[0], pursuer), min(self.least[1], obstacle))
        captured, collided = pursuer <= self._capture, obstacle <= self._collision
        reached = to_target <= self._reach and not captured and not collided
        return Contacts(pursuer, obstacle, to_target, captured, collided, reached)
