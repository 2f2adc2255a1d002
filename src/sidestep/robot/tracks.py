"""Estimates of the robots' motion from noisy, delayed poses: one Kalman filter per robot, in world axes.

A filter holds its estimate at the stamp of its last pose; `at` extrapolates it. Written in NumPy, because the
filters are tiny and get one pose at a time.
"""

from __future__ import annotations

import abc
import math
from collections import deque
from typing import final

import numpy as np
from jaxtyping import Float

_REACTION = 1.0
"""Time (s) in which the filter assumes a pursuer's wheels reach full speed. Some pursuers are faster, but
rarely; with heading noise of half a degree the estimate's error is a fifth less than with 0.25 s."""


def turned(angle: float) -> float:
    """An angle (rad) wrapped to [-pi, pi)."""
    return (angle + math.pi) % (2.0 * math.pi) - math.pi


class Track(abc.ABC):
    """The estimate of one robot; none before the first pose, see `stamp`."""

    stamp: float | None = None
    """The stamp (s) of the last pose; None before the first."""

    def forget(self) -> None:
        """Discard the estimate until the next `start`."""
        self.stamp = None

    @abc.abstractmethod
    def start(self, stamp: float, pose: Float[np.ndarray, "d"]) -> None:
        """Restart with this pose: x, y (m) and heading (rad) if there is one."""

    @abc.abstractmethod
    def take(self, stamp: float, pose: Float[np.ndarray, "d"]) -> None:
        """Update the estimate with a pose that is newer than the last one."""

    @abc.abstractmethod
    def at(self, time: float) -> Float[np.ndarray, "d"]:
        """The extrapolated x, y (m), heading (rad) at a time (s); for a time before `stamp`, those at
        `stamp`."""


@final
class EvaderTrack(Track):
    """The evader, whose commands are known: between poses it is extrapolated with them.

    Position and heading have one variance each. It grows by (`drift` dt)^2 + (0.1 `drift`)^2 dt between
    poses, where `drift` (m/s) is the velocity error of the motors. A command u acts after `delay` (s); then
    v' = (u - v) / `motor_lag` (s), with |v'| at most `acceleration` (m/s^2).
    """

    def __init__(
        self,
        position_noise: float,
        heading_noise: float,
        drift: float,
        delay: float,
        motor_lag: float = 0.0,
        acceleration: float = math.inf,
    ):
        self._noise = max(position_noise, 1e-5) ** 2, max(heading_noise, 1e-5) ** 2
        self._drift, self._delay = drift, delay
        self._motor_lag, self._acceleration = motor_lag, acceleration
        self._commands: deque[tuple[float, Float[np.ndarray, "2"]]] = deque()
        self._pose, self._variance = np.zeros(3), (0.0, 0.0)
        self._velocity = np.zeros(2)

    def told(self, time: float, velocity: Float[np.ndarray, "2"]) -> None:
        """Register a command (m/s, world axes) given at `time` (s). Commands of later times, which exist
        after a clock went back, are forgotten."""
        acts = time + self._delay
        while self._commands and self._commands[-1][0] > acts:
            self._commands.pop()
        self._commands.append((acts, np.array(velocity, float)))
        # Commands before the last pose are already part of it.
        known = -math.inf if self.stamp is None else self.stamp
        while len(self._commands) > 1 and self._commands[1][0] <= known:
            self._commands.popleft()

    def _driven(self, begin: float, end: float) -> tuple[Float[np.ndarray, "2"], Float[np.ndarray, "2"]]:
        """The displacement (m) between two times, and the velocity (m/s) at the end."""
        way, velocity = np.zeros(2), self._velocity
        for i, (since, command) in enumerate(self._commands):
            until = self._commands[i + 1][0] if i + 1 < len(self._commands) else math.inf
            duration = min(until, end) - max(since, begin)
            if duration > 0.0:
                step, velocity = self._follow(velocity, command, duration)
                way += step
        return way, velocity

    def _follow(
        self, velocity: Float[np.ndarray, "2"], command: Float[np.ndarray, "2"], duration: float
    ) -> tuple[Float[np.ndarray, "2"], Float[np.ndarray, "2"]]:
        """Displacement (m) and velocity (m/s) after `duration` (s): first with the largest acceleration,
        while the lag alone would exceed it, then exponentially. Exact, because the velocity changes along a
        line."""
        lacking = command - velocity
        size, way = math.hypot(*lacking), np.zeros(2)
        hard = size / self._acceleration - self._motor_lag if math.isfinite(self._acceleration) else 0.0
        if hard > 0.0:
            hard = min(hard, duration)
            gained = lacking / size * self._acceleration * hard
            way = (velocity + 0.5 * gained) * hard
            velocity, lacking, duration = velocity + gained, lacking - gained, duration - hard
        closed = -math.expm1(-duration / self._motor_lag) if self._motor_lag > 0.0 else float(duration > 0.0)
        way = way + command * duration - lacking * self._motor_lag * closed
        return way, velocity + closed * lacking

    def start(self, stamp: float, pose: Float[np.ndarray, "d"]) -> None:
        self.stamp, self._pose, self._variance = stamp, np.array(pose, float), self._noise
        self._velocity = np.zeros(2)

    def take(self, stamp: float, pose: Float[np.ndarray, "d"]) -> None:
        assert self.stamp is not None
        elapsed = stamp - self.stamp
        way, velocity = self._driven(self.stamp, stamp)
        expected, grown = (
            self._pose + np.array([*way, 0.0]),
            (self._drift * elapsed) ** 2 + (0.1 * self._drift) ** 2 * elapsed,
        )
        spread = [variance + grown for variance in self._variance]
        gains = [own / (own + noise) for own, noise in zip(spread, self._noise, strict=True)]
        error = pose - expected
        self._pose = expected + np.array(
            [gains[0] * error[0], gains[0] * error[1], gains[1] * turned(error[2])]
        )
        self._pose[2] = turned(self._pose[2])
        self._variance = (spread[0] * (1.0 - gains[0]), spread[1] * (1.0 - gains[1]))
        self.stamp, self._velocity = stamp, velocity

    def at(self, time: float) -> Float[np.ndarray, "d"]:
        if self.stamp is None:
            return np.full(3, np.nan)
        moved = self._pose.copy()
        moved[:2] += self._driven(self.stamp, time)[0]
        return moved

    def velocity_at(self, time: float) -> Float[np.ndarray, "2"]:
        """The velocity (m/s) at a time (s) not before `stamp`."""
        return np.full(2, np.nan) if self.stamp is None else self._driven(self.stamp, time)[1]


