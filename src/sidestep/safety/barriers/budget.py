"""How much of the distances that a shield keeps do measurement, delay and motors take?"""

from __future__ import annotations

import warnings

import equinox as eqx
import jax.numpy as jnp
import numpy as np

from sidestep._arrays import Scalar, real, traced
from sidestep._bounds import DELAY, DISTANCE, HEADING_ERROR, TRACKING_ERROR, check, within
from sidestep.pursuit.game import CaptureGame
from sidestep.store.programs import kept_jit
from sidestep.world.scenario import Scenario


class BudgetWarning(UserWarning):
    """The budget exceeds what the game allows: there is no guarantee, and the shield violates it least."""


class Budget(eqx.Module):
    """Errors that a shield allows for.

    - `position_error` m, bounds the error of the relative position of evader and another robot
    - `heading_error` rad, bounds the error of a pursuer's heading
    - `delay` s, from the time at which a pose was true to the time at which the command based on it acts
    - `tracking_error` e, m/s, bounds |velocity driven - commanded velocity|
    - `own_motion_predicted`: the evader's position is advanced by its commands over the delay

    Beyond the capture distance l the rows towards pursuers keep

        position_error + b rho heading_error + v_e delay (2 v_e delay if the own motion is not predicted).

    The reason: the barrier changes by at most 1 per metre and b rho per radian, and an unseen pursuer lowers
    it at v_e at most. The rows towards obstacles keep `position_error`, and v_e delay if the own motion is
    not predicted. With a tracking error e every row asks for e more, and the capture set is that of an evader
    of speed v_e - e, if such an evader can win.

    `certify` says what is guaranteed with such errors. It also counts that errors hide the side of the
    pursuer's axis. All numbers are traced: others never recompile.
    """

    position_error: Scalar = eqx.field(converter=real, default=0.0, metadata=within(DISTANCE))
    heading_error: Scalar = eqx.field(converter=real, default=0.0, metadata=within(HEADING_ERROR))
    delay: Scalar = eqx.field(converter=real, default=0.0, metadata=within(DELAY))
    tracking_error: Scalar = eqx.field(converter=real, default=0.0, metadata=within(TRACKING_ERROR))
    own_motion_predicted: bool = eqx.field(static=True, default=True)

    def check(self, scenario: Scenario) -> None:
        """**Raises** `ValueError` for a part that is negative, not finite, or too large."""
        check(self, title="budget: ")
        if float(self.tracking_error) >= float(scenario.evader_speed):
            raise ValueError(
                f"budget: tracking_error = {float(self.tracking_error):g} m/s is no less than the evader's "
                f"speed, {float(scenario.evader_speed):g} m/s: no command would count"
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
        """Evader speed (m/s) for the capture set of distance `kept` (m): v_e - e, or v_e where l_max(v_e - e)
        is less than that distance."""
        sure, largest = self._sure(scenario)
        return jnp.where(largest >= kept, sure, scenario.evader_speed)

    def _sure(self, scenario: Scenario) -> tuple[Scalar, Scalar]:
        """v_e - e (m/s) and l_max(v_e - e) (m)."""
        sure = scenario.evader_speed - self.tracking_error
        game = eqx.tree_at(lambda game: game.evader_speed, CaptureGame.of(scenario), sure)
        return sure, game.largest_capture_distance

    def excess(self, scenario: Scenario) -> Scalar:
        """By how much (m) l plus the budget exceeds l_max(v_e - e); negative where the game leaves room.

        Sampling and the doubt about the side come on top, see `certify`.
        """
        return scenario.capture_distance + self.towards_pursuers(scenario) - self._sure(scenario)[1]

    def announce(self, scenario: Scenario) -> str | None:
        """Check the budget and warn if it exceeds what the game allows; returns the words of the warning.

        **Raises** as `check`. **Warns** `BudgetWarning`. Traced values are not checked.
        """
        if traced((self, scenario)):
            return None
        self.check(scenario)
        excess = float(np.asarray(_excess(self, scenario)))
        if not excess > 0.0:
            return None
        message = (
            f"the budget exceeds what the game allows by {1e3 * excess:.3g} mm: a good pursuer can come "
            f"closer than {float(scenario.capture_distance):g} m. The shield keeps as much as it can; "
            "`sidestep certify` names the nearest changes that would make it hold"
        )
        warnings.warn(message, BudgetWarning, stacklevel=3)
        return message


@kept_jit
def _excess(budget: Budget, scenario: Scenario) -> Scalar:
    return budget.excess(scenario)
