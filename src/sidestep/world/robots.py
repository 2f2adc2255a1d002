"""Exact motion of robots under constant commands, and their closest approach."""

from itertools import pairwise
from typing import Any

import jax.numpy as jnp
from jaxtyping import Array, Float

from sidestep._arrays import AnyArray, Lanes, length, stack

_CHORDS = 4
_NEWTON_STEPS = 2


def limit_speed(
    velocity: Float[AnyArray, "2 *lanes"], speed_limit: Float[AnyArray, ""]
) -> Float[Array, "2 *lanes"]:
    """Project a velocity (m/s) on the disc |u| <= `speed_limit`; a non-finite velocity becomes a stop.

    The physics thus never exceeds the robot's limits, and never gets a NaN into the state, where later
    comparisons would silently be false.
    """
    finite = jnp.isfinite(velocity[0]) & jnp.isfinite(velocity[1])
    # Clipped far above any speed, so that the square of a huge command does not overflow.
    x, y = (jnp.clip(jnp.where(finite, component, 0.0), -1e15, 1e15) for component in velocity)
    squared = x * x + y * y
    # At the limit, rounding decides the comparison, and XLA may evaluate it separately for each component.
    # Both branches must therefore give the same result, and so both divide by the speed.
    fast = squared > 0.25 * speed_limit**2
    speed = jnp.sqrt(jnp.where(fast, squared, 1.0))
    scale = jnp.where(squared > speed_limit**2, speed_limit / speed, 1.0)
    return stack(x * scale, y * scale)


def limit_wheels(
    wheel_speeds: Float[AnyArray, "2 *lanes"], rim_speed: Float[AnyArray, ""]
) -> Float[Array, "2 *lanes"]:
    """Clip wheel rim speeds (m/s) to [-V, V], which is |v| + b|omega| <= V; non-finite ones become 0."""
    finite = (jnp.where(jnp.isfinite(speed), speed, 0.0) for speed in wheel_speeds)
    return stack(*(jnp.clip(speed, -rim_speed, rim_speed) for speed in finite))


def wrap_angle(angle: Float[AnyArray, "..."]) -> Float[Array, "..."]:
    """The same angle (rad) in [-pi, pi)."""
    return jnp.mod(angle + jnp.pi, 2.0 * jnp.pi) - jnp.pi


def body_velocity(
    wheel_speeds: Float[AnyArray, "2 *lanes"], half_axle: Float[AnyArray, ""]
) -> tuple[Lanes, Lanes]:
    """Speed v (m/s) and turn rate omega (rad/s) of a differential drive.

    v = (u1 + u2)/2 and omega = (u2 - u1)/(2b), with u1, u2 the left and right wheel *rim speeds* in
    m/s and b the half axle (paper, section II-A; the paper calls u1, u2 angular velocities, but its
    equations hold for rim speeds only).
    """
    left, right = wheel_speeds[0], wheel_speeds[1]
    return (left + right) / 2.0, (right - left) / (2.0 * half_axle)


def wheels_from_body(
    speed: Float[AnyArray, "*lanes"], turn_rate: Float[AnyArray, "*lanes"], half_axle: Float[AnyArray, ""]
) -> Float[Array, "2 *lanes"]:
    """Wheel rim speeds (left, right) in m/s that give speed v and turn rate omega."""
    return stack(speed - half_axle * turn_rate, speed + half_axle * turn_rate)


def drive(
    pose: Float[AnyArray, "3 *lanes"],
    wheel_speeds: Float[AnyArray, "2 *lanes"],
    half_axle: Float[AnyArray, ""],
    duration: Float[AnyArray, ""],
) -> Float[Array, "3 *lanes"]:
    """Differential drive: exact motion while the wheel speeds are held.

    The path is a circular arc. Its chord has length v T sinc(omega T / 2) and points half the turn
    away from the first heading, which is exact for every omega and smooth through omega = 0.

    **Arguments:** `pose` x, y (m), heading (rad); `wheel_speeds` left, right (m/s); `half_axle` b (m);
    `duration` T (s). **Returns** the pose after T, its heading in [-pi, pi).
    """
    speed, turn_rate = body_velocity(wheel_speeds, half_axle)
    half_turn = turn_rate * duration / 2.0
    chord = speed * duration * jnp.sinc(half_turn / jnp.pi)
    along = pose[2] + half_turn
    return jnp.stack(
        [
            pose[0] + chord * jnp.cos(along),
            pose[1] + chord * jnp.sin(along),
            wrap_angle(pose[2] + 2.0 * half_turn),
        ]
    )


