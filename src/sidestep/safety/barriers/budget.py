"""What measurement, delay and the robot's own motors take from the distances that a shield keeps."""

from __future__ import annotations

import math
import warnings

import equinox as eqx
import jax.numpy as jnp
import numpy as np

from sidestep._arrays import Scalar, real, traced
from sidestep.pursuit.game import CaptureGame
from sidestep.world.scenario import Scenario


class BudgetWarning(UserWarning):
    """The budget is more than the game leaves: nothing is guaranteed, and the shield violates it least."""


class Budget(eqx.Module):
    """Errors that a shield allows for.

    The rows towards pursuers keep, beyond the capture distance l,

        position_error + b rho heading_error + v_e delay (2 v_e delay if the own motion is not predicted),

    since the barrier changes by at most 1 per metre and b rho per radian, and an unseen pursuer lowers it no
    faster than v_e. The rows towards obstacles keep `position_error` and, if the own motion is not predicted,
    v_e delay. With a `tracking_error` e the robot drives within e of what it is told: every row asks for e
    more, and the capture set is that of an evader of speed v_e - e, as long as such an evader can win.

    - `position_error` bounds how far the relative position of evader and another robot is off, m
    - `heading_error` bounds how far a pursuer's heading is off, rad
    - `delay` from when a pose was true to when the command decided on it acts, s
    - `tracking_error` bounds |velocity driven - velocity told|, m/s
    - `own_motion_predicted`: the evader's position is advanced by its commands over that delay

    What can be guaranteed with such errors is the certificate's business (`certify`); it also counts that
    errors hide the side of the pursuer's axis. All numbers are traced: others never recompile.
    """

    position_error: Scalar = eqx.field(converter=real, default=0.0)
    heading_error: Scalar = eqx.field(converter=real, default=0.0)
    delay: Scalar = eqx.field(converter=real, default=0.0)
    tracking_error: Scalar = eqx.field(converter=real, default=0.0)
    own_motion_predicted: bool = eqx.field(static=True, default=True)

    def check(self, scenario: Scenario) -> None:
        """**Raises** `ValueError` for a part that is negative, not finite, or more than the robot has."""
        for name in ("position_error", "heading_error", "delay", "tracking_error"):
            value = float(getattr(self, name))
            if not (math.isfinite(value) and value >= 0.0):
                raise ValueError(f"budget: {name} = {value!r}: it must be a finite number, 0 or more")
        if float(self.heading_error) >= math.pi / 2.0:
            raise ValueError(f"budget: heading_error = {float(self.heading_error):g} rad is pi/2 or more")
        if float(self.tracking_error) >= float(scenario.evader_speed):
            raise ValueError(
                f"budget: tracking_error = {float(self.tracking_error):g} m/s is no less than the evader's "
                f"speed, {float(scenario.evader_speed):g} m/s: nothing that it is told would count"
            )

    def towards_pursuers(self, scenario: Scenario) -> Scalar:
        """Distance (m) kept beyond the capture distance."""
        ratio = jnp.minimum(scenario.evader_speed / scenario.pursuer_speed, 1.0)
        times = 1.0 if self.own_motion_predicted else 2.0
        return (
            self.position_error
            + scenario.pursuer_half_axle * ratio * self.heading_error
            + times * scenario.evader_speed * self.delay
        )

    def towards_obstacles(self, scenario: Scenario) -> Scalar:
        """Distance (m) kept beyond the collision distance."""
        unseen = 0.0 if self.own_motion_predicted else 1.0
        return self.position_error + unseen * scenario.evader_speed * self.delay

    def sure_speed(self, scenario: Scenario, kept: Scalar) -> Scalar:
        """The speed (m/s) that the capture set of distance `kept` (m) is built for: v_e - e, or v_e where an
        evader that slow could not hold it."""
        sure = scenario.evader_speed - self.tracking_error
        game = eqx.tree_at(
            lambda g: (g.evader_speed, g.capture_distance), CaptureGame.of(scenario), (sure, kept)
        )
        return jnp.where(game.largest_capture_distance >= kept, sure, scenario.evader_speed)

    def excess(self, scenario: Scenario) -> Scalar:
        """By how much (m) l plus the budget is more than l_max(v_e - e); negative where the game leaves room.

        Sampling and the doubt about sides come on top, see `certify`.
        """
        slower = eqx.tree_at(lambda s: s.evader_speed, scenario, scenario.evader_speed - self.tracking_error)
        return (
            scenario.capture_distance
            + self.towards_pursuers(scenario)
            - CaptureGame.of(slower).largest_capture_distance
        )

    def announce(self, scenario: Scenario) -> str | None:
        """Check the budget and warn if it exceeds what the game allows; returns what the warning says.

        **Raises** as `check`. **Warns** `BudgetWarning`. Silent about traced values, which are not known yet.
        """
        if traced((self, scenario)):
            return None
        self.check(scenario)
        excess = float(np.asarray(self.excess(scenario)))
        if not excess > 0.0:
            return None
        message = (
            f"the budget exceeds what the game allows by {1e3 * excess:.3g} mm: a good pursuer can come "
            f"closer than {float(scenario.capture_distance):g} m. The shield keeps as much as it can; "
            "`sidestep certify` names the nearest changes that would make it hold"
        )
        warnings.warn(message, BudgetWarning, stacklevel=3)
        return message
