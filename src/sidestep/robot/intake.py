"""Check and count all input of the decision core."""

from __future__ import annotations

import functools
from collections import Counter
from collections.abc import Callable
from typing import Any, final

import numpy as np
from jaxtyping import Float

from sidestep.robot.readings import Reading, as_numbers

_AHEAD = 1.0
"""Without a clock, a stamp farther ahead (s) of the last decision counts as from the future."""
_NAMES = 1000
"""Number of unknown robots that are counted by name; further ones are counted together."""
_WORDS = {
    Reading.RELOCATED: "is somewhere else now, its track begins anew",
    Reading.RESUMED: "seen again after a while, its motion from before is forgotten",
}


@final
class Intake:
    """Passes poses and nominal velocities to their checks, as soon as the clock is known, and counts results.

    `tolerance` (s): a stamp ahead of the last decision by at most this is not from the future.
    """

    def __init__(self, tolerance: float):
        self._tolerance = tolerance
        self.counts: Counter[tuple[str, Reading]] = Counter()
        self._news: Counter[tuple[str, Reading]] = Counter()
        self._waiting: list[tuple[str, Callable[[float], Reading]]] = []

    def latest(self, now: float) -> float:
        """The latest stamp (s) to accept without a clock, after a decision at `now` (s)."""
        return now + self._tolerance

    def judge(
        self,
        name: str,
        take: Callable[[float, Any, float | None], Reading],
        stamp: Any,
        numbers: Float[np.ndarray, "..."] | Reading,
        now: Any,
        last: float | None,
    ) -> Reading:
        """Check numbers with `take(stamp, numbers, now)`. If the result depends on the clock and `now` is not
        given, this happens at the next decision. `last`: the clock (s) at the last decision."""
        when, clock = as_numbers(stamp, ()), as_numbers(now, ())
        if isinstance(when, Reading):
            return self.count(name, when)
        if isinstance(numbers, Reading):
            return self.count(name, numbers)
        time = float(when)
        if not isinstance(clock, Reading):
            return self.count(name, take(time, numbers, float(clock)))
        if last is not None and time > last + _AHEAD:
            return self.count(name, Reading.FROM_THE_FUTURE)
        if last is not None and time > self.latest(last):
            self._waiting.append((name, functools.partial(take, time, numbers)))
            return Reading.WAITING
        return self.count(name, take(time, numbers, None))

    def settle(self, now: float) -> None:
        """Check the input that waited for the clock."""
        for name, take in self._waiting:
            self.count(name, take(now))
        self._waiting.clear()

    def count(self, name: str, reading: Reading) -> Reading:
        """Count one reading; `take_news` reports it unless it was `ACCEPTED`."""
        self.counts[(name, reading)] += 1
        if reading is not Reading.ACCEPTED:
            self._news[(name, reading)] += 1
        return reading

    def unknown(self, robot: Any, index: Any) -> Reading:
        """Count a pose of a robot that the scenario does not have. Its name may be any object."""
        named = isinstance(robot, str) and isinstance(index, (int, np.integer)) and abs(index) < 1e9
        name = f"{robot[:40]} {index}" if named and len(self.counts) < _NAMES else "some robot"
        return self.count(name, Reading.UNKNOWN_ROBOT)

    def take_news(self) -> list[str]:
        """Dropped input and restarted tracks since the last call, in words."""
        words = [
            f"{name}: {_WORDS.get(reading) or f'{count} {reading.value}, dropped'}"
            for (name, reading), count in sorted(self._news.items(), key=lambda item: item[0][0])
        ]
        self._news.clear()
        return words
