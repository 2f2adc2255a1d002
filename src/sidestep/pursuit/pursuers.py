"""Pursuer strategies: from the world to the wheel speeds for one control period."""

from __future__ import annotations

import abc
from collections.abc import Callable
from typing import Any, ClassVar, final

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, PRNGKeyArray

from sidestep._arrays import AnyArray, Lanes, Scalar, fold, lane_by_lane, real, stack
from sidestep.pursuit.game import CaptureGame
from sidestep.pursuit.steering import bearing_of, nearer_end, turn_and_drive
from sidestep.world.capture_geometry import to_pursuer_frame
from sidestep.world.robots import wheels_from_body
from sidestep.world.scenario import Scenario
from sidestep.world.state import World

_INTERCEPT_STEPS = 8


class Pursuer(eqx.Module):
    """A strategy for one differential-drive pursuer. It steers `world.pursuer` and may use the whole world.

    Subclasses define `steer`. Calling the strategy clips its answer to the wheel limits, so no strategy can
    exceed them; non-finite wheel speeds become a stop.

    A strategy that computes with components and draws no random numbers, like most built-in ones, may set
    `takes_lanes`: it is then called once with many worlds in lanes (their axis last). Others are called for
    each world.
    """

    takes_lanes: ClassVar[bool] = False
    knows_velocity: ClassVar[bool] = False
    """Whether its world's `evader_velocity` is the one that the evader is about to drive, not the last one.
    No real pursuer knows it; attacks do."""
    always_finite: ClassVar[bool] = False
    """Whether its answer is finite in every finite world; answers of others are checked, see `pursue`."""

    @abc.abstractmethod
    def steer(self, scenario: Scenario, world: World, key: PRNGKeyArray) -> Float[Array, "2 *lanes"]:
        """Unclipped wheel rim speeds (left, right; m/s) of `world.pursuer` for the next control period."""

    def __call__(self, scenario: Scenario, world: World, key: PRNGKeyArray) -> Float[Array, "2 *lanes"]:
        """Wheel rim speeds (left, right; m/s) of `world.pursuer`, each within [-V, V]."""
        return scenario.drivable(self.steer(scenario, world, key))


def _toward(
    scenario: Scenario, turn: Lanes, end: Lanes | float = 1.0, turning_share: float = 1.0
) -> Float[Array, "2 *lanes"]:
    return turn_and_drive(
        turn,
        real(end),
        scenario.pursuer_speed,
        scenario.pursuer_half_axle,
        scenario.control_period,
        turning_share=turning_share,
    )


@final
class Nash(Pursuer):
    """The saddle point of the capture game: optimal against an optimal evader.

    Where capture can be forced, it minimises the time to capture. Elsewhere that time is infinite, so it
    minimises the smallest distance. From afar it turns its nearer end to the evader and drives, to the
    stand-off at b cot S. There, within h_max of the capture set, it drives straight, which forces the
    distance down to l_max and no lower. Outside the usable angle, where it would pass the evader, it turns
    again.
    """

    takes_lanes = True
    always_finite = True

    def steer(self, scenario: Scenario, world: World, key: PRNGKeyArray) -> Float[Array, "2 *lanes"]:
        game = CaptureGame.of(scenario)
        z = to_pursuer_frame(world.evader, world.pursuer)
        # The condition depends on the scenario only, so a batch of worlds takes one branch.
        return jax.lax.cond(
            game.evader_can_escape,
            lambda: _approach(scenario, game, z),
            lambda: lane_by_lane(lambda z: _hasten(game, z, scenario.control_period), z.ndim - 1, z),
        )


