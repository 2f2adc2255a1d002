"""The capture game: who wins, the evader's distance from capture, and optimal play of both sides.

Isaacs' equations for an omnidirectional evader and a differential-drive pursuer (Ruiz, Murrieta-Cid,
Marroquin, "Time-Optimal Motion Strategies for Capturing an Omnidirectional Evader Using a
Differential Drive Robot", IEEE T-RO 2013), in the pursuer's frame: z = (ahead, left) of the evader.
For a unit vector n,

    n.z' = n.u - v n_x + omega sigma,    sigma = n_x z_y - n_y z_x,

so the pursuer, with |v| + b |omega| <= V, can lower n.z at most to n.z' = n.u - V max(|n_x|, |sigma|/b).
"""

from __future__ import annotations

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from sidestep._arrays import AnyArray, Flag, Lanes, Scalar, real, stack
from sidestep.pursuit.time_optimal import Play, time_optimal_play
from sidestep.world.capture_geometry import capture_set_distance, usable_angle
from sidestep.world.scenario import Scenario


def _sign(value: Float[AnyArray, "*lanes"]) -> Lanes:
    """+1 or -1; +1 at 0."""
    return jnp.where(jnp.asarray(value) < 0.0, -1.0, 1.0).astype(jnp.asarray(value).dtype)


def turning_moment(z: Float[AnyArray, "2 *lanes"], normal: Float[AnyArray, "2 *lanes"]) -> Lanes:
    """sigma = n_x z_y - n_y z_x (m): the moment of n about the pursuer; turning adds omega sigma to n.z'."""
    return normal[0] * z[1] - normal[1] * z[0]


