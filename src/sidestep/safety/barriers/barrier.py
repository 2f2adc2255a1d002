"""Control barrier functions and their rows: what the evader's velocity must satisfy to stay free.

A barrier h is at least 0 where the evader is free of one other robot. With a class-K function alpha its row
n.u >= c demands h' >= -alpha(h) of the evader's velocity u (m/s, world axes). Then h never crosses 0.
"""

import abc
from typing import Any, TypeAlias, final

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from sidestep._arrays import AnyArray, Lanes, real, stack
from sidestep._moved import renamed, renamed_methods
from sidestep.world.scenario import Scenario
from sidestep.world.state import World

NormalAndRate: TypeAlias = tuple[Float[Array, "2 *lanes"], Float[Array, "*lanes"]]
"""Unit normal and rate (m/s), see `Barrier.gradient_and_rate`."""

_RENAMED = {"approach": "gradient_and_rate", "allowance": "alpha", "recall": "update_memory"}


class BarrierRows(eqx.Module):
    """Values h (m) and rows n.u >= c of n barriers, n.u in m/s."""

    values: Float[Array, "n *lanes"]
    normals: Float[Array, "n 2 *lanes"]
    offsets: Float[Array, "n *lanes"]

    @property
    def value(self) -> Lanes:
        """The composed barrier: the least of all, +inf when there is none."""
        return jnp.min(self.values, axis=0, initial=jnp.inf)


def compose(*rows: BarrierRows) -> BarrierRows:
    """Boolean AND of barriers: the value is the least, and all rows hold.

    h_c = min h_i (paper, eq. Boolean; Glotfelter, Cortes, Egerstedt, "Nonsmooth barrier functions with
    applications to multi-robot systems", 2017). Every row is demanded, not only that of the least barrier:
    the action then stays continuous where two barriers meet.
    """
    return BarrierRows(
        jnp.concatenate([entry.values for entry in rows]),
        jnp.concatenate([entry.normals for entry in rows]),
        jnp.concatenate([entry.offsets for entry in rows]),
    )


class Barrier(eqx.Module):
    """One kind of barrier, kept towards every robot of a kind.

    The row for one robot is n.u >= rate - alpha(h), with

    - n = dh/dp_e, the direction in which the evader raises h
    - rate, how fast (m/s) the other robot lowers h, by this barrier's assumption about its motion
    - alpha(h), how fast (m/s) h may shrink

    `memory ()` is one number per robot, kept from one control period to the next, for barriers that need one.

    Subclasses may still define `approach`, `allowance` and `recall`, the old names of `gradient_and_rate`,
    `alpha` and `update_memory`, with a `DeprecationWarning`.
    """

    def __init_subclass__(cls, **arguments: Any):
        super().__init_subclass__(**arguments)
        renamed_methods(cls, _RENAMED)

    @abc.abstractmethod
    def robots(self, world: World) -> Float[Array, "n d *lanes"]:
        """The robots that this barrier is kept towards: `world.pursuers`, or `world.obstacles`."""

    @abc.abstractmethod
    def value(
        self,
        scenario: Scenario,
        evader: Float[AnyArray, "2 *lanes"],
        robot: Float[AnyArray, "d *lanes"],
        memory: Float[AnyArray, "*lanes"],
    ) -> Lanes:
        """h (m) for one evader position (m) and one robot."""

    @abc.abstractmethod
    def gradient_and_rate(
        self,
        scenario: Scenario,
        evader: Float[AnyArray, "2 *lanes"],
        robot: Float[AnyArray, "d *lanes"],
        memory: Float[AnyArray, "*lanes"],
    ) -> tuple[Float[Array, "2 *lanes"], Lanes]:
        """Unit normal n = dh/dp_e in world axes, and the rate (m/s) at which the robot lowers h."""

    @abc.abstractmethod
    def alpha(self, scenario: Scenario, h: Float[AnyArray, "*lanes"]) -> Lanes:
        """How fast (m/s) h may shrink: class K, so alpha(0) = 0 and alpha increases with h."""

    def update_memory(
        self,
        scenario: Scenario,
        evader: Float[AnyArray, "2 *lanes"],
        robot: Float[AnyArray, "d *lanes"],
        memory: Float[AnyArray, "*lanes"] | None,
    ) -> Lanes:
        """The memory for this control period, from that of the last one; None at the start of an episode.

        0 unless a barrier says otherwise.
        """
        return jnp.zeros_like(real(evader)[0])

    def row(
        self,
        scenario: Scenario,
        evader: Float[AnyArray, "2 *lanes"],
        robot: Float[AnyArray, "d *lanes"],
        memory: Float[AnyArray, "*lanes"],
    ) -> tuple[Lanes, Float[Array, "2 *lanes"], Lanes]:
        """h (m), and normal n and offset c (m/s) of the row n.u >= c, towards one robot."""
        h = self.value(scenario, evader, robot, memory)
        normal, rate = self.gradient_and_rate(scenario, evader, robot, memory)
        return h, normal, rate - self.alpha(scenario, h)

    def rows(self, scenario: Scenario, world: World, memory: Float[AnyArray, "n *lanes"]) -> BarrierRows:
        """Value and row towards every robot; `memory` as `update_memories` returned it for this world."""
        row = jax.vmap(self.row, in_axes=(None, None, 0, 0))
        return BarrierRows(*row(scenario, world.evader, self.robots(world), memory))

    def update_memories(
        self, scenario: Scenario, world: World, memory: Float[AnyArray, "n *lanes"] | None = None
    ) -> Float[Array, "n *lanes"]:
        """`update_memory` for every robot."""
        update = jax.vmap(self.update_memory, in_axes=(None, None, 0, None if memory is None else 0))
        return update(scenario, world.evader, self.robots(world), memory)

    recall, remember = renamed(update_memory, "recall"), renamed(update_memories, "remember")