def _hasten(game: CaptureGame, z: Float[Array, "2"], period: Scalar) -> Float[Array, "2"]:
    """The time-optimal law, sampled: each phase of optimal play gets its share of the control period.

    It never turns past the evader. Optimal play does, to anticipate the evader's motion, but near the axis an
    evader that reverses every period could then make the pursuer turn back and forth forever.
    """
    play = game.play(z)
    to_face = game.half_axle / game.pursuer_speed * jnp.arctan2(jnp.abs(z[1]), jnp.abs(z[0]))
    backing = jnp.clip(play.backing / period, 0.0, 1.0)
    turning = jnp.clip(jnp.minimum(play.turning, to_face) / period, 0.0, 1.0 - backing)
    driving = 1.0 - backing - turning
    ahead, left = jnp.where(z < 0.0, -1.0, 1.0).astype(z.dtype)
    straight = ahead * (driving - backing)
    turn = ahead * left * turning
    return game.pursuer_speed * jnp.stack([straight - turn, straight + turn])


def _approach(scenario: Scenario, game: CaptureGame, z: Float[Array, "2 *lanes"]) -> Float[Array, "2 *lanes"]:
    """The law for the smallest distance: turn an end to the evader, come close, then drive straight.

    It drives straight inside the capture set too, where that captures soonest.
    """
    end, turn = nearer_end(bearing_of(z))
    # The stand-off is reached only asymptotically, so it drives straight from one period's distance on.
    reach = scenario.pursuer_speed * scenario.control_period
    strikes_from = game.largest_capture_distance - game.capture_distance + reach
    strike = (game.barrier(z)[0] <= strikes_from) & (jnp.abs(turn) <= game.usable_angle)
    straight = end * game.pursuer_speed
    return stack(*(jnp.where(strike, straight, wheel) for wheel in _toward(scenario, turn, end)))


@final
class TurnThenDrive(Pursuer):
    """Turns in place until it faces the evader, then drives at it and corrects its heading."""

    takes_lanes = True
    always_finite = True

    def steer(self, scenario: Scenario, world: World, key: PRNGKeyArray) -> Float[Array, "2 *lanes"]:
        return _toward(scenario, bearing_of(to_pursuer_frame(world.evader, world.pursuer)))


@final
class TurnWhileDriving(Pursuer):
    """Always drives forward: turns towards the evader on arcs about its inner wheel, or wider ones."""

    takes_lanes = True
    always_finite = True

    def steer(self, scenario: Scenario, world: World, key: PRNGKeyArray) -> Float[Array, "2 *lanes"]:
        bearing = bearing_of(to_pursuer_frame(world.evader, world.pursuer))
        return _toward(scenario, bearing, turning_share=0.5)


@final
class PurePursuit(Pursuer):
    """Drives at full speed, forward or backward, on the arc through the evader that is tangent to its axis.

    The arc's curvature is 2 z_y/|z|^2 (Coulter, "Implementation of the Pure Pursuit Path Tracking Algorithm",
    CMU-RI-TR-92-01, 1992).
    """

    takes_lanes = True
    always_finite = True

    def steer(self, scenario: Scenario, world: World, key: PRNGKeyArray) -> Float[Array, "2 *lanes"]:
        z = to_pursuer_frame(world.evader, world.pursuer)
        axle = scenario.pursuer_half_axle
        # v = V/(1 + b|curvature|) and omega = curvature v, written without the division by |z|^2.
        squared = z[0] * z[0] + z[1] * z[1]
        total = squared + 2.0 * axle * jnp.abs(z[1])
        apart = total > 0.0
        scale = scenario.pursuer_speed / jnp.where(apart, total, 1.0) * jnp.where(z[0] < 0.0, -1.0, 1.0)
        return wheels_from_body(jnp.where(apart, scale * squared, 0.0), 2.0 * scale * z[1], axle)


