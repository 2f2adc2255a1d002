"""Wheel speeds that turn a differential drive to a bearing and drive along it, for one control period."""

import jax.numpy as jnp
from jaxtyping import Array, Float

from sidestep._arrays import AnyArray, Lanes, no_fuse
from sidestep.world.robots import wheels_from_body


def bearing_of(z: Float[AnyArray, "2 *lanes"]) -> Lanes:
    """Direction (rad) of z, in [-pi, pi]; 0 at the origin, with a finite derivative there."""
    somewhere = (z[0] != 0.0) | (z[1] != 0.0)
    ahead, left = jnp.where(somewhere, z[0], 1.0), jnp.where(somewhere, z[1], 0.0)
    # Slow, and used for both wheels.
    return no_fuse(jnp.arctan2, left, ahead) if left.ndim else jnp.arctan2(left, ahead)


def nearer_end(bearing: Float[AnyArray, "*lanes"]) -> tuple[Lanes, Lanes]:
    """The end nearer to `bearing` (rad), +1 front or -1 rear, and the turn (rad) that points it there."""
    behind = jnp.abs(bearing) > jnp.pi / 2.0
    turn = jnp.where(behind, bearing - jnp.where(bearing < 0.0, -jnp.pi, jnp.pi), bearing)
    return jnp.where(behind, -1.0, 1.0).astype(turn.dtype), turn


def turn_and_drive(
    turn: Float[AnyArray, "*lanes"],
    end: Float[AnyArray, "..."],
    rim_speed: Float[AnyArray, ""],
    half_axle: Float[AnyArray, ""],
    period: Float[AnyArray, ""],
    turning_share: float = 1.0,
) -> Float[Array, "2 *lanes"]:
    """Turn by `turn` (rad) and drive with the rest of the wheel speed; `end` +1 drives forward, -1 backward.

    The turn is exact if it fits into one control period, so that the heading does not oscillate.
    `turning_share` limits the part of the wheel speed for turning: 1 turns in place while the turn takes more
    than a period, 1/2 keeps the inner wheel from driving backward, so that the robot drives an arc.
    """
    fastest = turning_share * rim_speed / half_axle
    turn_rate = jnp.clip(turn / period, -fastest, fastest)
    return wheels_from_body(end * (rim_speed - half_axle * jnp.abs(turn_rate)), turn_rate, half_axle)
