"""Time to capture where the pursuer wins, and optimal play of both sides in the game of time.

After Ruiz, Murrieta-Cid, Marroquin, IEEE T-RO 2013. The closed forms are derived here and tested against
Isaacs' equation. Inside this module lengths are in units of the half axle b and times in b/V, so that a game
is given by rho = v_e/V and lambda = l/b. By symmetry z lies in the quadrant x, y >= 0. The evader moves
straight in the world, except on the axis. Let s be the bearing of its motion when the final straight drive
begins (and of the contact, unless it was on the axis before):

- **Drive.** z = ((lambda - rho tau) cos s + tau, (lambda - rho tau) sin s) at time to go tau, as long as
  driving beats turning: tau <= cot s. All these paths meet the axis at x = lambda/rho, tau = lambda/rho.
- **Axis.** Beyond that the pursuer turns to keep the evader on its axis: x' = -1 + rho sqrt(1 + 1/x^2), while
  the evader moves aside at tan s = 1/x. This phase begins at P(s) = (cot s, 0).
- **Turn.** Before that, the pursuer turns in place towards the evader for a time t1, until the evader is at
  P(s): on the axis for s <= s_c = atan(rho/lambda), else where driving begins to beat turning. The moment of
  the evader's line about the pursuer is conserved and equals cos s: with phi the evader's heading and
  psi = phi - bearing of z, r sin psi = cos s, r cos psi + rho t1 = P(s).n(s), t1 = phi - s.
- **Back off.** Closer than b and beside the pursuer, driving away from the evader's half plane brings it
  ahead faster than turning, as long as phi > pi - s. In that frame z comes from the y axis on straight lines
  along (1 - rho cos s, rho sin s).

The evader's direction n is that of the gradient of the time T, and Isaacs' equation
v_e |grad T| - V max(|T_x|, |x T_y - y T_x|/b) = -1 gives the gradient's length.
"""

from __future__ import annotations

from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from sidestep._arrays import AnyArray, Flag, Scalar, real
from sidestep.world.capture_geometry import capture_set_distance, usable_angle

_SPARE_BISECTIONS = 4


class Play(eqx.Module):
    """Optimal play from one point of the pursuer's frame, in the game of time.

    **Attributes:** `time` to capture (s): 0 within the capture distance, infinite where capture cannot be
    forced; `direction (2,)` of the evader, a unit vector in the pursuer's frame; `backing` and `turning`, the
    times (s) for which the pursuer first drives away from the evader's half plane and then turns towards it,
    before it drives at it. Where the time is infinite or zero only `time` is meaningful.
    """

    time: Scalar
    direction: Float[Array, "2"]
    backing: Scalar
    turning: Scalar


class _Shape(eqx.Module):
    """The dimensionless game: rho = v_e/V, lambda = l/b, usable angle S, s_c at which P(s) leaves the
    axis."""

    rho: Scalar
    size: Scalar
    usable: Scalar
    corner: Scalar


def _reach(shape: _Shape, s: Scalar) -> Scalar:
    """P(s).n(s): the evader's position along its line of motion when the turning ends."""
    cosine, sine = jnp.cos(s), jnp.sin(s)
    start = jnp.where(s < shape.corner, 0.0, shape.size - shape.rho * cosine / sine)
    return start + cosine**2 / sine


def _axis_integral(shape: _Shape, s: Scalar) -> Scalar:
    """Antiderivative of cos s / (sin^2 s (cos s - rho)), the time spent on the axis per change of s."""
    rho, usable = shape.rho, shape.usable
    tiny = jnp.finfo(s.dtype).tiny
    ratio = jnp.sin((usable + s) / 2.0) / jnp.maximum(jnp.sin((usable - s) / 2.0), tiny)
    fractions = (
        jnp.log(ratio) / jnp.maximum(jnp.sin(usable), tiny) ** 3
        - 1.0 / jnp.maximum(2.0 * (1.0 - rho) * jnp.tan(s / 2.0), tiny)
        - jnp.tan(s / 2.0) / (2.0 * (1.0 + rho))
    )
    return rho * fractions - 1.0 / jnp.tan(s)


