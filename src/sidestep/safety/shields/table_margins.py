"""What is left of the set of a clearance table, over all pursuers and obstacles of a world?"""

from __future__ import annotations

from collections.abc import Callable

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from sidestep._arrays import Scalar, norm
from sidestep.safety.barriers.budget import Budget
from sidestep.safety.clearance import ClearanceTable
from sidestep.safety.shields.answer import known_parts
from sidestep.world.capture_geometry import to_pursuer_axes, to_pursuer_frame
from sidestep.world.scenario import Scenario
from sidestep.world.state import World

_TURNS = 2
"""Final headings of the pursuer's motions, to each side, for which h' is found."""


class Margins(eqx.Module):
    """The evader's margins, m, and what is `known` of each pursuer and obstacle."""

    towards_pursuers: Float[Array, "m"]
    towards_obstacles: Float[Array, "k"]
    known: Bool[Array, "n"]

    @property
    def least(self) -> Float[Array, "2"]:
        """The least one towards a pursuer, and towards an obstacle."""
        m = len(self.towards_pursuers)
        pursuers = jnp.min(self.towards_pursuers, initial=jnp.inf, where=self.known[:m])
        return jnp.stack([pursuers, jnp.min(self.towards_obstacles, initial=jnp.inf, where=self.known[m:])])


class PairMargins(eqx.Module):
    """The margins of a clearance table: h' less what is to spare towards each pursuer, and for each obstacle
    the least |p| - R, less the same, over all pursuers.

    `spare_pursuer` and `spare_obstacle` (m) are kept beside `budget`, and a tracking error e costs e T more.
    """

    scenario: Scenario
    table: ClearanceTable
    spare_pursuer: Scalar
    spare_obstacle: Scalar
    budget: Budget | None = None

    def now(self, world: World) -> Margins:
        """The margins of a world."""
        grid = self.table.grid
        return self._over_pairs(
            world,
            self._alone(world, jnp.zeros_like(world.evader)),
            lambda z, pose: grid.height(jnp, z[0], z[1]),
            lambda z, p, pose: norm(p) - self.table(z, p)[1],
        )

    def after(self, world: World, move: Float[Array, "2"]) -> Margins:
        """The margins a period later, with the evader moved by `move` (m), whatever pursuers and obstacles
        do in it."""
        drift = self.scenario.control_period * norm(self.scenario.obstacle_velocity)
        motions = jnp.asarray(self.table.game.motions(_TURNS, 2), move.dtype)

        def height(z: Float[Array, "2"], pose: Float[Array, "3"]) -> Scalar:
            there = jnp.broadcast_to((z + to_pursuer_axes(move, pose[2]))[:, None], (2, len(motions)))
            seen = to_pursuer_frame(there, motions.T)
            return jnp.min(self.table.grid.height(jnp, seen[0], seen[1]))

        return self._over_pairs(
            world,
            self._alone(world, move) - drift,
            height,
            lambda z, p, pose: self.table.spare_after(z, p, to_pursuer_axes(move, pose[2]), drift),
        )

    def _over_pairs(
        self,
        world: World,
        alone: Float[Array, "k"],
        height: Callable[..., Scalar],
        gap: Callable[..., Scalar],
    ) -> Margins:
        """The margins by `height(z, pose)` of each pursuer and the least `gap(z, p, pose)`, at most `alone`,
        of each obstacle, less what is to spare; z and p in the pursuer's frame."""
        to_pursuers, to_obstacles = self._spares
        heights, towards_obstacles = [], alone
        for pose in world.pursuers:
            z = to_pursuer_frame(world.evader, pose)
            heights.append(height(z, pose) - to_pursuers)
            gaps = [
                gap(z, to_pursuer_axes(p, pose[2]), pose) - to_obstacles
                for p in world.evader - world.obstacles[:, :2]
            ]
            towards_obstacles = _at_most(towards_obstacles, gaps)
        return Margins(_stacked(heights, world), towards_obstacles, known_parts(world))

    def _alone(self, world: World, move: Float[Array, "2"]) -> Float[Array, "k"]:
        """What is left to every obstacle by itself, m, after the evader's `move`."""
        return (
            norm(world.evader + move - world.obstacles[:, :2])
            - self.scenario.collision_distance
            - self._spares[1]
        )

    @property
    def _spares(self) -> tuple[Scalar, Scalar]:
        """What is to spare (m) towards pursuers, beyond the distance of the table, and towards obstacles."""
        scenario, budget = self.scenario, self.budget
        more = jnp.maximum(scenario.capture_distance - self.table.game.capture_distance, 0.0)
        pursuers, obstacles = self.spare_pursuer + more, self.spare_obstacle
        if budget is None:
            return pursuers, obstacles
        off = budget.tracking_error * scenario.control_period
        return (
            pursuers + budget.towards_pursuers(scenario) + off,
            obstacles + budget.towards_obstacles(scenario) + off,
        )


def _at_most(values: Float[Array, "k"], others: list[Scalar]) -> Float[Array, "k"]:
    return jnp.minimum(values, jnp.stack(others)) if others else values


def _stacked(values: list[Scalar], world: World) -> Float[Array, "m"]:
    return jnp.stack(values) if values else jnp.zeros((0,), world.evader.dtype)
