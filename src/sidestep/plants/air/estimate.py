"""The quadrotor's estimate of its motion, from accelerations and delayed positions."""

from __future__ import annotations

import math
from collections import deque
from typing import final

import numpy as np
from jaxtyping import Float

Vector = Float[np.ndarray, "3"]


@final
class OwnMotion:
    """Estimates position and velocity from frequent accelerations and rare, delayed positions.

    A position is compared with the estimate for its time stamp; the difference corrects position and velocity
    with the steady-state Kalman gains of a double integrator, for noise of `acceleration_noise` (m/s^2 per
    root hertz) and `position_noise` (m).
    """

    def __init__(self, acceleration_noise: float, position_noise: float, pose_period: float):
        # Kalata's tracking index and its alpha-beta gains (IEEE T-AES 1984).
        index = acceleration_noise * pose_period**1.5 / max(position_noise, 1e-6)
        root = (4.0 + index - math.sqrt(8.0 * index + index * index)) / 4.0
        self._alpha = 1.0 - root * root
        self._beta = 2.0 * (2.0 - self._alpha) - 4.0 * math.sqrt(1.0 - self._alpha)
        self._pose_period = pose_period

    def start(self, now: float, position: Vector, velocity: Vector) -> None:
        """Start from this position (m) and velocity (m/s) at `now` (s)."""
        self.position, self.velocity = np.array(position, float), np.array(velocity, float)
        self._past: deque[tuple[float, Vector]] = deque([(now, self.position.copy())], maxlen=256)

    def feel(self, now: float, acceleration: Vector, elapsed: float) -> None:
        """An acceleration (m/s^2, world axes, without gravity) that held for `elapsed` (s) until `now`."""
        self.position += elapsed * (self.velocity + 0.5 * elapsed * acceleration)
        self.velocity += elapsed * acceleration
        self._past.append((now, self.position.copy()))

    def see(self, stamp: float, position: Vector) -> None:
        """A position (m) that was true at `stamp` (s)."""
        while len(self._past) > 1 and self._past[1][0] <= stamp + 1e-9:
            self._past.popleft()
        off = position - self._past[0][1]
        self.position += self._alpha * off
        self.velocity += self._beta / self._pose_period * off
        for _, before in self._past:
            before += self._alpha * off
