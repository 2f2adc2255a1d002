"""Pursuers for attacks: a given plan, one of several strategies, a herder, a sideswiper, random switching."""

from __future__ import annotations

from typing import Any, final

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int, PRNGKeyArray

from sidestep._arrays import AnyArray, Scalar, norm
from sidestep.pursuit import PURSUERS, Pursuer, make_pursuer
from sidestep.pursuit.steering import bearing_of, nearer_end, turn_and_drive
from sidestep.safety.clearance import ClearanceTable
from sidestep.world import Scenario, World
from sidestep.world.capture_geometry import capture_set_distance, to_pursuer_axes, to_pursuer_frame
from sidestep.world.robots import drive, wheels_from_body

_STAND_OFF = 0.1


@final
class Script(Pursuer):
    """Plays given wheel speeds, one row per control period, and holds the last row afterwards.

    **Arguments:** `plan (t, m, 2)` wheel rim speeds (left, right) of each pursuer, m/s; `first` the number of
    the control period, counted from the world's time 0, at which row 0 is played.
    """

    plan: Float[Array, "*batch t m 2"]
    first: Int[Array, "*batch"]

    def steer_all(self, scenario: Scenario, world: World) -> Float[Array, "m 2"]:
        """Wheel speeds (m/s) of all pursuers, in the world's order."""
        now = jnp.round(world.time / scenario.control_period).astype(jnp.int32) - self.first
        return self.plan[jnp.clip(now, 0, self.plan.shape[0] - 1)]

    def steer(self, scenario: Scenario, world: World, key: PRNGKeyArray) -> Float[Array, "2"]:
        return self.steer_all(scenario, world)[0]


def script(part: tuple[Float[Array, "t m 2"], Int[Array, ""]]) -> Script:
    """The `Script` of a (plan, first period)."""
    return Script(*part)


@final
class OneOf(Pursuer):
    """Strategy `index` of several, so that one batch of chases can use them all."""

    strategies: tuple[Pursuer, ...]
    index: Int[Array, "*batch"]

    def steer(self, scenario: Scenario, world: World, key: PRNGKeyArray) -> Float[Array, "2"]:
        def branch(strategy: Pursuer) -> Any:
            return lambda: strategy(scenario, world, key)

        return jax.lax.switch(self.index, [branch(strategy) for strategy in self.strategies])


class Roster(eqx.Module):
    """Several strategies; a call with an index returns that one."""

    strategies: tuple[Pursuer, ...]

    def __call__(self, index: Int[Array, ""]) -> OneOf:
        """Strategy number `index`."""
        return OneOf(self.strategies, index)


def built_in() -> Roster:
    """All built-in strategies that move."""
    return Roster(tuple(make_pursuer(name) for name in PURSUERS if name != "still"))


@final
class Herder(Pursuer):
    """Drives the evader towards an obstacle: moves to the opposite side of the evader, then attacks.

    It goes to a point on the line from the nearest obstacle (or the target) through the evader, outside the
    capture set. When that line and its line of sight differ by less than `strikes_within` (rad) it attacks as
    `nash`, which pins the evader between the two. With `toward_target`, or without obstacles, it herds
    towards the target.
    """

    toward_target: Bool[Array, "*batch"]
    strikes_within: Float[Array, "*batch"]

    def steer(self, scenario: Scenario, world: World, key: PRNGKeyArray) -> Float[Array, "2"]:
        trap = world.target
        if scenario.obstacle_count > 0:
            offsets = world.obstacles[:, :2] - world.evader
            nearest = world.obstacles[jnp.argmin(norm(offsets)), :2]
            trap = jnp.where(self.toward_target, trap, nearest)
        to_trap = _unit(trap - world.evader)
        sight = _unit(world.evader - world.pursuer[:2])
        aligned = jnp.sum(to_trap * sight) >= jnp.cos(self.strikes_within)
        reach = scenario.capture_distance / jnp.maximum(jnp.cos(scenario.usable_angle), 0.1)
        station = world.evader - (reach + _STAND_OFF) * to_trap
        end, turn = nearer_end(bearing_of(to_pursuer_frame(station, world.pursuer)))
        approach = turn_and_drive(
            turn, end, scenario.pursuer_speed, scenario.pursuer_half_axle, scenario.control_period
        )
        return jnp.where(aligned, make_pursuer("nash")(scenario, world, key), approach)


