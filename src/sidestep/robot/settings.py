"""Settings of the decision core: sensors, motors, and reactions to faults."""

from __future__ import annotations

import math
from dataclasses import dataclass, field

from sidestep._bounds import bounded, check, one_of
from sidestep.safety import Budget

ON_FAULT = ("evade", "stop")
"""Reactions to a stale pose of another robot: flee from the pursuer's last pose, or stop."""


@dataclass(frozen=True)
class OnboardSettings:
    """How the decision core models sensors and motors, and reacts to faults.

    **Errors and motors**

    - `budget`: bounds of the errors that the shield's rows account for
    - `position_noise` (m), `heading_noise` (rad): standard deviations of the poses, for the filters
    - `actuation_delay` (s): from a decision to the motors
    - `motor_lag` (s), `motor_acceleration` (m/s^2): the motors follow the commanded velocity with this time
      constant and limit. They predict the evader's motion, and `joint` looks ahead with the acceleration.
      Actuation time is `actuation_delay + motor_lag` after a decision. The delay of a pursuer's pose is its
      age plus that, or `budget.delay` if that is larger
    - `predict_pursuer`: extrapolate the pursuer to actuation time with its estimated speeds. The delay is
      then `budget.delay` plus the age beyond one control period. Better against a steady pursuer, worse
      against a turning one; the guarantee holds only when off
    - `obstacle_acceleration` (m/s per root second): random walk of an obstacle's velocity

    **Faults**

    - `stale_after` (s): an older pose is a fault; `on_fault`: the reaction
    - `late_after` (periods), `late_limit`: a decision later than this is late; so many late decisions in a
      row are a fault
    - `nominal_timeout` (s): an older nominal velocity counts as zero
    - `jump_tolerance` (m), `heading_tolerance` (rad): a pose farther than this from the reachable ones is
      accepted only after `jump_confirmations` poses agree
    - `future_tolerance` (s): a stamp farther ahead of the clock is refused
    """

    budget: Budget = field(default_factory=Budget)
    position_noise: float = bounded(0.001, least=0.0, unit="m")
    heading_noise: float = bounded(0.005, least=0.0, unit="rad")
    actuation_delay: float = bounded(0.0, least=0.0, unit="s")
    motor_lag: float = bounded(0.0, least=0.0, unit="s")
    motor_acceleration: float = bounded(math.inf, above=0.0, infinite=True, unit="m/s^2")
    predict_pursuer: bool = False
    obstacle_acceleration: float = bounded(0.005, least=0.0, unit="m/s per root second")
    stale_after: float = bounded(0.2, least=0.0, unit="s")
    nominal_timeout: float = bounded(0.5, least=0.0, unit="s")
    on_fault: str = bounded("evade", one_of(*ON_FAULT))
    jump_tolerance: float = bounded(0.05, least=0.0, unit="m")
    heading_tolerance: float = bounded(0.35, least=0.0, unit="rad")
    jump_confirmations: int = bounded(5, least=1)
    future_tolerance: float = bounded(0.05, least=0.0, unit="s")
    late_after: float = bounded(1.5, least=1.0, unit="periods")
    late_limit: int = bounded(3, least=1)

    def __post_init__(self) -> None:
        check(self, title="onboard settings: ")

    def forgotten_after(self, period: float) -> float:
        """Time (s) without a pose or a decision after which motions, sides and plans are forgotten: the
        largest of 1 s, `stale_after` and four control periods of `period` (s)."""
        return max(1.0, self.stale_after, 4.0 * period)

    @property
    def response(self) -> float:
        """Time (s) from a decision to its actuation."""
        return self.actuation_delay + self.motor_lag