def glide(
    position: Float[AnyArray, "2 *lanes"],
    velocity: Float[AnyArray, "2 *lanes"],
    duration: Float[AnyArray, ""],
) -> Float[Array, "2 *lanes"]:
    """Omnidirectional robot or drifting obstacle: straight motion at constant velocity."""
    return stack(position[0] + velocity[0] * duration, position[1] + velocity[1] * duration)


def closest_approach_straight(
    relative_position: Float[AnyArray, "2 *lanes"],
    relative_velocity: Float[AnyArray, "2 *lanes"],
    duration: Float[AnyArray, ""],
) -> Lanes:
    """Smallest distance (m) between two robots in straight motion during a hold (closed form)."""
    (x, y), (vx, vy) = relative_position, relative_velocity
    squared_speed = vx * vx + vy * vy
    still = squared_speed == 0.0
    when = -(x * vx + y * vy) / jnp.where(still, 1.0, squared_speed)
    when = jnp.clip(jnp.where(still, 0.0, when), 0.0, duration)
    return length(x + vx * when, y + vy * when)


def closest_approach_driving(
    position: Float[AnyArray, "2 *lanes"],
    velocity: Float[AnyArray, "2 *lanes"],
    pose: Float[AnyArray, "3 *lanes"],
    wheel_speeds: Float[AnyArray, "2 *lanes"],
    half_axle: Float[AnyArray, ""],
    duration: Float[AnyArray, ""],
) -> Lanes:
    """Smallest distance (m) between a robot in straight motion and a differential drive during a hold.

    There is no closed form for a line and an arc. Four chords bracket the minimum, Newton's method on
    d/dt |q|^2 refines it, and the distance is evaluated on the true paths. So the result is never below the
    true minimum, and exceeds it only by second order in a tiny time error.
    """
    speed, turn_rate = body_velocity(wheel_speeds, half_axle)
    x, y = position[0] - pose[0], position[1] - pose[1]
    vx, vy = velocity[0], velocity[1]
    ahead, left = jnp.cos(pose[2]), jnp.sin(pose[2])

    def arc(when: Any) -> tuple[Lanes, Lanes, Lanes, Lanes]:
        """The pursuer's position on its arc, and cos and sin of its heading."""
        # The chord points half the turn away from the first heading, the final heading the full turn. With
        # addition theorems both need only one sine and one cosine.
        half_turn = turn_rate * when / 2.0
        cosine, sine = jnp.cos(half_turn), jnp.sin(half_turn)
        turning = half_turn != 0.0
        chord = speed * when * jnp.where(turning, sine / jnp.where(turning, half_turn, 1.0), 1.0)
        mx, my = ahead * cosine - left * sine, left * cosine + ahead * sine
        return chord * mx, chord * my, mx * cosine - my * sine, my * cosine + mx * sine

    def separation(when: Any) -> tuple[Lanes, Lanes]:
        px, py, _, _ = arc(when)
        return x + vx * when - px, y + vy * when - py

    # Equal chords, each rotated by the same angle relative to the previous one.
    step = duration / _CHORDS
    px, py, cosine, sine = arc(step)
    cosine, sine = cosine * ahead + sine * left, sine * ahead - cosine * left
    knots = [(x, y)]
    for _ in range(_CHORDS):
        knots.append((knots[-1][0] + vx * step - px, knots[-1][1] + vy * step - py))
        px, py = px * cosine - py * sine, py * cosine + px * sine

    best, low, when = jnp.inf, 0.0, 0.0
    for i, ((x0, y0), (x1, y1)) in enumerate(pairwise(knots)):
        cx, cy = x1 - x0, y1 - y0
        squared = cx * cx + cy * cy
        share = jnp.clip(-(x0 * cx + y0 * cy) / jnp.where(squared == 0.0, 1.0, squared), 0.0, 1.0)
        distance = (x0 + share * cx) ** 2 + (y0 + share * cy) ** 2
        nearer = distance < best
        best = jnp.where(nearer, distance, best)
        low = jnp.where(nearer, step * i, low)
        when = jnp.where(nearer, step * (i + share), when)
    for _ in range(_NEWTON_STEPS):
        px, py, cosine, sine = arc(when)
        qx, qy = x + vx * when - px, y + vy * when - py
        rx, ry = vx - speed * cosine, vy - speed * sine
        slope = rx * rx + ry * ry + speed * turn_rate * (qx * sine - qy * cosine)
        update = when - (qx * rx + qy * ry) / jnp.where(slope > 0.0, slope, 1.0)
        when = jnp.where(slope > 0.0, jnp.clip(update, low, low + step), when)
    ends = jnp.minimum(length(x, y), length(*knots[-1]))
    return jnp.minimum(length(*separation(when)), ends)