def _away(
    evader: Float[AnyArray, "2 *lanes"], robot: Float[AnyArray, "d *lanes"]
) -> tuple[Lanes, Lanes, Lanes]:
    """Distance (m) and unit direction from the robot to the evader; +x at distance 0."""
    x, y = evader[0] - robot[0], evader[1] - robot[1]
    squared = x * x + y * y
    apart = squared > 0.0
    distance = jnp.sqrt(jnp.where(apart, squared, 1.0))
    return (
        jnp.where(apart, distance, 0.0),
        jnp.where(apart, x / distance, 1.0),
        jnp.where(apart, y / distance, 0.0),
    )


@final
class ObstacleBarrier(Barrier):
    """The paper's barrier towards a drifting obstacle (eq. h_obstacle, Au1).

    h = |p_e - p_c| - d_oc,  n = (p_e - p_c)/|p_e - p_c|,  c = n.v_c - gamma_oc h.
    """

    def robots(self, world: World) -> Float[Array, "n 4 *lanes"]:
        return world.obstacles

    def value(self, scenario: Scenario, evader: Any, robot: Any, memory: Any) -> Lanes:
        return _away(evader, robot)[0] - scenario.collision_distance

    def gradient_and_rate(self, scenario: Scenario, evader: Any, robot: Any, memory: Any) -> NormalAndRate:
        _, x, y = _away(evader, robot)
        return stack(x, y), x * robot[2] + y * robot[3]

    def alpha(self, scenario: Scenario, h: Any) -> Lanes:
        return scenario.obstacle_gain * h


@final
class RangeBarrier(Barrier):
    """The paper's barrier towards the pursuer (eq. h_pv, Au2). It assumes that the pursuer drives straight on
    at full speed V.

    h = |p_e - p_d| - l,  n = (p_e - p_d)/|p_e - p_d|,  c = V n.(cos theta, sin theta) - gamma_pv h.

    This follows the paper's derivation; the printed b_pv has the opposite sign of the pursuer's velocity.
    The row has two faults. Close ahead of the pursuer, at h < (V - v_e)/gamma_pv, no velocity satisfies it,
    because n.u <= v_e < V. And a pursuer that reverses towards the evader counts as one that leaves.
    """

    def robots(self, world: World) -> Float[Array, "n 3 *lanes"]:
        return world.pursuers

    def value(self, scenario: Scenario, evader: Any, robot: Any, memory: Any) -> Lanes:
        return _away(evader, robot)[0] - scenario.capture_distance

    def gradient_and_rate(self, scenario: Scenario, evader: Any, robot: Any, memory: Any) -> NormalAndRate:
        _, x, y = _away(evader, robot)
        ahead = x * jnp.cos(robot[2]) + y * jnp.sin(robot[2])
        return stack(x, y), scenario.pursuer_speed * ahead

    def alpha(self, scenario: Scenario, h: Any) -> Lanes:
        return scenario.pursuer_gain * h
