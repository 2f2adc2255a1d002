"""The shield `game`: the pursuit barrier, kept before the rows towards obstacles."""

from __future__ import annotations

from typing import Any, final

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from sidestep._arrays import AnyArray
from sidestep.safety.barriers.barrier import BarrierRows
from sidestep.safety.barriers.budget import Budget
from sidestep.safety.barriers.pursuit_barrier import PursuitBarrier
from sidestep.safety.barriers.sampling_margin import guarded, margins, sampling_margin
from sidestep.safety.filter.projection import project_known
from sidestep.safety.filter.status import Status
from sidestep.safety.shields.answer import as_turned, decide, known_parts, with_obstacles
from sidestep.safety.shields.going_round import next_turn, still_turned, turned
from sidestep.safety.shields.shield import Shield, ShieldResult
from sidestep.world.scenario import Scenario
from sidestep.world.state import World


class GameMemory(eqx.Module):
    """What `game` keeps in mind: the `sides (m,)` of the pursuers' axes that its rows follow, and the
    `turn ()` that leads it round an obstacle, see `going_round`."""

    sides: Float[Array, "m *lanes"]
    turn: Float[Array, "*lanes"]


@final
class GameShield(Shield):
    """`PursuitBarrier` towards pursuers, kept before the `ObstacleBarrier` rows when not all can hold.

    Against one pursuer in the unbounded plane, in continuous time and with l <= l_max, the pursuit row can
    always be kept, and then there is no capture. Sampling, several pursuers and obstacles beside them are
    outside that statement. For the pursuer's turns within a period the rows keep `sampling_margin` more than
    the capture distance; the barriers that are reported are those of the capture distance itself.

    `known_velocity=True` is for a pursuer whose next wheel speeds are known, because it announces them or
    they can be computed: whoever calls puts them into `world.wheel_speeds`. The rows are then those of
    `PursuitBarrier.rows_over_period`, two for each pursuer, which need no margin and interfere less.

    `wish_picks_side=True` lets the nominal action choose the side of a pursuer's axis where either will do,
    see `PursuitBarrier.prefer`.

    With a `budget` the rows also keep what measurement, delay and motors may take, see `Budget`. One that is
    more than the game leaves is kept as well as can be, as everything that cannot: the further out the rows
    begin to ask for retreat, the closer the distance stays to the best that is possible.

    With `goes_round=True`, which `make_shield` sets, an evader that is stuck behind an obstacle goes round it
    (see `going_round`): rows and filter stay as they are, the nominal action is turned aside for a while.
    Where the scenario has obstacles the memory is then a `GameMemory`, else only its `sides`.
    """

    keeps_pursuit_barrier = True
    scenario: Scenario
    budget: Budget | None = None
    known_velocity: bool = eqx.field(static=True, default=False)
    wish_picks_side: bool = eqx.field(static=True, default=False)
    goes_round: bool = eqx.field(static=True, default=False)

    def __check_init__(self) -> None:
        if self.known_velocity and self.budget is not None:
            raise ValueError("the rows for a known velocity keep no budget; leave out one of the two")

    @property
    def takes_lanes(self) -> bool:
        return not self.known_velocity

    def init(self, world: World) -> Any:
        sides = PursuitBarrier().remember(self.scenario, world)
        return GameMemory(sides, jnp.zeros_like(world.evader[0])) if self._may_be_stuck else sides

    @property
    def _may_be_stuck(self) -> bool:
        return self.goes_round and self.scenario.obstacle_count > 0

    def __call__(
        self, world: World, nominal: Float[AnyArray, "2 *lanes"], memory: Any
    ) -> tuple[ShieldResult, Any]:
        if not self._may_be_stuck:
            return self._filtered(world, nominal, memory)
        kept = guarded(self.scenario, self.budget)
        nominal = jnp.asarray(nominal, world.evader.dtype)
        turn = still_turned(kept, world, nominal, memory.turn)
        result, sides = self._filtered(world, turned(nominal, turn), memory.sides)
        result = as_turned(result, nominal, turn)
        towards_pursuers = result.barriers[: self.scenario.pursuer_count]
        turn = next_turn(kept, world, nominal, result.action, turn, towards_pursuers)
        turn = jnp.where(result.status == Status.INVALID, 0.0, turn)
        return result, GameMemory(sides, turn.astype(memory.turn.dtype))

    def rows(self, world: World, memory: Any) -> BarrierRows:
        return self._rows(world, memory.sides if self._may_be_stuck else memory)

    def _rows(self, world: World, sides: Float[AnyArray, "m *lanes"]) -> BarrierRows:
        """The rows at the distances that are kept; of a known velocity, two towards each pursuer."""
        if self.known_velocity:
            rows = PursuitBarrier().rows_over_period(self.scenario, world, sides)
            return with_obstacles(rows, self.scenario, world)
        kept = guarded(self.scenario, self.budget)
        rows = with_obstacles(self._barrier.rows(kept, world, sides), kept, world)
        if self.budget is None:
            return rows
        offsets = rows.offsets + self.budget.tracking_error
        return eqx.tree_at(lambda rows: rows.offsets, rows, offsets)

    @property
    def _barrier(self) -> PursuitBarrier:
        # Where the margin has been used up the row still holds what is left, and asks for no more. Not so
        # with the budget's: errors push inwards again and again, and the row leads back out.
        return PursuitBarrier(eased=sampling_margin(self.scenario), budget=self.budget)

    def _next_sides(self, world: World, nominal: Any, sides: Any) -> Float[Array, "m *lanes"]:
        """The sides of the pursuers' axes that the rows follow now."""
        if self.known_velocity:
            return PursuitBarrier().remember(self.scenario, world, sides)
        kept = guarded(self.scenario, self.budget)
        if self.wish_picks_side:
            return self._barrier.prefer(kept, world, sides, nominal)
        return self._barrier.remember(kept, world, sides)

    def _filtered(
        self, world: World, nominal: Float[AnyArray, "2 *lanes"], sides: Float[AnyArray, "m *lanes"]
    ) -> tuple[ShieldResult, Float[Array, "m *lanes"]]:
        sides, m = self._next_sides(world, nominal, sides), self.scenario.pursuer_count
        rows = self._rows(world, sides)
        if self.known_velocity:
            known = known_parts(world)
            known = jnp.concatenate([jnp.repeat(known[:m], 2), known[m:]])
            result = decide(self.scenario, world, nominal, rows, enforced=True, hard=2 * m, known=known)
            once = jnp.concatenate([result.barriers[: 2 * m : 2], result.barriers[2 * m :]])
            return eqx.tree_at(lambda result: result.barriers, result, once), sides
        towards_pursuers, towards_obstacles = margins(self.scenario, self.budget)
        values = jnp.concatenate([rows.values[:m] + towards_pursuers, rows.values[m:] + towards_obstacles])
        rows = eqx.tree_at(lambda rows: rows.values, rows, values)
        return decide(self.scenario, world, nominal, rows, enforced=True, hard=m), sides

    def heed(
        self, world: World, wish: Float[Array, "2 *lanes"], sides: Float[Array, "m *lanes"]
    ) -> tuple[Float[Array, "2 *lanes"], Float[Array, "m *lanes"]]:
        """The action (m/s) alone, and the next memory, for a finite world and a wish within the speed limit.

        The same as calling the shield, without what it takes to be sure of its input and to report: for
        chases that are only imagined.
        """
        sides = self._next_sides(world, wish, sides)
        rows = self._rows(world, sides)
        action = project_known(
            wish,
            rows.normals,
            rows.offsets,
            self.scenario.evader_speed,
            hard=self.scenario.pursuer_count,
            circle=self.scenario.action == "heading",
        )
        return action, sides
