"""Pursuers made for attacking: one that plays a given plan, one of several, one that herds."""

from __future__ import annotations

from typing import Any, final

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int, PRNGKeyArray

from sidestep._arrays import Scalar, norm
from sidestep.pursuit import PURSUERS, Pursuer, make_pursuer
from sidestep.pursuit.steering import bearing_of, nearer_end, turn_and_drive
from sidestep.world import Scenario, World
from sidestep.world.capture_geometry import capture_set_distance, to_pursuer_frame

_STAND_OFF = 0.1


@final
class Script(Pursuer):
    """Plays given wheel speeds, one row for each control period, and stays with the last row after it.

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
    """Strategy number `index` of several, so that one batch of chases can hold them all."""

    strategies: tuple[Pursuer, ...]
    index: Int[Array, "*batch"]

    def steer(self, scenario: Scenario, world: World, key: PRNGKeyArray) -> Float[Array, "2"]:
        def branch(strategy: Pursuer) -> Any:
            return lambda: strategy(scenario, world, key)

        return jax.lax.switch(self.index, [branch(strategy) for strategy in self.strategies])


class Roster(eqx.Module):
    """Several strategies; called with a number it gives that one."""

    strategies: tuple[Pursuer, ...]

    def __call__(self, index: Int[Array, ""]) -> OneOf:
        """Strategy number `index`."""
        return OneOf(self.strategies, index)


def built_in() -> Roster:
    """Every built-in strategy that moves."""
    return Roster(tuple(make_pursuer(name) for name in PURSUERS if name != "still"))


@final
class Herder(Pursuer):
    """Drives the evader into something: goes behind it as seen from there, and strikes from that side.

    Its place is on the line from the nearest obstacle (or the target) through the evader, outside the capture
    set. Once that line and its line of sight differ by less than `strikes_within` (rad) it strikes as `nash`
    does, which pins the evader between the two. With `toward_target`, or without obstacles, it herds toward
    the target.
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


def _unit(offset: Float[Array, "2"]) -> Float[Array, "2"]:
    length = norm(offset)
    apart = length > 0.0
    return jnp.where(apart, offset / jnp.where(apart, length, 1.0), jnp.array([1.0, 0.0], offset.dtype))


def bang_bang(
    scenario: Scenario, key: PRNGKeyArray, periods: int, longest: Float[Array, ""]
) -> Float[Array, "t m 2"]:
    """Wheels that run full ahead or full back and switch at random; m/s.

    Each wheel of each pursuer changes its mind with probability 1/dwell in every period, its mean dwell time
    drawn once from 1 to `longest` periods, small ones as likely as large ones.
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

    Below 0 a pursuer captures by driving straight, whatever the evader does.
    """
    z = jax.vmap(to_pursuer_frame, in_axes=(None, 0))(world.evader, world.pursuers)
    values = jax.vmap(capture_set_distance, in_axes=(0, None, None))(
        z, scenario.usable_angle, scenario.capture_distance
    )
    return jnp.min(values, initial=jnp.inf)