def herder(part: tuple[Bool[Array, ""], Float[Array, ""]]) -> Herder:
    """The `Herder` of (toward_target, strikes_within)."""
    return Herder(*part)


@final
class Sideswiper(Pursuer):
    """Drives alongside the evader, between it and its target, lets it come close, and turns in.

    In continuous time the pursuer cannot force contact beside its axle, so the evader may come close there.
    Within one control period, however, it gains V^2 T^2/(8 b) by turning with the inner wheel at rest, before
    a sampled shield can answer. It attacks when the clearance is below the share `patience` of that. `lead`
    (rad) is the angle between its waiting position and the evader's path to the target.
    """

    patience: Float[Array, "*batch"]
    lead: Float[Array, "*batch"]

    def steer(self, scenario: Scenario, world: World, key: PRNGKeyArray) -> Float[Array, "2"]:
        speed, axle, period = scenario.pursuer_speed, scenario.pursuer_half_axle, scenario.control_period
        pose = world.pursuer
        z = to_pursuer_frame(world.evader, pose)
        onward = _unit(world.target - world.evader)
        left = jnp.where(z[1] < 0.0, -1.0, 1.0).astype(z.dtype)
        # Abreast: the evader is beside the pursuer, with equal speed along the pursuer's axis.
        axis = jnp.stack([jnp.cos(pose[2]), jnp.sin(pose[2])])
        along = jnp.sum(world.evader_velocity * axis) + z[0] / (4.0 * period)
        along = jnp.clip(along, -speed, speed)
        turning = jnp.clip(
            (bearing_of(z) - left * jnp.pi / 2.0) / (4.0 * period),
            -(speed - jnp.abs(along)) / axle,
            (speed - jnp.abs(along)) / axle,
        )
        beside = wheels_from_body(along, turning, axle)
        # Turning in: the far wheel at full speed, the near wheel at rest.
        way = jnp.where(along < 0.0, -1.0, 1.0).astype(z.dtype)
        right_wheel = (left > 0.0).astype(z.dtype)
        swing = way * speed * jnp.stack([1.0 - right_wheel, right_wheel])
        gap = norm(z) - scenario.capture_distance
        # Elsewhere: to a point ahead of the evader, at angle `lead` from its path.
        sine, cosine = jnp.sin(self.lead), jnp.cos(self.lead)
        ahead = jnp.stack([cosine * onward[0] - sine * onward[1], sine * onward[0] + cosine * onward[1]])
        station = world.evader + (scenario.capture_distance + _STAND_OFF) * ahead
        end, turn = nearer_end(bearing_of(to_pursuer_frame(station, pose)))
        approach = turn_and_drive(turn, end, speed, axle, period)
        between = jnp.sum(_unit(pose[:2] - world.evader) * onward) > 0.2
        near = between & (gap < 2.0 * _STAND_OFF)
        gain = (speed * period) ** 2 / (8.0 * axle)
        return jnp.where(near, jnp.where(gap < self.patience * gain, swing, beside), approach)


def sideswiper(part: tuple[Float[Array, ""], Float[Array, ""]]) -> Sideswiper:
    """The `Sideswiper` of (patience, lead)."""
    return Sideswiper(*part)


_EDGE = 16
"""Wheel speeds per side of their square among which a saddle chooses."""
_AFTERWARDS = 3
"""Control periods that a saddle looks beyond the next one."""