def _time_from_turn(shape: _Shape, s: Scalar) -> Scalar:
    """Time to capture from P(s), where the turning ends."""
    on_axis = s < shape.corner
    held = jnp.minimum(s, shape.corner)
    axis = shape.size / shape.rho + _axis_integral(shape, shape.corner) - _axis_integral(shape, held)
    return jnp.where(on_axis, axis, 1.0 / jnp.tan(s))


def _bisect(negative: Callable[[Scalar], Bool[Array, ""]], low: Scalar, high: Scalar) -> Scalar:
    """The point where `negative` changes from true to false, to floating-point precision."""

    def halve(_: Array, ends: tuple[Scalar, Scalar]) -> tuple[Scalar, Scalar]:
        low, high = ends
        middle = 0.5 * (low + high)
        below = negative(middle)
        return jnp.where(below, middle, low), jnp.where(below, high, middle)

    steps = jnp.finfo(low.dtype).nmant + _SPARE_BISECTIONS
    return jax.lax.fori_loop(0, steps, halve, (low, high))[1]


def _drive(shape: _Shape, z: Float[Array, "2"]) -> tuple[Scalar, Float[Array, "2"], Flag]:
    """Time to capture by driving straight, the evader's direction, and whether driving beats turning."""
    x, y = z[0], z[1]
    distance = jnp.hypot(x, y)
    slack = x - shape.size * shape.rho
    gap = (distance - shape.size) * (distance + shape.size)
    root = jnp.sqrt(jnp.maximum(slack**2 - (1.0 - shape.rho**2) * gap, 0.0))
    time = gap / jnp.where(slack > 0.0, slack + root, 1.0)
    lead = x - time
    return time, _unit(jnp.stack([lead, y])), (slack > 0.0) & (time * y <= lead)


def _unit(vector: Float[AnyArray, "2"]) -> Float[Array, "2"]:
    norm = jnp.hypot(vector[0], vector[1])
    apart = norm > 0.0
    return jnp.where(apart, vector / jnp.where(apart, norm, 1.0), jnp.array([1.0, 0.0], vector.dtype))


def _turn(shape: _Shape, z: Float[Array, "2"]) -> tuple[Scalar, Scalar, Scalar, Flag]:
    """s, the evader's heading phi, the turning time t1, and whether turning comes first.

    Farther away than b the unknown is s, between S and a value so small that its path starts beyond z.
    Closer, a path past the pursuer may have two values of s. Then the unknown is psi, between the direction
    with s = S and the one for which backing off is as fast as turning.
    """
    rho, usable = shape.rho, shape.usable
    distance, bearing = jnp.hypot(z[0], z[1]), jnp.arctan2(z[1], z[0])
    far = distance >= 1.0
    safe = jnp.maximum(distance, jnp.finfo(distance.dtype).tiny)
    smallest = jnp.minimum(1.0 / (distance + jnp.pi * rho + 1.0), usable)
    nearest = jnp.arcsin(jnp.minimum(rho / safe, 1.0))
    # From z to the wheel at (0, b): along it turning and backing off are equally fast.
    to_wheel = jnp.arctan2(jnp.cos(bearing), jnp.sin(bearing) - distance)

    def flight(part: Scalar) -> tuple[Scalar, Scalar]:
        s_far = usable ** (1.0 - part) * smallest**part
        psi_far = jnp.arcsin(jnp.minimum(jnp.cos(s_far) / safe, 1.0))
        psi_near = nearest + (to_wheel - nearest) * part
        s_near = jnp.arccos(jnp.clip(distance * jnp.sin(psi_near), 0.0, 1.0))
        return jnp.where(far, s_far, s_near), jnp.where(far, psi_far, psi_near)

    def falls_short(part: Scalar) -> Flag:
        s, psi = flight(part)
        return _reach(shape, s) - rho * (bearing + psi - s) < distance * jnp.cos(psi)

    zero, one = jnp.zeros_like(distance), jnp.ones_like(distance)
    s, psi = flight(_bisect(falls_short, zero, one))
    turning = jnp.maximum(bearing + psi - s, 0.0)
    return s, bearing + psi, turning, far | ~falls_short(one)


