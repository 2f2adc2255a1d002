"""May what was handed in be believed?"""

from __future__ import annotations

import enum
import math
from typing import Any, final

import numpy as np
from jaxtyping import Float

from sidestep.robot.settings import OnboardSettings
from sidestep.robot.tracks import Track, turned

LARGEST = 1e4
"""The largest position (m) and speed (m/s) to be used: beyond, single precision errs by more than 1 mm."""


class Reading(enum.Enum):
    """What became of a pose, a nominal velocity or a time that was handed in.

    Only `ACCEPTED`, `RELOCATED` and `RESUMED` are used; others change nothing and are counted.
    """

    ACCEPTED = "accepted"
    RELOCATED = "somewhere else"
    """Believed, in a place that the robot cannot have driven to: its track begins anew there."""
    RESUMED = "seen again"
    """Believed, after so long a time that the robot's motion from before says nothing."""
    WAITING = "waiting for the next decision"
    """Only the next decision knows the clock that tells whether it is from the future."""
    NOT_NUMBERS = "not numbers"
    WRONG_LENGTH = "of the wrong length"
    NOT_FINITE = "not finite"
    TOO_LARGE = "too large"
    OUT_OF_ORDER = "out of order"
    JUMP = "jump"
    FROM_THE_FUTURE = "from the future"
    UNKNOWN_ROBOT = "unknown robot"

    @property
    def used(self) -> bool:
        """Whether decisions are made on it."""
        return self in (Reading.ACCEPTED, Reading.RELOCATED, Reading.RESUMED)


def as_numbers(value: Any, *shapes: tuple[int, ...]) -> Float[np.ndarray, "..."] | Reading:
    """What was handed in as finite numbers of one of the shapes, or why it cannot be. Raises nothing."""
    try:
        found = np.asarray(value)
    except Exception:  # Whatever an object of somebody's raises: it is no array of numbers.
        return Reading.NOT_NUMBERS
    if found.dtype.kind not in "iuf":
        return Reading.NOT_NUMBERS
    if found.shape not in shapes:
        return Reading.WRONG_LENGTH
    with np.errstate(all="ignore"):
        numbers = np.array(found, np.float64)
    return numbers if np.all(np.isfinite(numbers)) else Reading.NOT_FINITE


@final
class Gate:
    """Lets poses of one robot pass to its track.

    A robot that makes `speed` (m/s) and turns at `turn_rate` (rad/s) can only be so far from where it was. A
    pose from beyond that is a jump; once `jump_confirmations` in a row agree with each other it was the track
    that was wrong, or somebody has carried the robot, and the track begins anew. It does so, too, at the
    first pose after more than `forgotten_after` (s).
    """

    def __init__(
        self,
        name: str,
        track: Track,
        speed: float,
        turn_rate: float,
        settings: OnboardSettings,
        forgotten_after: float,
    ):
        self.name, self.track = name, track
        self._speed, self._turn_rate, self._settings = speed, turn_rate, settings
        self._forgotten_after = forgotten_after
        self._elsewhere: tuple[float, Float[np.ndarray, "d"]] | None = None
        self._agreed = 0

    def forget(self) -> None:
        """The robot has never been seen."""
        self.track.forget()
        self._elsewhere, self._agreed = None, 0

    def take(self, stamp: float, pose: Float[np.ndarray, "d"], now: float | None) -> Reading:
        """Judge a pose and, if it is believed, hand it on. `now`: the clock (s), as far as it is known."""
        if np.any(np.abs(pose[:2]) > LARGEST):
            return Reading.TOO_LARGE
        if len(pose) == 3 and abs(pose[2]) > LARGEST:
            pose = np.array([*pose[:2], math.remainder(pose[2], math.tau)])
        if now is not None and stamp > now + self._settings.future_tolerance:
            return Reading.FROM_THE_FUTURE
        last = self.track.stamp
        if last is None:
            self.track.start(stamp, pose)
            return Reading.ACCEPTED
        if stamp <= last:
            return Reading.OUT_OF_ORDER
        if not self._reaches(self.track.at(last), pose, stamp - last):
            return self._jumped(stamp, pose)
        self._elsewhere, self._agreed = None, 0
        if stamp - last > self._forgotten_after:
            self.track.start(stamp, pose)
            return Reading.RESUMED
        self.track.take(stamp, pose)
        return Reading.ACCEPTED

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
        self._elsewhere, self._agreed = None, 0
        return Reading.RELOCATED

    def _reaches(self, old: Float[np.ndarray, "d"], new: Float[np.ndarray, "d"], elapsed: float) -> bool:
        settings = self._settings
        if math.dist(old[:2], new[:2]) > self._speed * elapsed + settings.jump_tolerance:
            return False
        if len(new) < 3:
            return True
        turned_by = abs(turned(float(new[2] - old[2])))
        return turned_by <= self._turn_rate * elapsed + settings.heading_tolerance