class CaptureGame(eqx.Module):
    """One evader against one differential-drive pursuer in the unbounded plane.

    **Arguments:** `evader_speed` v_e and `pursuer_speed` V (wheel rim), m/s; `half_axle` b and
    `capture_distance` l, m. All are traced, so another value never recompiles. b may be 0 (a pursuer that
    turns instantly) and the evader may be faster than the pursuer.

    Methods take one point z (m) in the pursuer's frame; use `jax.vmap` for many.
    """

    evader_speed: Scalar = eqx.field(converter=real)
    pursuer_speed: Scalar = eqx.field(converter=real)
    half_axle: Scalar = eqx.field(converter=real)
    capture_distance: Scalar = eqx.field(converter=real)

    @classmethod
    def of(cls, scenario: Scenario) -> CaptureGame:
        """The game that a scenario's evader plays against each of its pursuers."""
        return cls(
            scenario.evader_speed,
            scenario.pursuer_speed,
            scenario.pursuer_half_axle,
            scenario.capture_distance,
        )

    @property
    def usable_angle(self) -> Scalar:
        """S = arccos(v_e/V), rad: contact can be forced only at smaller angles to the pursuer's axis."""
        return usable_angle(self.evader_speed, self.pursuer_speed)

    @property
    def largest_capture_distance(self) -> Scalar:
        """l_max = b rho^2 / sqrt(1 - rho^2), m: up to this capture distance the evader can escape forever.

        Infinite when the evader is at least as fast, zero for a slower one when b = 0.
        """
        ratio = self.evader_speed / self.pursuer_speed
        slower = ratio < 1.0
        root = jnp.sqrt(jnp.where(slower, (1.0 - ratio) * (1.0 + ratio), 1.0))
        return jnp.where(slower, self.half_axle * ratio**2 / root, jnp.inf)

    @property
    def evader_can_escape(self) -> Flag:
        """Whether an evader outside the capture set K(l) can stay free forever: tan S <= rho b / l."""
        return (self.capture_distance <= self.largest_capture_distance) & (
            self.largest_capture_distance > 0.0
        )

    def barrier(
        self, z: Float[AnyArray, "2 *lanes"], side: Float[AnyArray, "*lanes"] | float | None = None
    ) -> tuple[Lanes, Float[Array, "2 *lanes"]]:
        """Signed distance h (m) from the capture set and its unit normal n, in the pursuer's frame.

        h = r cos((S - beta')+) - l, with beta' the angle between z and the pursuer's axis, front or rear.
        Beyond the usable angle h is the range and n points away from the pursuer. In front and behind, h is
        the distance to one of two lines tangent to the disc of radius l, h = |x| cos S + side y sin S - l.
        `side` is +1 (left) or -1 (right). By default it is the side of the evader, +1 on the axis, and then h
        is the distance from K(l).

        For 0 <= h <= l_max - l this is the value of the game: an evader that follows n keeps the distance l +
        h (T-RO 2013; the value of the smallest distance).
        """
        z = real(z)
        usable = self.usable_angle
        cosine, sine = jnp.cos(usable), jnp.sin(usable)
        own_side = _sign(z[1])
        chosen = own_side if side is None else _sign(real(side))
        in_front = jnp.abs(z[1]) * cosine < jnp.abs(z[0]) * sine
        squared = z[0] * z[0] + z[1] * z[1]
        apart = squared > 0.0
        # At the pursuer's centre n is the tangent's normal, the limit from in front.
        distance = jnp.sqrt(jnp.where(apart, squared, 1.0))
        tangent = _sign(z[0]) * cosine, chosen * sine
        on_tangent = in_front | ~apart
        normal = [jnp.where(on_tangent, tangent[i], z[i] / distance) for i in (0, 1)]
        value = capture_set_distance(z, usable, self.capture_distance)
        other_tangent = in_front & (chosen != own_side)
        along = tangent[0] * z[0] + tangent[1] * z[1]
        return jnp.where(other_tangent, along - self.capture_distance, value), stack(*normal)

    def _turning_gain(self, z: Float[AnyArray, "2 *lanes"], normal: Float[AnyArray, "2 *lanes"]) -> Lanes:
        """|sigma|/b; for b = 0 infinite, or 0 where sigma = 0."""
        moment = jnp.abs(turning_moment(z, normal))
        axle = self.half_axle
        free = jnp.where(moment > 0.0, jnp.inf, 0.0)
        return jnp.where(axle > 0.0, moment / jnp.where(axle > 0.0, axle, 1.0), free)

    def pursuit_rate(self, z: Float[AnyArray, "2 *lanes"], normal: Float[AnyArray, "2 *lanes"]) -> Lanes:
        """V max(|n_x|, |sigma|/b), m/s: the largest rate at which the pursuer can lower n.z.

        For an evader with n.u >= pursuit_rate, n.z does not decrease under any admissible wheel speeds.
        """
        z, normal = real(z), real(normal)
        return self.pursuer_speed * jnp.maximum(jnp.abs(normal[0]), self._turning_gain(z, normal))

    def steer_against(self, z: Float[AnyArray, "2"], normal: Float[AnyArray, "2"]) -> Float[Array, "2"]:
        """Wheel speeds (left, right; m/s) that attain `pursuit_rate` against the direction `normal`.

        Straight at V sign(n_x) when |n_x| >= |sigma|/b, else a turn in place at V/b that lowers sigma.
        """
        z, normal = real(z), real(normal)
        straight = jnp.abs(normal[0]) >= self._turning_gain(z, normal)
        forward = jnp.full(2, _sign(normal[0]))
        # omega = -(V/b) sign(sigma); the right wheel drives forward to turn left.
        turn = _sign(turning_moment(z, normal)) * jnp.array([1.0, -1.0], z.dtype)
        return self.pursuer_speed * jnp.where(straight, forward, turn)

    def play(self, z: Float[AnyArray, "2"]) -> Play:
        """Optimal play in the game of time at z: see `Play`. Carries no derivatives."""
        return time_optimal_play(
            real(z),
            self.evader_speed,
            self.pursuer_speed,
            self.half_axle,
            self.capture_distance,
            self.evader_can_escape,
        )

    def time_to_capture(self, z: Float[AnyArray, "2"]) -> Scalar:
        """Time to capture (s) under optimal play: 0 within l, infinite where capture cannot be forced.

        It is discontinuous at the sides of the capture set. It is differentiable in z once, by Isaacs'
        equation, and not in the game's constants.
        """
        return _time_to_capture(real(z), jax.lax.stop_gradient(self))

    def evader_saddle(self, z: Float[AnyArray, "2"]) -> Float[Array, "2"]:
        """The evader's direction (unit vector, pursuer's frame) at z under optimal play.

        That of the game of time where capture can be forced, else the barrier's normal.
        """
        play = self.play(z)
        return jnp.where(jnp.isfinite(play.time), play.direction, self.barrier(z)[1])

    def pursuer_saddle(self, z: Float[AnyArray, "2"]) -> Float[Array, "2"]:
        """Wheel speeds (left, right; m/s) of the pursuer's saddle-point law at z.

        That of the game of time where capture can be forced, else against the barrier's normal.
        """
        z = real(z)
        return self.steer_against(z, self.evader_saddle(z))


@jax.custom_jvp
def _time_to_capture(z: Float[Array, "2"], game: CaptureGame) -> Scalar:
    return game.play(z).time


@_time_to_capture.defjvp
def _time_to_capture_jvp(
    primals: tuple[Float[Array, "2"], CaptureGame], tangents: tuple[Float[Array, "2"], CaptureGame]
) -> tuple[Scalar, Scalar]:
    """grad T = n / (V max(|n_x|, |sigma|/b) - v_e), since T decreases at rate 1 under optimal play."""
    (z, game), (z_dot, _) = primals, tangents
    play = game.play(z)
    closing = game.pursuit_rate(z, play.direction) - game.evader_speed
    running = jnp.isfinite(play.time) & (play.time > 0.0) & (closing > 0.0)
    slope = jnp.sum(play.direction * z_dot) / jnp.where(running, closing, 1.0)
    return play.time, jnp.where(running, slope, 0.0)
