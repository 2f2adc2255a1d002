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
    """Turn (rad, >= 0) towards the side of `y`, length (m) of the arc and its tangent to the point (x, y),
    and whether the point lies inside the turning circle; then the length is that with a turn to the other
    side."""
    aside = jnp.abs(y)
    inside = x * x + (aside - radius) ** 2 < radius * radius
    # Angles at the circle's centre: to the point, less that between the point and the tangent point.
    beside = jnp.where(inside, -aside, aside)
    squared = x * x + (beside - radius) ** 2 - radius * radius
    straight = jnp.sqrt(jnp.maximum(squared, jnp.finfo(squared.dtype).tiny))
    turn = jnp.mod(jnp.arctan2(x, radius - beside) - jnp.arctan2(straight, radius), 2.0 * jnp.pi)
    # Straight ahead, rounding may turn 0 into a full circle.
    turn = jnp.where(2.0 * jnp.pi - turn < 1e-3, 0.0, turn)
    return turn, radius * turn + straight, inside


@final
class Chauffeur(Pursuer):
    """Drives to the earliest interception point with an evader of constant velocity, without arriving early.

    The path is an arc of the smallest radius and its tangent (Dubins, "On curves of minimal length", American
    Journal of Mathematics 1957). While the point lies inside the turning circle it drives straight, to turn
    back from farther away: the swerve of the homicidal chauffeur (Isaacs, "Differential Games", 1965). The
    radius is that of the scenario's pursuer at its largest turn rate.
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

        # Search the first time at which it can arrive on a grid, then refine by bisection. Points inside the
        # circle split the feasible times into intervals, so bisection alone or a fixed point may miss it.
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
        # Close to the evader, turn directly towards it.
        near = distance <= 2.0 * scenario.capture_distance
        turn = jnp.where(near, bearing_of(stack(z[0], z[1])), turn)
        # It cannot wait for the evader, so it slows down to arrive in time.
        share = jnp.clip(way / (speed * jnp.maximum(time, period)), 0.0, 1.0)
        forward = full * jnp.where(near | inside, 1.0, share)
        return wheels_from_body(forward, jnp.clip(turn / period, -turn_rate, turn_rate), axle)
