"""Does the decision core keep pace with its control period?"""

from __future__ import annotations

from typing import final

from sidestep.robot.settings import OnboardSettings

_CALM = 20
"""On-time decisions after which a core that fell behind looks ahead again."""


@final
class Pace:
    """How late decisions are, of late.

    - `lateness` (s) to allow for: that of this decision, or of earlier ones as far as not forgotten
    - `late` whether this decision is; `paused` whether by so much that it is no lateness, but a pause, or the
      clock was set ahead; `behind` whether so many were late that less must be computed
    """

    def __init__(self, period: float, settings: OnboardSettings):
        self._period, self._settings = period, settings
        self._since: float | None = None
        self._late_in_a_row, self._on_time = 0, 0
        self.lateness, self.behind, self.paused = 0.0, False, False

    @property
    def late(self) -> bool:
        return self._late_in_a_row > 0

    def interrupted(self) -> None:
        """The time until the next decision says nothing: the clock was set meanwhile."""
        self._since = None

    def called(self, now: float) -> float:
        """To be called for each decision, at `now` (s), later than the one before; how late it is, s."""
        since, self._since, self.paused = self._since, now, False
        if since is None:
            return 0.0
        elapsed, settings = now - since, self._settings
        late = max(elapsed - self._period, 0.0) if elapsed > settings.late_after * self._period else 0.0
        if late:
            self._late_in_a_row, self._on_time = self._late_in_a_row + 1, 0
        else:
            self._late_in_a_row, self._on_time = 0, self._on_time + 1
        if self._late_in_a_row >= settings.late_limit and not self.behind:
            self.behind = True
        elif self.behind and self._on_time >= _CALM:
            self.behind = False
        self.paused = elapsed > settings.forgotten_after(self._period)
        # No delay pays for a pause: poses that are as old as that are stale.
        paid = min(late, settings.stale_after) if self.paused else late
        # What was late once may be so again: forgotten over some periods.
        self.lateness = max(paid, 0.8 * self.lateness if self.lateness > 1e-4 else 0.0)
        return late
