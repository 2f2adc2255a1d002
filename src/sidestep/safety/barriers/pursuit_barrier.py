"""The certified barrier towards a pursuer: the signed distance from the capture set of its game."""

from typing import Any, final

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from sidestep._arrays import AnyArray, Lanes, Scalar, length, real, select, stack
from sidestep._moved import renamed
from sidestep.pursuit.game import CaptureGame, turning_moment
from sidestep.safety.barriers.barrier import Barrier, BarrierRows, NormalAndRate
from sidestep.safety.barriers.budget import Budget
from sidestep.world.capture_geometry import to_pursuer_frame
from sidestep.world.robots import body_velocity, drive
from sidestep.world.scenario import Scenario
from sidestep.world.state import World

KEEP_SIDE = 0.5
"""A side is kept up to this share of the width across the axis within which its row is feasible."""
STEEPER = 1.5
"""How much steeper than needed alpha is beyond h_max."""
LOST_SIDE = 0.005
"""Width across the axis, in capture distances, within which a side is kept where no side saves the evader."""
_DECIDED = 0.1
"""Sideways nominal speed, as a share of v_e, from which on it decides the side."""


@final
class PursuitBarrier(Barrier):
    """The barrier of the capture game: it holds against every admissible motion of the pursuer.

    h is the signed distance from the capture set, see `CaptureGame.barrier`. The row has two forms, with
    sigma = n_x z_y - n_y z_x the moment of n about the pursuer:

    - The pursuer's motion is unknown (the default): n.u >= V max(|n_x|, |sigma|/b) - alpha(h). The first term
      is the fastest that any wheel speeds can lower h.
    - `known_velocity=True`: n.u >= v n_x - omega sigma - alpha(h), with v and omega from
      `world.wheel_speeds`. This is h' >= -alpha(h) along the pursuer's actual motion. It never asks for more
      than the first form, so it interferes less.

    **The second form is only as good as the wheel speeds.** The caller must supply those of the period that
    is about to begin: the pursuer announces them, or they can be computed. A simulation or a measurement has
    those of the period that has just ended, and a pursuer may reverse them at will. The row is then too weak
    by up to |n_x| |dv| + |sigma| |domega| <= 2 V max(|n_x|, |sigma|/b), and there is no worst-case guarantee.
    Wheel speeds are clipped to [-V, V]; a pursuer with non-finite ones counts as one of unknown motion. The
    row holds for an instant. To hold an action for a whole control period, use `rows_over_period`.

    **alpha.** With h_max = l_max - l,

        alpha(h) = gamma min(h, h_max) + max(gamma, 1.5 (V/b) tan S) (h - h_max)+.

    Up to h_max any gain gamma keeps the row feasible. Beyond, the slope is at least 1.5 times the one that
    just does. So for l <= l_max every h >= 0 has a feasible row, whatever the gain. For l > l_max the pursuer
    wins: rows near its axis are infeasible, and the filter violates them least.

    **Memory.** In front of the pursuer and behind it h is the distance to a tangent line of the capture set,
    one on each side of the axis. The memory is the side to follow, +1 left or -1 right. On the axis the row
    of either side is feasible, but at the tip of the capture set not both. A side once taken is kept beyond
    the axis while its own row stays feasible, so that the sides do not change at every crossing. That is so
    up to |y| = cos S (b rho - (l + h) tan S + (b/V) alpha(h)) across the axis; for h = 0 it is m cos S with
    m = b rho - l tan S. The side is left at half of that. The evader's own side has the larger h, since
    2 |y| sin S = h_own - h, so the change never lowers the value.

    - `eased` m: alpha is 0 from -eased to 0, so the row asks for no return from there. It is for a barrier
      that keeps more than the capture distance.
    - `budget`: a side is also kept while the budget's errors may have the evader on it.

    A robot is (x, y, heading); with a known velocity its wheel speeds (left, right; m/s) follow.
    """

    known_velocity: bool = eqx.field(static=True, default=False)
    eased: Scalar | float = 0.0
    budget: Budget | None = None

    def robots(self, world: World) -> Float[Array, "n d *lanes"]:
        if self.known_velocity:
            return jnp.concatenate([world.pursuers, world.wheel_speeds], axis=1)
        return world.pursuers

    def value(self, scenario: Scenario, evader: Any, robot: Any, memory: Any) -> Lanes:
        return CaptureGame.of(scenario).barrier(to_pursuer_frame(evader, robot[:3]), memory)[0]

    def gradient_and_rate(self, scenario: Scenario, evader: Any, robot: Any, memory: Any) -> NormalAndRate:
        game = CaptureGame.of(scenario)
        z = to_pursuer_frame(evader, robot[:3])
        normal = game.barrier(z, memory)[1]
        ahead, left = normal[0], normal[1]
        cosine, sine = jnp.cos(robot[2]), jnp.sin(robot[2])
        world_normal = stack(cosine * ahead - sine * left, sine * ahead + cosine * left)
        # A pursuer that turns at no cost (b = 0) has an infinite rate. A finite one must do, infeasible too.
        rate = jnp.minimum(game.pursuit_rate(z, normal), 1e3 * game.pursuer_speed)
        if self.known_velocity:
            rate = self._known_rate(game, z, normal, robot[3:], rate)
        return world_normal, rate

    def _known_rate(
        self,
        game: CaptureGame,
        z: Float[Array, "2 *lanes"],
        normal: Float[Array, "2 *lanes"],
        wheel_speeds: Float[AnyArray, "2 *lanes"],
        fastest: Lanes,
    ) -> Lanes:
        """v n_x - omega sigma (m/s), or `fastest` where the motion is unknown or turning costs nothing."""
        known = jnp.all(jnp.isfinite(wheel_speeds), axis=0) & (game.half_axle > 0.0)
        wheels = jnp.where(known, wheel_speeds, 0.0)
        wheels = jnp.clip(wheels, -game.pursuer_speed, game.pursuer_speed)
        speed, turn_rate = body_velocity(wheels, jnp.where(game.half_axle > 0.0, game.half_axle, 1.0))
        rate = speed * normal[0] - turn_rate * turning_moment(z, normal)
        # With rounding the row must not ask for more than the worst case, which is feasible.
        return jnp.where(known, jnp.minimum(rate, fastest), fastest)

    def rows_over_period(self, scenario: Scenario, world: World, memory: Float[AnyArray, "m"]) -> BarrierRows:
        """Two rows towards each pursuer, one after the other, for an action that is held for one period T.

        The pursuers hold `world.wheel_speeds` for the period and are at pose_t after t = T/2 and T. On one
        side h is convex in the evader's position, so with n_t the normal seen from pose_t

            h(p_e + t u; pose_t) >= h(p_e; pose_t) + t n_t.u.

        The rows are n_t.u >= (h(p_e; pose_0) - h(p_e; pose_t))/t - min(alpha(h), h/t). At both times they let
        h sink by at most t alpha(h), and never below 0. That is exact, without a margin for sampling. For
        l <= l_max each row is feasible from every h >= 0, since a pursuer lowers h at v_e + alpha(h) at most.
        Both together are feasible too, except in rare turns in which the side changes in between. As with
        `known_velocity`, non-finite wheel speeds give the two rows of an unknown motion.
        """
        unknown = PursuitBarrier()

        def towards(robot: Float[Array, "3"], wheels: Float[Array, "2"], side: Scalar) -> Any:
            h, *worst = unknown.row(scenario, world.evader, robot, side)
            known = jnp.all(jnp.isfinite(wheels)) & (scenario.pursuer_half_axle > 0.0)
            axle = jnp.where(known, scenario.pursuer_half_axle, 1.0)
            held = jnp.where(known, wheels, 0.0)
            held = jnp.clip(held, -scenario.pursuer_speed, scenario.pursuer_speed)

            def after(share: Scalar) -> tuple[Scalar, Float[Array, "2"], Scalar]:
                time = share * scenario.control_period
                pose = drive(robot, held, axle, time)
                kept = unknown.update_memory(scenario, world.evader, pose, side)
                normal, _ = unknown.gradient_and_rate(scenario, world.evader, pose, kept)
                sunk = h - unknown.value(scenario, world.evader, pose, kept)
                # However steep alpha is, h must not sink below 0 within the period.
                allowed = jnp.minimum(self.alpha(scenario, h), jnp.abs(h) / time)
                row = (normal, sunk / time - allowed)
                return h, *select(known, row, tuple(worst))

            return jax.vmap(after)(real((0.5, 1.0)))

        values, normals, offsets = jax.vmap(towards)(world.pursuers, world.wheel_speeds, real(memory))
        return BarrierRows(values.reshape(-1), normals.reshape(-1, 2), offsets.reshape(-1))

    def alpha(self, scenario: Scenario, h: Any) -> Lanes:
        game = CaptureGame.of(scenario)
        gain, axle = scenario.pursuer_gain, game.half_axle
        spare = jnp.maximum(game.largest_capture_distance - game.capture_distance, 0.0)
        turning = game.pursuer_speed * jnp.tan(game.usable_angle) / jnp.where(axle > 0.0, axle, 1.0)
        steep = jnp.maximum(gain, jnp.where(axle > 0.0, STEEPER * turning, 0.0))
        back = gain * jnp.minimum(h + self.eased, 0.0)
        return gain * jnp.clip(h, 0.0, spare) + steep * jnp.maximum(h - spare, 0.0) + back

    def update_memory(self, scenario: Scenario, evader: Any, robot: Any, memory: Any) -> Lanes:
        game = CaptureGame.of(scenario)
        z = to_pursuer_frame(evader, robot[:3])
        own_side = jnp.where(z[1] < 0.0, -1.0, 1.0).astype(z.dtype)
        if memory is None:
            return own_side
        side = jnp.where(real(memory) < 0.0, -1.0, 1.0).astype(z.dtype)
        return jnp.where(self._may_keep(scenario, game, z, side), side, own_side)

    def choose_sides(
        self,
        scenario: Scenario,
        world: World,
        memory: Float[AnyArray, "m *lanes"],
        nominal: Float[AnyArray, "2 *lanes"],
    ) -> Float[Array, "m *lanes"]:
        """`update_memories`, but where the rows of both sides are feasible, close to a pursuer's axis, the
        nominal velocity (m/s) decides the side.

        Without that, an evader that a pursuer keeps turning after is led in a circle on the side it once
        took. It cannot turn back, whatever is in the way.
        """
        game = CaptureGame.of(scenario)

        def side(robot: Float[Array, "3 *lanes"], side: Lanes) -> Lanes:
            kept = self.update_memory(scenario, world.evader, robot, side)
            z = to_pursuer_frame(world.evader, robot)
            aside = jnp.cos(robot[2]) * nominal[1] - jnp.sin(robot[2]) * nominal[0]
            wanted = jnp.where(aside < 0.0, -1.0, 1.0).astype(z.dtype)
            decided = jnp.abs(aside) > _DECIDED * scenario.evader_speed
            if self.budget is None:
                own = self.update_memory(scenario, world.evader, robot, None)
                free = (wanted == own) | self._may_keep(scenario, game, z, wanted)
            else:
                free = self._surely_feasible(scenario, game, z, wanted)
            return jnp.where(decided & free, wanted, kept)

        return jax.vmap(side)(world.pursuers, real(memory))

    prefer = renamed(choose_sides, "prefer")

    def _may_keep(
        self, scenario: Scenario, game: CaptureGame, z: Float[Array, "2 *lanes"], side: Lanes
    ) -> Bool[Array, "*lanes"]:
        cosine, sine = jnp.cos(game.usable_angle), jnp.sin(game.usable_angle)
        ahead, across = jnp.abs(z[0]), jnp.maximum(-side * z[1], 0.0)
        if self.budget is not None:
            across = jnp.maximum(across - self._doubt(z), 0.0)
        in_front = jnp.abs(z[1]) * cosine < ahead * sine
        h = ahead * cosine - across * sine - game.capture_distance
        own = ahead * cosine + across * sine - game.capture_distance
        feasible = (h >= 0.0) & (across <= KEEP_SIDE * self._reach(scenario, game, h))
        # If no side saves the evader, it still does best to commit to one. If only the margin beyond the
        # capture distance is spent, the evader is not lost: its own side saves it, the other may not.
        spare = self.eased if self.budget is None else 0.0
        lost = (own + spare < 0.0) | (self._reach(scenario, game, own) < 0.0)
        return in_front & (feasible | (lost & (across <= LOST_SIDE * game.capture_distance)))

    def _surely_feasible(
        self, scenario: Scenario, game: CaptureGame, z: Float[Array, "2 *lanes"], side: Lanes
    ) -> Bool[Array, "*lanes"]:
        """Whether the row of a side is feasible wherever the evader is, within the budget's errors."""
        cosine, sine = jnp.cos(game.usable_angle), jnp.sin(game.usable_angle)
        ahead, across = jnp.abs(z[0]), self._doubt(z) - side * z[1]
        in_front = jnp.abs(z[1]) * cosine < ahead * sine
        h = ahead * cosine - across * sine - game.capture_distance
        reach = self._reach(scenario, game, h)
        feasible = (h >= 0.0) & (across <= jnp.minimum(KEEP_SIDE * reach, reach))
        return jnp.where(in_front, feasible, side * z[1] >= 0.0)

    def _doubt(self, z: Float[Array, "2 *lanes"]) -> Lanes:
        """How far (m) the evader may be from its measured position in a pursuer's frame."""
        assert self.budget is not None
        return self.budget.position_error + self.budget.heading_error * length(z[0], z[1])

    def _reach(self, scenario: Scenario, game: CaptureGame, h: Lanes) -> Lanes:
        """How far across the axis the row of a side with value h stays feasible (m)."""
        turn = game.half_axle * (game.evader_speed + self.alpha(scenario, h)) / game.pursuer_speed
        cosine, sine = jnp.cos(game.usable_angle), jnp.sin(game.usable_angle)
        return cosine * turn - sine * (game.capture_distance + h)