@final
class JointSaddle(Pursuer):
    """Leaves the evader the least margin a control period later, knowing the velocity that it is about to
    drive.

    The margin is that of a clearance table, min(h', |p| - R) over all obstacles, or without one min(h, |p| -
    d). `pull` weighs, beside it, h and |p| by themselves: where the margin is the same it comes nearer. With
    `two_steps` it takes what the best of 16 headings leaves three periods later, while the pursuer drives or
    turns at full speed.
    """

    knows_velocity = True
    table: ClearanceTable | None
    pull: Float[Array, "*batch 2"]
    two_steps: bool = eqx.field(static=True, default=False)

    def steer(self, scenario: Scenario, world: World, key: PRNGKeyArray) -> Float[Array, "2"]:
        speed = scenario.pursuer_speed
        ramp = jnp.linspace(-1.0, 1.0, _EDGE + 1)[:-1].astype(world.evader.dtype)
        one = jnp.ones_like(ramp)
        edges = [(ramp, one), (one, -ramp), (-ramp, -one), (-one, ramp)]
        wheels = speed * jnp.concatenate([jnp.stack(edge, -1) for edge in edges])
        period = scenario.control_period
        obstacles = scenario.moved(world, world.evader_velocity, world.wheel_speeds).obstacles[:, :2]
        evader = world.evader + period * world.evader_velocity

        def after(wheels: Array) -> Scalar:
            pose = drive(world.pursuer, wheels, scenario.pursuer_half_axle, period)
            margin, h, gap = self._margin(scenario, evader, pose, obstacles)
            if self.two_steps:
                margin = self._answered(scenario, evader, pose, obstacles)
            return margin + self.pull[0] * h + self.pull[1] * gap

        return wheels[jnp.argmin(jax.vmap(after)(wheels))]

    def _margin(
        self, scenario: Scenario, evader: Array, pose: Array, obstacles: Array
    ) -> tuple[Scalar, Scalar, Scalar]:
        """The margin, h and the least |p|, m."""
        z = to_pursuer_frame(evader, pose)
        h = capture_set_distance(z, scenario.usable_angle, scenario.capture_distance)
        offsets = evader - obstacles
        gaps = norm(offsets)
        gap = jnp.min(gaps, initial=1.0)
        if self.table is None:
            return jnp.minimum(h, gap - scenario.collision_distance), h, gap
        margin = self.table.grid.height(jnp, z[0], z[1])
        for offset in offsets:
            margin = jnp.minimum(margin, self.table.margin(z, to_pursuer_axes(offset, pose[2])))
        return margin, h, gap

    def _answered(self, scenario: Scenario, evader: Array, pose: Array, obstacles: Array) -> Scalar:
        duration = _AFTERWARDS * scenario.control_period
        heading = (2.0 * jnp.pi / 16) * jnp.arange(16).astype(evader.dtype)
        reached = scenario.evader_speed * duration * jnp.stack([jnp.cos(heading), jnp.sin(heading)], -1)
        corners = jnp.array([[1.0, 1.0], [-1.0, -1.0], [1.0, -1.0], [-1.0, 1.0]], evader.dtype)
        axle, speed = scenario.pursuer_half_axle, scenario.pursuer_speed
        poses = jax.vmap(lambda corner: drive(pose, speed * corner, axle, duration))(corners)

        def worst(move: Array) -> Scalar:
            there = evader + move
            return jnp.min(jax.vmap(lambda pose: self._margin(scenario, there, pose, obstacles)[0])(poses))

        return jnp.max(jax.vmap(worst)(reached))


def _unit(offset: Float[AnyArray, "2"]) -> Float[Array, "2"]:
    length = norm(offset)
    apart = length > 0.0
    return jnp.where(apart, offset / jnp.where(apart, length, 1.0), jnp.array([1.0, 0.0], offset.dtype))


def bang_bang(
    scenario: Scenario, key: PRNGKeyArray, periods: int, longest: Float[Array, ""]
) -> Float[Array, "t m 2"]:
    """Wheel speeds (m/s) of +V or -V that switch at random.

    Each wheel draws a new sign with probability 1/dwell in every period. Its mean dwell time is drawn once,
    log-uniformly from 1 to `longest` periods.
    """
    dwell_key, switch_key, side_key = jax.random.split(key, 3)
    shape = (scenario.pursuer_count, 2)
    share = jax.random.uniform(dwell_key, shape, dtype=longest.dtype)
    dwell = longest**share
    switch = jax.random.uniform(switch_key, (periods, *shape), dtype=longest.dtype) < 1.0 / dwell
    sides = jax.random.rademacher(side_key, (periods, *shape), dtype=longest.dtype)

    def keep(held: Array, new: tuple[Array, Array]) -> tuple[Array, Array]:
        held = jnp.where(new[0], new[1], held)
        return held, held

    return scenario.pursuer_speed * jax.lax.scan(keep, sides[0], (switch, sides))[1]


def escape_margin(scenario: Scenario, world: World) -> Scalar:
    """Least signed distance h (m) of the evader from a pursuer's capture set; +inf without pursuers.

    Below 0 a pursuer captures by driving straight, for any motion of the evader.
    """
    z = jax.vmap(to_pursuer_frame, in_axes=(None, 0))(world.evader, world.pursuers)
    values = jax.vmap(capture_set_distance, in_axes=(0, None, None))(
        z, scenario.usable_angle, scenario.capture_distance
    )
    return jnp.min(values, initial=jnp.inf)
