"""What a robot is told about its sensors, its motors, and what to do when something fails."""

from __future__ import annotations

import math
from dataclasses import dataclass, field

from sidestep._bounds import bounded, check, one_of
from sidestep.safety import Budget

ON_FAULT = ("evade", "stop")
"""What to do when nothing better is left: flee from where the pursuer was last seen, or stand still."""


@dataclass(frozen=True)
class OnboardSettings:
    """How the decision core takes its input and answers faults.

    **Errors.** `budget` bounds what the rows must allow for. `position_noise` (m) and `heading_noise`
    (rad) are standard deviations of the poses, for the filters that average them. `actuation_delay` (s)
    is the part of the delay that passes between a decision and the motors. They then go to the velocity
    told with the time constant `motor_lag` (s), and no faster than `motor_acceleration` (m/s^2). The own
    motion is predicted with these, and `joint` looks ahead with that acceleration; a command is taken to
    act `actuation_delay + motor_lag` late, and a pursuer's pose is paid for by its age and that, or by
    `budget.delay` if that is more. `predict_pursuer`: drive the pursuer on to then, at the speeds that it
    seems to have, and pay for `budget.delay` and what a pose is older than a period. What is guaranteed
    holds without (an old pose is the same game); with it, a pursuer that drives steadily is met better
    and one that turns round within the delay worse. An obstacle's drift is taken to wander by
    `obstacle_acceleration` (m/s per root second).

    **Faults.** A robot's pose older than `stale_after` (s), or a decision core that was called late
    `late_limit` times running (later than `late_after` periods), is a fault. `on_fault` says what is left.
    `nominal_timeout` (s): a wish older than that counts as a wish to stand still. A pose farther than
    `jump_tolerance` (m; `heading_tolerance` rad) from where the robot can be is not believed before
    `jump_confirmations` agree on it. A stamp more than `future_tolerance` (s) ahead of the clock is refused.
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
        """For how long (s) motions, sides and plans may go without a pose or a decision before they say
        nothing any more: a second, or `stale_after` or four control periods (s) if that is more."""
        return max(1.0, self.stale_after, 4.0 * period)

    @property
    def response(self) -> float:
        """From a decision to when its command acts, s."""
        return self.actuation_delay + self.motor_lag
