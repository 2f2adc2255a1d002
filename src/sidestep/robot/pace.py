"""Lateness of decisions with respect to the control period."""

from __future__ import annotations

from typing import final

from sidestep.robot.settings import OnboardSettings

_CALM = 20
"""Number of on-time decisions after which a core that fell behind looks ahead again."""


@final
class Pace:
    """Tracks the lateness of recent decisions.

    - `lateness` (s) to add to the delay: of this decision, or of earlier ones, which decays
    - `late`: whether this decision is late; `paused`: whether so late that there was a pause, or the clock
      was set ahead; `behind`: whether so many decisions were late that computation must be reduced
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
        """Ignore the time until the next decision, because the clock was set."""
        self._since = None

    def called(self, now: float) -> float:
        """Register a decision at `now` (s), later than the previous one; returns its lateness, s."""
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
        # A pause is not added to the delay: poses of that age are stale.
        paid = min(late, settings.stale_after) if self.paused else late
        # Lateness may recur, so it decays over several periods.
        self.lateness = max(paid, 0.8 * self.lateness if self.lateness > 1e-4 else 0.0)
        return late
