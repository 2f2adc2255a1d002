"""When is it time to decide, and which commands came late?"""

import math
from dataclasses import dataclass

_EARLY = 0.9
_SOON = 0.25


@dataclass(frozen=True)
class Late:
    """A command that came late: the `gap` (s) since the one before, of which the decision took `took` (s)."""

    gap: float
    took: float

    def __str__(self) -> str:
        return f"{1e3 * self.gap:.1f} ms after the one before (the decision took {1e3 * self.took:.1f} ms)"


class Cycle:
    """The control period, kept and watched.

    A command is wanted every `period` (s). With poses as the trigger one is decided on as soon as all poses
    are there, once nine tenths of the period are over; without them after `patience`, a share `grace` beyond
    the period. After that the poses are waited for anew: the next decision follows them at once, unless less
    than a quarter of the period is over. A command is late if it goes out more than a share `late_after` of
    the period after it should have.
    """

    def __init__(self, period: float, *, grace: float = 0.1, late_after: float = 0.2):
        self.period = period
        self.patience = (1.0 + grace) * period
        self.limit = (1.0 + late_after) * period
        self.commands = 0
        self.late = 0
        self.worst_gap = 0.0
        self._last = -math.inf
        self._out_of_step = True

    def is_due(self, now: float) -> bool:
        """Whether poses that are complete at `now` (s) are to be decided on."""
        share = _SOON if self._out_of_step else _EARLY
        # A simulated clock may go back.
        return now < self._last or now - self._last >= share * self.period

    def sent(self, now: float, took: float, *, in_step: bool) -> Late | None:
        """To be told of each command as it goes out at `now` (s), after a decision that took `took` (s).

        `in_step` says that it followed on poses, and not on waiting for them.
        """
        gap = now - self._last
        self._last, self._out_of_step = now, not in_step
        self.commands += 1
        if self.commands == 1:
            return None
        self.worst_gap = max(self.worst_gap, gap)
        if gap <= self.limit:
            return None
        self.late += 1
        return Late(gap, took)
