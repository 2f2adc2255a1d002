"""How robots move: exact motion over one zero-order hold, and the closest approach within it."""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from sidestep._arrays import AnyArray, Lanes, Scalar, norm, real

_CHORDS = 4
_NEWTON_STEPS = 2


def limit_speed(velocity: Float[AnyArray, "2"], speed_limit: Float[AnyArray, ""]) -> Float[Array, "2"]:
    """Project a velocity (m/s) on the disc |u| <= `speed_limit`; a non-finite velocity becomes a stop.

    The physics never lets a command exceed what the robot can do, and never lets a NaN into the
    state, where every later comparison with it would silently be false.
    """
    # Clipped far above any speed, or else the square of a huge command overflows.
    velocity = jnp.clip(jnp.where(jnp.all(jnp.isfinite(velocity)), velocity, 0.0), -1e15, 1e15)
    squared = jnp.sum(velocity**2)
    too_fast = squared > speed_limit**2
    length = jnp.sqrt(jnp.where(too_fast, squared, 1.0))
    return jnp.where(too_fast, velocity * (speed_limit / length), velocity)


def limit_wheels(
    wheel_speeds: Float[AnyArray, "*shape"], rim_speed: Float[AnyArray, ""]
) -> Float[Array, "*shape"]:
    """Clip wheel rim speeds (m/s) to [-V, V], which is |v| + b|omega| <= V; non-finite ones become 0."""
    finite = jnp.where(jnp.isfinite(wheel_speeds), wheel_speeds, 0.0)
    return jnp.clip(finite, -rim_speed, rim_speed)


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
    return jnp.stack([speed - half_axle * turn_rate, speed + half_axle * turn_rate])


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
    return jnp.asarray(position) + velocity * duration


def closest_approach_straight(
    relative_position: Float[AnyArray, "2"],
    relative_velocity: Float[AnyArray, "2"],
    duration: Float[AnyArray, ""],
) -> Scalar:
    """Smallest distance (m) between two robots in straight motion during a hold (closed form)."""
    squared_speed = jnp.sum(relative_velocity**2)
    still = squared_speed == 0.0
    when = -jnp.sum(relative_position * relative_velocity) / jnp.where(still, 1.0, squared_speed)
    when = jnp.clip(jnp.where(still, 0.0, when), 0.0, duration)
    return norm(relative_position + relative_velocity * when)


def closest_approach_driving(
    position: Float[AnyArray, "2"],
    velocity: Float[AnyArray, "2"],
    pose: Float[AnyArray, "3"],
    wheel_speeds: Float[AnyArray, "2"],
    half_axle: Float[AnyArray, ""],
    duration: Float[AnyArray, ""],
) -> Scalar:
    """Smallest distance (m) between a robot in straight motion and a differential drive during a hold.

    A straight line and an arc have no closed form. Four chords bracket the minimum, Newton's method on
    d/dt |q|^2 refines it, and the distance is evaluated on the true paths, so the answer is never
    below the true minimum and above it by second order in a time error that is itself tiny.
    """
    speed, turn_rate = body_velocity(wheel_speeds, half_axle)
    start = jnp.asarray(position) - pose[:2]

    def separation(when: Scalar) -> Float[Array, "2"]:
        half_turn = turn_rate * when / 2.0
        chord = speed * when * jnp.sinc(half_turn / jnp.pi)
        along = pose[2] + half_turn
        return start + velocity * when - chord * jnp.stack([jnp.cos(along), jnp.sin(along)])

    step = duration / _CHORDS
    knots = real(jnp.arange(_CHORDS + 1)) * step
    path = jax.vmap(separation)(knots)
    first, chord = path[:-1], path[1:] - path[:-1]
    squared = jnp.sum(chord**2, axis=-1)
    fraction = jnp.clip(-jnp.sum(first * chord, axis=-1) / jnp.where(squared == 0.0, 1.0, squared), 0.0, 1.0)
    distances = jnp.sum((first + fraction[:, None] * chord) ** 2, axis=-1)
    nearest = jnp.argmin(distances)
    low = knots[nearest]
    when = low + fraction[nearest] * step
    for _ in range(_NEWTON_STEPS):
        heading = pose[2] + turn_rate * when
        forward = jnp.stack([jnp.cos(heading), jnp.sin(heading)])
        left = jnp.stack([-forward[1], forward[0]])
        q, rate, bend = separation(when), velocity - speed * forward, -speed * turn_rate * left
        slope = jnp.sum(rate**2) + jnp.sum(q * bend)
        update = when - jnp.sum(q * rate) / jnp.where(slope > 0.0, slope, 1.0)
        when = jnp.where(slope > 0.0, jnp.clip(update, low, low + step), when)
    ends = jnp.minimum(norm(path[0]), norm(path[-1]))
    return jnp.minimum(norm(separation(when)), ends)
