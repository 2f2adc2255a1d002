"""Check poses and other input of the decision core."""

from __future__ import annotations

import enum
import math
from typing import Any, final

import numpy as np
from jaxtyping import Float

from sidestep.robot.settings import OnboardSettings
from sidestep.robot.tracks import Track, turned

LARGEST = 1e4
"""The largest valid position (m) and speed (m/s): beyond, float32 errs by more than 1 mm."""


class Reading(enum.Enum):
    """The result of checking a pose, a nominal velocity or a time.

    Only `ACCEPTED`, `RELOCATED` and `RESUMED` input is used. All other input is counted and has no effect.
    """

    ACCEPTED = "accepted"
    RELOCATED = "somewhere else"
    """Accepted although the robot cannot have driven there; its track restarts."""
    RESUMED = "seen again"
    """Accepted after a long time; the robot's earlier motion is forgotten."""
    WAITING = "waiting for the next decision"
    """The clock of the next decision tells whether it is from the future."""
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
        """Whether decisions use the input."""
        return self in (Reading.ACCEPTED, Reading.RELOCATED, Reading.RESUMED)


def as_numbers(value: Any, *shapes: tuple[int, ...]) -> Float[np.ndarray, "..."] | Reading:
    """The value as finite numbers of one of the shapes, or the reason why it is not. Raises nothing."""
    try:
        found = np.asarray(value)
    except Exception:  # A caller's object may raise anything; it is not an array of numbers.
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
    """Checks the poses of one robot and passes valid ones to its track.

    A pose is a jump if the robot cannot have reached it with `speed` (m/s) and `turn_rate` (rad/s). When
    `jump_confirmations` jumps in a row agree with each other, the track was wrong or the robot was carried,
    and the track restarts there. It also restarts at the first pose after more than `forgotten_after` (s).
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
        """Forget all poses."""
        self.track.forget()
        self._elsewhere, self._agreed = None, 0

    def take(self, stamp: float, pose: Float[np.ndarray, "d"], now: float | None) -> Reading:
        """Check a pose and, if it is valid, pass it to the track. `now`: the clock (s), if known."""
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
