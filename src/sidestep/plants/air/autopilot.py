"""The quadrotor's autopilot: a cascade of controllers from position to rotor thrusts."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple, final

import numpy as np
from jaxtyping import Float

from sidestep._bounds import bounded, check
from sidestep.plants.air.airframe import Airframe
from sidestep.world.flyers import GRAVITY

Vector = Float[np.ndarray, "3"]
Matrix = Float[np.ndarray, "3 3"]


class Setpoint(NamedTuple):
    """The reference motion now: m, m/s, m/s^2, m/s^3, world axes."""

    position: Vector
    velocity: Vector
    acceleration: Vector
    jerk: Vector


class Attitude(NamedTuple):
    """`rotation (3, 3)` from body axes to world axes, `rates (3,)` rad/s in body axes."""

    rotation: Matrix
    rates: Vector


@dataclass(frozen=True)
class Gains:
    """Gains of the cascade, outermost loop first.

    - `position` 1/s: velocity per position error
    - `velocity` 1/s: acceleration per velocity error; `integral` 1/s^2 of that error, against drag and wind,
      limited to `integral_limit` m/s^2
    - `attitude` 1/s^2 and `rates` 1/s: angular acceleration per attitude error and per rate error in roll and
      pitch; in yaw a third of the first and all of the second
    - `largest_tilt` rad: limit of the thrust's tilt
    """

    position: float = bounded(4.0, above=0.0, unit="1/s")
    velocity: float = bounded(6.0, above=0.0, unit="1/s")
    integral: float = bounded(3.0, least=0.0, unit="1/s^2")
    integral_limit: float = bounded(1.0, least=0.0, unit="m/s^2")
    attitude: float = bounded(340.0, above=0.0, unit="1/s^2")
    rates: float = bounded(30.0, above=0.0, unit="1/s")
    largest_tilt: float = bounded(math.radians(45.0), above=0.0, below=math.pi / 2.0, unit="rad")

    def __post_init__(self):
        check(self, title="gains: ")


def _cross(a: Vector, b: Vector) -> Vector:
    return np.array([a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]])


def _vee(matrix: Matrix) -> Vector:
    return np.array([matrix[2, 1], matrix[0, 2], matrix[1, 0]])


@final
class Autopilot:
    """Position and velocity loops command an acceleration, attitude and rate loops tilt the thrust to it, and
    a mixer distributes thrust and torques to the rotors.

    The attitude law is that of Lee, Leok, McClamroch, "Geometric tracking control of a quadrotor UAV on
    SE(3)", CDC 2010, with body rates from the setpoint's jerk. When rotors saturate, yaw torque is reduced
    first, then the collective thrust is shifted, so that roll and pitch are kept.
    """

    def __init__(self, frame: Airframe, gains: Gains | None = None):
        self.frame, self.gains = frame, gains or Gains()
        self._inertia = np.array(frame.inertia)
        x, y = np.array(frame.rotor_places).T
        turning = np.array(frame.rotor_senses) * frame.rotor_torque
        self._mixer = np.linalg.inv(np.stack([np.ones(4), y, -x, turning]))
        self.reset()

    def reset(self) -> None:
        """Reset the integral."""
        self._gathered = np.zeros(3)
        self.saturated = False

    def thrusts(
        self, wanted: Setpoint, position: Vector, velocity: Vector, attitude: Attitude, period: float
    ) -> Float[np.ndarray, "4"]:
        """Thrust (N) of every rotor for the next `period` (s), to follow the setpoint `wanted` from the
        estimated position (m), velocity (m/s) and attitude."""
        gains, frame = self.gains, self.frame
        off = wanted.velocity - velocity + gains.position * (wanted.position - position)
        limit = gains.integral_limit
        self._gathered = np.clip(self._gathered + gains.integral * period * off, -limit, limit)
        push = wanted.acceleration + gains.velocity * off + self._gathered
        push[2] = max(push[2] + GRAVITY, 0.3 * GRAVITY)
        aside, most = math.hypot(push[0], push[1]), push[2] * math.tan(gains.largest_tilt)
        self.saturated = aside > most
        if self.saturated:
            push[:2] *= most / aside
        size = math.sqrt(push @ push)
        up = push / size
        # Heading 0: the body's y axis is perpendicular to the world's x axis.
        left = _cross(up, np.array([1.0, 0.0, 0.0]))
        left /= math.sqrt(left @ left)
        aim = np.stack([_cross(left, up), left, up], axis=1)
        # Rotation rate of the desired thrust direction, from the jerk, at constant heading.
        leaning = (wanted.jerk - up * (up @ wanted.jerk)) / size
        turning = aim.T @ _cross(up, leaning)
        turning[2] = 0.0
        rotation, rates = attitude
        error = 0.5 * _vee(aim.T @ rotation - rotation.T @ aim)
        off_rates = rates - rotation.T @ (aim @ turning)
        share = np.array([1.0, 1.0, 1.0 / 3.0])
        turn = -gains.attitude * share * error - gains.rates * off_rates
        torque = self._inertia * turn + _cross(rates, self._inertia * rates)
        return self._mix(float(frame.mass * (push @ rotation[:, 2])), torque)

    def _mix(self, thrust: float, torque: Vector) -> Float[np.ndarray, "4"]:
        most = self.frame.largest_thrust
        level = self._mixer[:, 0] * thrust
        lean = self._mixer[:, 1] * torque[0] + self._mixer[:, 2] * torque[1]
        yaw = self._mixer[:, 3] * torque[2]
        wanted = level + lean
        room = min(float(np.min(wanted)), float(np.min(most - wanted)))
        peak = float(np.max(np.abs(yaw)))
        if peak > 0.0 and room < peak:
            self.saturated = True
            yaw = yaw * max(room, 0.0) / peak
        wanted = wanted + yaw
        low, high = float(np.min(wanted)), float(np.max(wanted))
        if low < 0.0 or high > most:
            self.saturated = True
            wanted += -low if low < 0.0 else most - high
        return np.clip(wanted, 0.0, most)
