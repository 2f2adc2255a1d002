"""From a command to the motors: delay and wheel speeds."""

from __future__ import annotations

import math
from collections import deque
from typing import Generic, TypeVar, final

import numpy as np
from jaxtyping import Float

from sidestep.plants.ground.robots import OMNIWHEEL_ANGLES, OMNIWHEEL_ARM, OMNIWHEEL_RADIUS, OMNIWHEEL_ROLLING

_YAW_GAIN = 1.5
_MOST_YAW_RATE = 0.5
Command = TypeVar("Command")


@final
class DelayLine(Generic[Command]):
    """Commands that take effect after `delay` (s); until then the previous command holds."""

    def __init__(self, delay: float, first: Command):
        self._delay, self._held = delay, first
        self._under_way: deque[tuple[float, Command]] = deque()

    def give(self, now: float, command: Command) -> None:
        """Give a command at `now` (s)."""
        self._under_way.append((now + self._delay, command))

    def at(self, now: float) -> Command:
        """The command in effect at `now` (s)."""
        while self._under_way and self._under_way[0][0] <= now + 1e-9:
            self._held = self._under_way.popleft()[1]
        return self._held


def yaw_rate(heading: float) -> float:
    """Turn rate (rad/s) of the controller that holds the evader's heading (rad) at 0."""
    return min(max(-_YAW_GAIN * math.remainder(heading, 2.0 * math.pi), -_MOST_YAW_RATE), _MOST_YAW_RATE)


def omniwheel_speeds(velocity: Float[np.ndarray, "2"], heading: float) -> Float[np.ndarray, "3"]:
    """Speeds w (rad/s) of the three omniwheels for a velocity (m/s) in world axes, heading (rad) held at 0.

    R w = -(v.t + L yaw_rate), with v in robot axes, R the effective rolling radius, L the wheel's distance
    from the centre, and t the unit vector perpendicular to the outward axle, counter-clockwise about the
    centre.
    """
    cosine, sine = math.cos(heading), math.sin(heading)
    ahead = cosine * velocity[0] + sine * velocity[1]
    left = cosine * velocity[1] - sine * velocity[0]
    turn, radius = OMNIWHEEL_ARM * yaw_rate(heading), OMNIWHEEL_RADIUS * OMNIWHEEL_ROLLING
    return np.array(
        [-(left * math.cos(angle) - ahead * math.sin(angle) + turn) / radius for angle in OMNIWHEEL_ANGLES]
    )