def _back_off(shape: _Shape, z: Float[Array, "2"]) -> tuple[Scalar, Scalar]:
    """s of the evader's path from z, and the time t2 for which the pursuer backs off before it turns."""
    rho = shape.rho

    def ends_at(s: Scalar) -> Float[Array, "2"]:
        cosine, sine = jnp.cos(s), jnp.sin(s)
        along = _reach(shape, s) - rho * (jnp.pi - 2.0 * s)
        return jnp.stack([cosine * (sine - along), along * sine + cosine**2])

    def passes_above(s: Scalar) -> Flag:
        gap = ends_at(s) - z
        return gap[0] * rho * jnp.sin(s) < gap[1] * (1.0 - rho * jnp.cos(s))

    # At the lower end the turning would start behind the y axis; at the upper end the path is the barrier.
    low = jnp.minimum(1.0 / (2.0 + jnp.pi * rho), shape.usable)
    s = _bisect(passes_above, low, shape.usable)
    return s, jnp.maximum((ends_at(s)[0] - z[0]) / (1.0 - rho * jnp.cos(s)), 0.0)


def _play_in_quadrant(shape: _Shape, z: Float[Array, "2"], pursuer_wins: Flag) -> Play:
    """Optimal play for z in the quadrant x, y >= 0, in units of b and b/V."""
    drive_time, drive_direction, drives = _drive(shape, z)
    drives = (drives | ~pursuer_wins) & (capture_set_distance(z, shape.usable, shape.size) <= 0.0)
    turn_s, turn_heading, turning, turns = _turn(shape, z)
    back_s, backing = _back_off(shape, z)
    s = jnp.where(turns, turn_s, back_s)
    heading = jnp.where(turns, turn_heading, jnp.pi - back_s)
    turning = jnp.where(turns, turning, jnp.pi - 2.0 * back_s)
    backing = jnp.where(turns, 0.0, backing)
    later = jnp.where(pursuer_wins, _time_from_turn(shape, s) + turning + backing, jnp.inf)
    return Play(
        time=jnp.where(drives, drive_time, later),
        direction=jnp.where(drives, drive_direction, jnp.stack([jnp.cos(heading), jnp.sin(heading)])),
        backing=jnp.where(drives, 0.0, backing),
        turning=jnp.where(drives, 0.0, turning),
    )


def time_optimal_play(
    z: Float[AnyArray, "2"],
    evader_speed: Float[AnyArray, ""],
    pursuer_speed: Float[AnyArray, ""],
    half_axle: Float[AnyArray, ""],
    capture_distance: Float[AnyArray, ""],
    evader_can_escape: Flag,
) -> Play:
    """Optimal play in the game of time at z (m, pursuer's frame); carries no derivatives.

    An evader that can escape is captured only inside the capture set, by driving straight at it. A pursuer
    with b = 0 turns instantly and drives: T = (r - l)/(V - v_e).
    """
    arguments = (z, evader_speed, pursuer_speed, half_axle, capture_distance)
    z, evader_speed, pursuer_speed, half_axle, capture_distance = map(real, jax.lax.stop_gradient(arguments))
    turns_free = half_axle <= 0.0
    axle = jnp.where(turns_free, 1.0, half_axle)
    rho = jnp.minimum(evader_speed / pursuer_speed, 1.0)
    size = capture_distance / axle
    shape = _Shape(
        rho=rho,
        size=size,
        usable=usable_angle(evader_speed, pursuer_speed),
        corner=jnp.arctan2(rho, size),
    )
    mirror = jnp.where(z < 0.0, -1.0, 1.0).astype(z.dtype)
    play = _play_in_quadrant(shape, jnp.abs(z) / axle, ~evader_can_escape)

    distance = jnp.hypot(z[0], z[1])
    closing = jnp.maximum(pursuer_speed - evader_speed, jnp.finfo(z.dtype).tiny)
    unit_time = axle / pursuer_speed
    time = jnp.where(
        turns_free & ~evader_can_escape, (distance - capture_distance) / closing, play.time * unit_time
    )
    return Play(
        time=jnp.where(distance <= capture_distance, 0.0, time),
        direction=jnp.where(turns_free, _unit(z), mirror * play.direction),
        backing=jnp.where(turns_free, 0.0, play.backing * unit_time),
        turning=jnp.where(turns_free, 0.0, play.turning * unit_time),
    )
