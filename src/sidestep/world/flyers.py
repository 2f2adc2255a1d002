"""Robots that fly at constant height: a quadrotor with velocity commands, and an aircraft with wide turns."""

from __future__ import annotations

from typing import final

import jax.numpy as jnp
from jaxtyping import Array, Float, PRNGKeyArray

from sidestep._arrays import Scalar, real
from sidestep._bounds import bounded, check
from sidestep.world.models import EvaderModel, EvaderState, PursuerModel
from sidestep.world.scenario import Scenario

GRAVITY = 9.81
"""m/s^2."""
_NEWTON_STEPS = 8


@final
class Quadrotor(EvaderModel):
    """A quadrotor with an autopilot that turns commanded velocities into a motion that the airframe follows.

    For the commanded velocity u this reference motion is

        a' = ((u - v)/tau - a)/T,   v' = a,   p' = v,

    with tau the time constant of the velocity loop and T that of the attitude loop. The control point
    p + tau v + tau T a moves with velocity u. Its distance from p is at most tau v_e for |u| <= v_e (the
    response from u to that difference has no overshoot for tau > 4 T). The airframe's deviation from this
    motion is a position error, see `sidestep.plants.air`.

    **Raises** `ValueError` for time constants that are not above 0, or tau <= 4 T.
    """

    time_constant: float = bounded(0.22, above=0.0, unit="s")
    """tau, s."""
    attitude_lag: float = bounded(0.05, above=0.0, unit="s")
    """T, s."""

    def __check_init__(self):
        check(self)
        tau, lag = float(self.time_constant), float(self.attitude_lag)
        if tau <= 4.0 * lag:
            raise ValueError(
                f"time_constant = {tau:g} s, attitude_lag = {lag:g} s: the time constant must be more than "
                "four times the lag, or the velocity overshoots"
            )

    def _rates(self) -> tuple[Scalar, Scalar]:
        """The two eigenvalues (1/s, negative) of the velocity's dynamics."""
        tau, lag = real(self.time_constant), real(self.attitude_lag)
        root = jnp.sqrt(tau * tau - 4.0 * tau * lag)
        return (root - tau) / (2.0 * tau * lag), -(root + tau) / (2.0 * tau * lag)

    def largest_acceleration(self, scenario: Scenario) -> Scalar:
        """The largest acceleration (m/s^2) under any commands up to v_e: 2 v_e times the peak of the response
        of v to an impulse of u."""
        slow, fast = self._rates()
        when = jnp.log(fast / slow) / (slow - fast)
        peak = slow * fast / (slow - fast) * (jnp.exp(slow * when) - jnp.exp(fast * when))
        return 2.0 * scenario.evader_speed * peak

    def largest_tilt(self, scenario: Scenario) -> Scalar:
        """The tilt (rad) at the largest acceleration and constant height."""
        return jnp.arctan(self.largest_acceleration(scenario) / GRAVITY)

    def start(self, scenario: Scenario, key: PRNGKeyArray) -> Float[Array, "2"]:
        """Hovering: acceleration (m/s^2) 0."""
        return jnp.zeros(2, dtype=float)

    def after(
        self, scenario: Scenario, robot: EvaderState, command: Float[Array, "2"], time: Scalar
    ) -> EvaderState:
        slow, fast = self._rates()
        excess = robot.velocity - command
        one = (robot.state - fast * excess) / (slow - fast)
        other = excess - one
        position = robot.position + command * time
        position += one * jnp.expm1(slow * time) / slow + other * jnp.expm1(fast * time) / fast
        one, other = one * jnp.exp(slow * time), other * jnp.exp(fast * time)
        return EvaderState(position, command + one + other, slow * one + fast * other)

    def control_point(self, scenario: Scenario, robot: EvaderState) -> Float[Array, "2"]:
        return robot.position + self.time_constant * (robot.velocity + self.attitude_lag * robot.state)

    def mirrored(self, state: Float[Array, "2"]) -> Float[Array, "2"]:
        return state * real((1.0, -1.0))

    def offset(self, scenario: Scenario) -> Scalar:
        return self.time_constant * scenario.evader_speed


@final
class Aircraft(PursuerModel):
    """Flies forwards at speeds from `slowest` V to V, on arcs of `turning_radius` (m) or more.

    Shields assume the covering differential drive with the largest l_max: b = (y - 1) R and V' = y V, with y
    the root of y^3 - 2 y^2 + (v_e/V)^2 = 0 between 1.6 and 2.

    **Raises** `ValueError` for a radius that is not above 0, or a share outside [0, 1].
    """

    turning_radius: float = bounded(4.0, above=0.0, unit="m")
    """R, m."""
    slowest: float = bounded(0.5, least=0.0, most=1.0)
    """Least speed as a share of V."""

    def __check_init__(self):
        check(self)

    def limit(self, scenario: Scenario, speed: Scalar, turn_rate: Scalar) -> tuple[Scalar, Scalar]:
        top = scenario.pursuer_speed
        speed = jnp.clip(speed, self.slowest * top, top)
        tightest = speed / self.turning_radius
        return speed, jnp.clip(turn_rate, -tightest, tightest)

    def corners(self, scenario: Scenario) -> Float[Array, "4 2"]:
        top, rate = scenario.pursuer_speed, 1.0 / self.turning_radius
        shares = real([(1.0, rate), (1.0, -rate)])
        return jnp.concatenate([top * shares, self.slowest * top * shares])

    def covering(self, scenario: Scenario) -> tuple[Scalar, Scalar]:
        ratio = jnp.minimum(scenario.evader_speed / scenario.pursuer_speed, 1.0)
        y = real(2.0)
        for _ in range(_NEWTON_STEPS):
            y -= (y**3 - 2.0 * y**2 + ratio**2) / (3.0 * y**2 - 4.0 * y)
        return y * scenario.pursuer_speed, (y - 1.0) * self.turning_radius