@final
class PursuerTrack(Track):
    """A differential drive with unknown commands: an extended Kalman filter on (x, y, heading, v, omega).

    Between poses v and omega are constant, with process noise as if they changed by V and V/b within about
    `_REACTION`; they are limited to |v| + b |omega| <= V.
    """

    def __init__(self, position_noise: float, heading_noise: float, rim_speed: float, half_axle: float):
        self._noise = np.diag([max(position_noise, 1e-5) ** 2] * 2 + [max(heading_noise, 1e-5) ** 2])
        self._rim, self._axle = rim_speed, half_axle
        self._change = np.array([rim_speed**2, (rim_speed / half_axle) ** 2]) / _REACTION
        self._state, self._spread = np.zeros(5), np.zeros((5, 5))

    @property
    def motion(self) -> tuple[float, float]:
        """Speed v (m/s) and turn rate omega (rad/s)."""
        return float(self._state[3]), float(self._state[4])

    def start(self, stamp: float, pose: Float[np.ndarray, "d"]) -> None:
        self.stamp = stamp
        self._state = np.concatenate([pose, [0.0, 0.0]])
        self._spread = np.zeros((5, 5))
        self._spread[:3, :3] = self._noise
        self._spread[3, 3], self._spread[4, 4] = self._change * _REACTION

    def take(self, stamp: float, pose: Float[np.ndarray, "d"]) -> None:
        assert self.stamp is not None
        elapsed = stamp - self.stamp
        state, spread = self._moved(elapsed), self._grown(elapsed)
        error = pose - state[:3]
        error[2] = turned(error[2])
        gain = np.linalg.solve(spread[:3, :3] + self._noise, spread[:3]).T
        state = state + gain @ error
        self._spread = spread - gain @ spread[:3]
        self._spread = 0.5 * (self._spread + self._spread.T)
        state[2] = turned(state[2])
        most = abs(state[3]) + self._axle * abs(state[4])
        if most > self._rim:
            state[3:] *= self._rim / most
        self._state, self.stamp = state, stamp

    def _moved(self, elapsed: float) -> Float[np.ndarray, "5"]:
        """The state after `elapsed` (s) on an arc; its chord points along the mean heading."""
        x, y, heading, speed, rate = self._state
        half = 0.5 * rate * elapsed
        chord = speed * elapsed * (math.sin(half) / half if abs(half) > 1e-9 else 1.0)
        return np.array(
            [x + chord * math.cos(heading + half), y + chord * math.sin(heading + half), heading + 2.0 * half,
             speed, rate]
        )  # fmt: skip

    def _grown(self, elapsed: float) -> Float[np.ndarray, "5 5"]:
        _, _, heading, speed, rate = self._state
        middle = heading + 0.5 * rate * elapsed
        cosine, sine = math.cos(middle), math.sin(middle)
        way = speed * elapsed
        slope = np.eye(5)
        slope[0, 2], slope[0, 3], slope[0, 4] = -way * sine, elapsed * cosine, -0.5 * way * elapsed * sine
        slope[1, 2], slope[1, 3], slope[1, 4] = way * cosine, elapsed * sine, 0.5 * way * elapsed * cosine
        slope[2, 4] = elapsed
        noise = np.zeros((5, 5))
        # White noise in the acceleration along the heading and in the turn rate's derivative.
        along = np.array([cosine * elapsed / 2.0, sine * elapsed / 2.0, 0.0, 1.0, 0.0])
        around = np.array([0.0, 0.0, elapsed / 2.0, 0.0, 1.0])
        noise += self._change[0] * elapsed * np.outer(along, along)
        noise += self._change[1] * elapsed * np.outer(around, around)
        return slope @ self._spread @ slope.T + noise

    def at(self, time: float) -> Float[np.ndarray, "d"]:
        if self.stamp is None:
            return np.full(3, np.nan)
        return self._moved(max(time - self.stamp, 0.0))[:3]

    def wheel_speeds(self) -> Float[np.ndarray, "2"]:
        """Left and right rim speed (m/s)."""
        speed, rate = self.motion
        return np.array([speed - self._axle * rate, speed + self._axle * rate])


