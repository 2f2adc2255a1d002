"""May a pose be believed?"""

from __future__ import annotations

import enum
import math
from typing import final

import numpy as np
from jaxtyping import Float

from sidestep.bridges.onboard.settings import OnboardSettings
from sidestep.bridges.onboard.tracks import Track, turned


class Reading(enum.Enum):
    """What became of a pose or wish that was handed in. Others than accepted ones are only counted."""

    ACCEPTED = "accepted"
    NOT_FINITE = "not finite"
    OUT_OF_ORDER = "out of order"
    JUMP = "jump"
    FROM_THE_FUTURE = "from the future"
    UNKNOWN_ROBOT = "unknown robot"


@final
class Gate:
    """Lets poses of one robot pass to its track.

    A robot that makes `speed` (m/s) and turns at `turn_rate` (rad/s) can only be so far from where it was. A
    pose from beyond that is a jump; once `jump_confirmations` in a row agree with each other it was the track
    that was wrong, or somebody has carried the robot, and the track begins anew.
    """

    def __init__(self, track: Track, speed: float, turn_rate: float, settings: OnboardSettings):
        self.track = track
        self._speed, self._turn_rate, self._settings = speed, turn_rate, settings
        self._elsewhere: tuple[float, Float[np.ndarray, "d"]] | None = None
        self._agreed = 0
        self.relocated = False

    def take(self, stamp: float, pose: Float[np.ndarray, "d"], now: float | None) -> Reading:
        """Judge a pose and, if it is believed, hand it on. `now`: the clock (s), as far as it is known."""
        if not (math.isfinite(stamp) and np.all(np.isfinite(pose))):
            return Reading.NOT_FINITE
        if now is not None and stamp > now + self._settings.future_tolerance:
            return Reading.FROM_THE_FUTURE
        last = self.track.stamp
        if last is None:
            self.track.start(stamp, pose)
            return Reading.ACCEPTED
        if stamp <= last:
            return Reading.OUT_OF_ORDER
        if self._reaches(self.track.at(last), pose, stamp - last):
            self._elsewhere, self._agreed = None, 0
            self.track.take(stamp, pose)
            return Reading.ACCEPTED
        return self._jumped(stamp, pose)

    def _jumped(self, stamp: float, pose: Float[np.ndarray, "d"]) -> Reading:
        before = self._elsewhere
        if before is not None and stamp <= before[0]:
            return Reading.OUT_OF_ORDER
        agrees = before is not None and self._reaches(before[1], pose, stamp - before[0])
        self._agreed = self._agreed + 1 if agrees else 1
        self._elsewhere = (stamp, pose)
        if self._agreed < self._settings.jump_confirmations:
            return Reading.JUMP
        self.track.start(stamp, pose)
        self._elsewhere, self._agreed, self.relocated = None, 0, True
        return Reading.ACCEPTED

    def _reaches(self, old: Float[np.ndarray, "d"], new: Float[np.ndarray, "d"], elapsed: float) -> bool:
        settings = self._settings
        if math.dist(old[:2], new[:2]) > self._speed * elapsed + settings.jump_tolerance:
            return False
        if len(new) < 3:
            return True
        turned_by = abs(turned(float(new[2] - old[2])))
        return turned_by <= self._turn_rate * elapsed + settings.heading_tolerance
