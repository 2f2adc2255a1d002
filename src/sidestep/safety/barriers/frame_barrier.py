"""A custom barrier from its value alone: a function of the evader's position in the pursuer's frame."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, final

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from sidestep._arrays import Lanes, Scalar, lane_by_lane, real, stack
from sidestep.safety.barriers.barrier import Barrier
from sidestep.world.capture_geometry import to_pursuer_frame
from sidestep.world.scenario import Scenario
from sidestep.world.state import World


def pursuer_corners(scenario: Scenario) -> Float[Array, "n 2"]:
    """Speeds (m/s) and turn rates (rad/s) whose convex hull holds every motion of the pursuer."""
    if scenario.pursuer_model is not None:
        return scenario.pursuer_model.corners(scenario)
    speed = scenario.pursuer_speed
    turn, none = speed / scenario.pursuer_half_axle, jnp.zeros_like(speed)
    return stack(stack(speed, none), stack(-speed, none), stack(none, turn), stack(none, -turn))


@final
class FrameBarrier(Barrier):
    """h(z) towards every pursuer, with z (m) the evader's position in its frame: x ahead, y to the left.

    The row is n.u >= max over the pursuer's motions of (v g_x - omega (g_x z_y - g_y z_x)) - gamma h, with
    g = dh/dz by automatic differentiation and n = R(theta) g. It gives h' >= -gamma h whatever the pursuer
    does. The rate is affine in (v, omega), so its maximum is at one of the model's `corners`.

    **Arguments:** `function(scenario, z (2,)) -> h ()` in m, written with JAX, `gain` gamma in 1/s (the
    scenario's `pursuer_gain` without one). Arrays within the function (a grid of values, say) stay traced.
    """

    gain: Scalar | None
    _arrays: Any
    _rest: Any = eqx.field(static=True)

    def __init__(self, function: Callable[[Scenario, Any], Any], gain: float | None = None):
        self.gain = None if gain is None else real(gain)
        self._arrays, self._rest = eqx.partition(function, eqx.is_inexact_array)

    def _at(self, scenario: Scenario, z: Float[Array, "2"]) -> tuple[Scalar, Float[Array, "2"]]:
        function = eqx.combine(self._arrays, self._rest)
        return jax.value_and_grad(lambda z: function(scenario, z))(z)

    def robots(self, world: World) -> Float[Array, "n 3 *lanes"]:
        return world.pursuers

    def value(self, scenario: Scenario, evader: Any, robot: Any, memory: Any) -> Lanes:
        z = to_pursuer_frame(evader, robot)
        return lane_by_lane(lambda z: self._at(scenario, z)[0], z.ndim - 1, z)

    def gradient_and_rate(
        self, scenario: Scenario, evader: Any, robot: Any, memory: Any
    ) -> tuple[Float[Array, "2 *lanes"], Lanes]:
        z = to_pursuer_frame(evader, robot)
        ahead, left = lane_by_lane(lambda z: self._at(scenario, z)[1], z.ndim - 1, z)
        turned = ahead * z[1] - left * z[0]
        rates = [corner[0] * ahead - corner[1] * turned for corner in pursuer_corners(scenario)]
        cosine, sine = jnp.cos(robot[2]), jnp.sin(robot[2])
        normal = stack(cosine * ahead - sine * left, sine * ahead + cosine * left)
        return normal, jnp.max(jnp.stack(rates), axis=0)

    def alpha(self, scenario: Scenario, h: Any) -> Lanes:
        return (scenario.pursuer_gain if self.gain is None else self.gain) * h
