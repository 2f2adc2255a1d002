"""A strategy for pursuers that cannot turn on the spot: cars, boats, aircraft."""

from __future__ import annotations

from typing import Any, final

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, PRNGKeyArray

from sidestep._arrays import Lanes, length, stack
from sidestep.pursuit.pursuers import Pursuer
from sidestep.pursuit.steering import bearing_of
from sidestep.world.capture_geometry import to_pursuer_frame
from sidestep.world.robots import body_velocity, wheels_from_body
from sidestep.world.scenario import Scenario
from sidestep.world.state import World

_TIMES, _LONGER = 48, 1.12
_HALVINGS = 6


def _turn_to(x: Lanes, y: Lanes, radius: Lanes) -> tuple[Lanes, Lanes, Bool[Array, "*lanes"]]:
    """Turn (rad, not negative) towards a place at the side of `y`, way (m) along arc and tangent to it, and
    whether it lies inside the turning circle; then the way is that around the circle on the other side."""
    aside = jnp.abs(y)
    inside = x * x + (aside - radius) ** 2 < radius * radius
    # From a circle's centre: the place, less the angle between it and the point where the tangent is.
    beside = jnp.where(inside, -aside, aside)
    squared = x * x + (beside - radius) ** 2 - radius * radius
    straight = jnp.sqrt(jnp.maximum(squared, jnp.finfo(squared.dtype).tiny))
    turn = jnp.mod(jnp.arctan2(x, radius - beside) - jnp.arctan2(straight, radius), 2.0 * jnp.pi)
    # Straight ahead rounding makes a full circle of no turn at all.
    turn = jnp.where(2.0 * jnp.pi - turn < 1e-3, 0.0, turn)
    return turn, radius * turn + straight, inside


@final
class Chauffeur(Pursuer):
    """To where it meets the evader soonest if that keeps its velocity, as fast as it can without being early.

    The way there is an arc of the smallest radius and its tangent (Dubins, "On curves of minimal length",
    American Journal of Mathematics 1957). While that place lies inside the turning circle it flies straight
    on, to turn back from farther away: the swerve of the homicidal chauffeur (Isaacs, "Differential Games",
    1965). The radius is that of whatever the scenario's pursuer does when told to turn as fast as it can.
    """

    takes_lanes = True
    always_finite = True

    def steer(self, scenario: Scenario, world: World, key: PRNGKeyArray) -> Float[Array, "2 *lanes"]:
        speed, axle, period = scenario.pursuer_speed, scenario.pursuer_half_axle, scenario.control_period
        z = to_pursuer_frame(world.evader, world.pursuer)
        ahead = to_pursuer_frame(world.evader + world.evader_velocity, world.pursuer) - z
        full = jnp.ones_like(z[0]) * speed
        hardest = scenario.drivable(wheels_from_body(full, 10.0 * full / axle, axle))
        forwards, turn_rate = body_velocity(hardest, axle)
        radius = jnp.maximum(forwards, 0.0) / turn_rate

        def comes_too_late(time: Lanes) -> Bool[Array, "*lanes"]:
            _, way, _ = _turn_to(z[0] + ahead[0] * time, z[1] + ahead[1] * time, radius)
            return way - scenario.capture_distance > speed * time

        # The first of many times at which it could be there, and then more closely. Places inside the circle
        # part those times into stretches, so that neither halving all time nor a fixed point finds the first.
        def later(_: Any, found: tuple[Lanes, Lanes]) -> tuple[Lanes, Lanes]:
            time, step = found
            waits = comes_too_late(time)
            return jnp.where(waits, time + step, time), jnp.where(waits, _LONGER * step, step)

        def nearer(_: Any, found: tuple[Lanes, Lanes]) -> tuple[Lanes, Lanes]:
            time, step = found[0], 0.5 * found[1]
            return jnp.where(comes_too_late(time - step), time, time - step), step

        start = (jnp.zeros_like(z[0]), jnp.ones_like(z[0]) * period)
        time, step = jax.lax.fori_loop(0, _TIMES, later, start)
        time, _ = jax.lax.fori_loop(0, _HALVINGS, nearer, (time, step / _LONGER))
        time = jnp.maximum(time, 0.0)
        distance = length(z[0], z[1])
        x, y = z[0] + ahead[0] * time, z[1] + ahead[1] * time
        turn, way, inside = _turn_to(x, y, radius)
        side = jnp.where(y < 0.0, -1.0, 1.0)
        turn = jnp.where(inside, 0.0, side * turn)
        # Right in front of it, it turns at the evader itself.
        near = distance <= 2.0 * scenario.capture_distance
        turn = jnp.where(near, bearing_of(stack(z[0], z[1])), turn)
        # There before the evader it could not wait.
        hurry = jnp.clip(way / (speed * jnp.maximum(time, period)), 0.0, 1.0)
        told = full * jnp.where(near | inside, 1.0, hurry)
        return wheels_from_body(told, jnp.clip(turn / period, -turn_rate, turn_rate), axle)
