"""The times of decisions, and the detection of late commands."""

import math
from dataclasses import dataclass

_EARLY = 0.9
_SOON = 0.25


@dataclass(frozen=True)
class Late:
    """A late command: `gap` (s) since the previous one, of which the decision took `took` (s)."""

    gap: float
    took: float

    def __str__(self) -> str:
        return f"{1e3 * self.gap:.1f} ms after the one before (the decision took {1e3 * self.took:.1f} ms)"


class Cycle:
    """Determines when to decide, and detects late commands.

    There should be one command per `period` (s). If poses are the trigger, a decision follows as soon as all
    poses have arrived and 0.9 periods are over. Without poses it follows after `patience`, which is the
    period plus the share `grace`; the next decision then follows the next poses at once, unless less than a
    quarter of the period is over. A command is late if it is sent more than the share `late_after` of the
    period after its due time.
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
        """Whether to decide when the poses are complete at `now` (s)."""
        share = _SOON if self._out_of_step else _EARLY
        # A simulated clock may go back.
        return now < self._last or now - self._last >= share * self.period

    def sent(self, now: float, took: float, *, in_step: bool) -> Late | None:
        """Register a command sent at `now` (s), after a decision that took `took` (s); returns it if it is
        late.

        `in_step`: the decision was triggered by poses, not by the timer.
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
