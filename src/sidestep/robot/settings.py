"""What a robot is told about its sensors, its motors, and what to do when something fails."""

from __future__ import annotations

import math
from dataclasses import dataclass, field

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
    position_noise: float = 0.001
    heading_noise: float = 0.005
    actuation_delay: float = 0.0
    motor_lag: float = 0.0
    motor_acceleration: float = math.inf
    predict_pursuer: bool = False
    obstacle_acceleration: float = 0.005
    stale_after: float = 0.2
    nominal_timeout: float = 0.5
    on_fault: str = "evade"
    jump_tolerance: float = 0.05
    heading_tolerance: float = 0.35
    jump_confirmations: int = 5
    future_tolerance: float = 0.05
    late_after: float = 1.5
    late_limit: int = 3

    def __post_init__(self) -> None:
        wrong = [
            f"{name} = {getattr(self, name)!r}: it must be a finite number, 0 or more"
            for name in (
                "position_noise", "heading_noise", "actuation_delay", "motor_lag", "obstacle_acceleration",
                "stale_after", "nominal_timeout", "jump_tolerance", "heading_tolerance", "future_tolerance",
            )
            if not _is_number(getattr(self, name), 0.0)
        ]  # fmt: skip
        if not self.motor_acceleration > 0.0:
            wrong.append(f"motor_acceleration = {self.motor_acceleration!r}: it must be more than 0 m/s^2")
        if not _is_number(self.late_after, 1.0):
            wrong.append(f"late_after = {self.late_after!r}: it must be at least 1 period")
        for name in ("jump_confirmations", "late_limit"):
            if not (isinstance(getattr(self, name), int) and getattr(self, name) >= 1):
                wrong.append(f"{name} = {getattr(self, name)!r}: it must be a whole number, 1 or more")
        if self.on_fault not in ON_FAULT:
            wrong.append(f"on_fault = {self.on_fault!r}: use one of {', '.join(map(repr, ON_FAULT))}")
        if wrong:
            raise ValueError("onboard settings: " + "; ".join(wrong))

    def forgotten_after(self, period: float) -> float:
        """For how long (s) motions, sides and plans may go without a pose or a decision before they say
        nothing any more: a second, or `stale_after` or four control periods (s) if that is more."""
        return max(1.0, self.stale_after, 4.0 * period)

    @property
    def response(self) -> float:
        """From a decision to when its command acts, s."""
        return self.actuation_delay + self.motor_lag


def _is_number(value: object, least: float) -> bool:
    return isinstance(value, (int, float)) and math.isfinite(value) and value >= least