@final
class ObstacleTrack(Track):
    """An obstacle: constant velocity with white noise in the acceleration.

    `likely_speed` (m/s) is the standard deviation of its velocity before any motion is observed.
    """

    def __init__(self, position_noise: float, likely_speed: float, acceleration: float):
        self._noise = max(position_noise, 1e-5) ** 2
        self._likely, self._jerk = max(likely_speed, 1e-3) ** 2, acceleration**2
        self._state = np.zeros((2, 2))  # position and velocity, by component
        self._spread = np.zeros((2, 2))

    @property
    def velocity(self) -> Float[np.ndarray, "2"]:
        """Drift, m/s."""
        return self._state[1]

    def start(self, stamp: float, pose: Float[np.ndarray, "d"]) -> None:
        self.stamp = stamp
        self._state = np.array([pose[:2], [0.0, 0.0]])
        self._spread = np.diag([self._noise, self._likely])

    def take(self, stamp: float, pose: Float[np.ndarray, "d"]) -> None:
        assert self.stamp is not None
        elapsed = stamp - self.stamp
        slope = np.array([[1.0, elapsed], [0.0, 1.0]])
        along = np.array([elapsed / 2.0, 1.0])
        spread = slope @ self._spread @ slope.T + self._jerk * elapsed * np.outer(along, along)
        gain = spread[:, 0] / (spread[0, 0] + self._noise)
        state = slope @ self._state
        self._state = state + np.outer(gain, pose[:2] - state[0])
        self._spread = spread - np.outer(gain, spread[0])
        self.stamp = stamp

    def at(self, time: float) -> Float[np.ndarray, "d"]:
        if self.stamp is None:
            return np.full(2, np.nan)
        return self._state[0] + self._state[1] * max(time - self.stamp, 0.0)