@final
class Interceptor(Pursuer):
    """Drives to the interception point with an evader of constant velocity.

    The time to that point consists of a turn in place, with the nearer end, and a straight drive; it is found
    by fixed-point steps. If the evader is too fast to be intercepted, it aims far ahead.
    """

    takes_lanes = True
    always_finite = True

    def steer(self, scenario: Scenario, world: World, key: PRNGKeyArray) -> Float[Array, "2 *lanes"]:
        z = to_pursuer_frame(world.evader, world.pursuer)
        ahead = to_pursuer_frame(world.evader + world.evader_velocity, world.pursuer) - z
        time = jnp.zeros_like(z[0])
        for _ in range(_INTERCEPT_STEPS):
            point = z + ahead * time
            _, turn = nearer_end(bearing_of(point))
            distance = jnp.sqrt(
                jnp.maximum(point[0] * point[0] + point[1] * point[1], jnp.finfo(point.dtype).tiny)
            )
            driving = jnp.maximum(distance - scenario.capture_distance, 0.0)
            time = (driving + scenario.pursuer_half_axle * jnp.abs(turn)) / scenario.pursuer_speed
        end, turn = nearer_end(bearing_of(z + ahead * time))
        return _toward(scenario, turn, end)


@final
class Random(Pursuer):
    """Wheel speeds drawn uniformly from [-V, V], independently at each control period."""

    always_finite = True

    def steer(self, scenario: Scenario, world: World, key: PRNGKeyArray) -> Float[Array, "2 *lanes"]:
        speed = scenario.pursuer_speed
        return speed * jax.random.uniform(key, (2,), dtype=speed.dtype, minval=-1.0, maxval=1.0)


@final
class Still(Pursuer):
    """Never moves."""

    takes_lanes = True
    always_finite = True

    def steer(self, scenario: Scenario, world: World, key: PRNGKeyArray) -> Float[Array, "2 *lanes"]:
        return jnp.zeros_like(world.pursuer[:2])


def _drivable(scenario: Scenario, wheels: Float[AnyArray, "2 *lanes"]) -> Float[Array, "2 *lanes"]:
    """The wheel speeds (m/s) that the pursuer drives; non-finite ones are passed on."""
    finite = jnp.isfinite(wheels[0]) & jnp.isfinite(wheels[1])
    return jnp.where(finite, scenario.drivable(wheels), wheels)


def without_answer(wheel_speeds: Float[AnyArray, "m 2 *lanes"]) -> Bool[Array, "*lanes"]:
    """Whether any pursuer's wheel speeds are not finite. It then stands still, so an evader that stays free
    proves nothing."""
    return ~fold(jnp.logical_and, jnp.isfinite(wheel_speeds[:, 0]) & jnp.isfinite(wheel_speeds[:, 1]), True)


def pursue(
    scenario: Scenario, pursuer: Callable[..., Any], world: World, key: Any
) -> Float[Array, "m 2 *lanes"]:
    """Wheel rim speeds (left, right) in m/s of every pursuer.

    The strategy is called for each pursuer, which comes first in its world, with a separate key. A strategy
    with a method `steer_all(scenario, world) -> (m, 2)` is called once for all pursuers. Each pair is within
    the pursuer's limits, or non-finite as the strategy returned it, which the physics takes for a stop: see
    `without_answer`. Worlds in lanes need one key each, unless the strategy takes lanes.

    **Raises** `ValueError` when the strategy's answer does not have shape (2,).
    """
    together = getattr(pursuer, "steer_all", None)

    def steer(world: World, key: Any) -> Float[Array, "m 2 *lanes"]:
        if together is not None:
            return jax.vmap(lambda wheels: _drivable(scenario, wheels))(together(scenario, world))
        count = scenario.pursuer_count
        keys = [key] * count if world.lanes else jax.random.split(key, count)
        answers = []
        for index in range(count):
            seen, watched = world.seen_by(index), isinstance(pursuer, Pursuer) and not pursuer.always_finite
            ask = pursuer.steer if watched else pursuer
            wheels = jnp.asarray(ask(scenario, seen, keys[index]))
            if wheels.shape != world.evader.shape:
                raise ValueError(
                    f"a pursuer must answer with wheel speeds (left, right) of shape (2,), not {wheels.shape}"
                )
            answers.append(_drivable(scenario, real(wheels)) if watched else real(wheels))
        return jnp.stack(answers)

    if getattr(pursuer, "takes_lanes", False):
        return steer(world, jnp.ravel(key)[0] if world.lanes and key.ndim else key)
    return lane_by_lane(steer, world.lanes, world, key)
