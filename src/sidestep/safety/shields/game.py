"""The shield `game`: the pursuit barrier, kept before the rows towards obstacles."""

from __future__ import annotations

from typing import Any, final

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from sidestep._arrays import AnyArray
from sidestep._moved import renamed, renamed_arguments
from sidestep.safety.barriers.barrier import BarrierRows
from sidestep.safety.barriers.budget import Budget
from sidestep.safety.barriers.pursuit_barrier import PursuitBarrier
from sidestep.safety.barriers.sampling_margin import margins, sampling_margin, with_margins
from sidestep.safety.filter.projection import project_known
from sidestep.safety.filter.status import Status
from sidestep.safety.shields.answer import as_changed, decide, known_parts, with_obstacles
from sidestep.safety.shields.going_round import next_turn, still_turned, turned
from sidestep.safety.shields.shield import Shield, ShieldResult
from sidestep.world.scenario import Scenario
from sidestep.world.state import World


class GameMemory(eqx.Module):
    """What `game` keeps from call to call: the `sides (m,)` of the pursuers' axes that its rows follow, and
    the `turn ()` that leads it round an obstacle, see `going_round`."""

    sides: Float[Array, "m *lanes"]
    turn: Float[Array, "*lanes"]


@final
@renamed_arguments(wish_picks_side="nominal_picks_side")
class GameShield(Shield):
    """`PursuitBarrier` towards pursuers, then `ObstacleBarrier` towards obstacles. The pursuers' rows come
    first where not all rows are feasible.

    For one pursuer in the unbounded plane, in continuous time and with l <= l_max, the pursuit row is always
    feasible, and while it is kept there is no capture. Sampling, several pursuers and obstacles beside them
    are outside that statement. The rows keep `sampling_margin` more than the capture distance, for what the
    pursuer turns within a period. The reported barriers are those of the capture distance itself.

    - `known_velocity=True`: the pursuers' next wheel speeds are known, because they are announced or can be
      computed, and the caller puts them into `world.wheel_speeds`. The rows are then those of
      `PursuitBarrier.rows_over_period`, two for each pursuer. They need no margin and interfere less.
    - `nominal_picks_side=True`: the nominal action chooses the side of a pursuer's axis where both sides are
      feasible, see `PursuitBarrier.choose_sides`.
    - `budget`: the rows also keep what measurement, delay and motors may take, see `Budget`. If the budget
      exceeds what the game allows, rows become infeasible. The violation is then minimised and retreat starts
      earlier, so that the distance stays close to the best possible.
    - `goes_round=True`, which `make_shield` sets: an evader that is stuck behind an obstacle goes round it,
      see `going_round`. Rows and filter stay as they are; the nominal action is turned aside for a while. If
      the scenario has obstacles the memory is then a `GameMemory`, otherwise only its `sides`.

    **Raises** `ValueError` for `known_velocity` together with a budget.
    """

    keeps_pursuit_barrier = True
    scenario: Scenario
    budget: Budget | None = None
    known_velocity: bool = eqx.field(static=True, default=False)
    nominal_picks_side: bool = eqx.field(static=True, default=False)
    goes_round: bool = eqx.field(static=True, default=False)

    def __check_init__(self) -> None:
        if self.known_velocity and self.budget is not None:
            raise ValueError("the rows for a known velocity keep no budget; leave out one of the two")

    @property
    def takes_lanes(self) -> bool:  # type: ignore[override]
        return not self.known_velocity

    def init(self, world: World) -> Any:
        sides = PursuitBarrier().update_memories(self.scenario, world)
        return GameMemory(sides, jnp.zeros_like(world.evader[0])) if self._may_be_stuck else sides

    @property
    def _may_be_stuck(self) -> bool:
        return self.goes_round and self.scenario.obstacle_count > 0

    def __call__(
        self, world: World, nominal: Float[AnyArray, "2 *lanes"], memory: Any
    ) -> tuple[ShieldResult, Any]:
        if not self._may_be_stuck:
            return self._filtered(world, nominal, memory)
        kept = with_margins(self.scenario, self.budget)
        nominal = jnp.asarray(nominal, world.evader.dtype)
        turn = still_turned(kept, world, nominal, memory.turn)
        result, sides = self._filtered(world, turned(nominal, turn), memory.sides)
        result = as_changed(result, nominal, turn != 0.0)
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
        kept = with_margins(self.scenario, self.budget)
        rows = with_obstacles(self._barrier.rows(kept, world, sides), kept, world)
        if self.budget is None:
            return rows
        offsets = rows.offsets + self.budget.tracking_error
        return eqx.tree_at(lambda rows: rows.offsets, rows, offsets)

    @property
    def _barrier(self) -> PursuitBarrier:
        # Where the sampling margin is spent, the row holds what is left and does not lead back out. Where the
        # budget is spent it does lead out: errors push inwards again and again.
        return PursuitBarrier(eased=sampling_margin(self.scenario), budget=self.budget)

    def _next_sides(self, world: World, nominal: Any, sides: Any) -> Float[Array, "m *lanes"]:
        """The sides of the pursuers' axes that the rows follow now."""
        if self.known_velocity:
            return PursuitBarrier().update_memories(self.scenario, world, sides)
        kept = with_margins(self.scenario, self.budget)
        if self.nominal_picks_side:
            return self._barrier.choose_sides(kept, world, sides, nominal)
        return self._barrier.update_memories(kept, world, sides)

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

    def filter_unchecked(
        self, world: World, nominal: Float[Array, "2 *lanes"], sides: Float[Array, "m *lanes"]
    ) -> tuple[Float[Array, "2 *lanes"], Float[Array, "m *lanes"]]:
        """The action (m/s) and the next sides, for a finite world and a nominal action within the limit.

        It is the action of the call, without checks of the input and without a report: for imagined chases.
        """
        sides = self._next_sides(world, nominal, sides)
        rows = self._rows(world, sides)
        action = project_known(
            nominal,
            rows.normals,
            rows.offsets,
            self.scenario.evader_speed,
            hard=self.scenario.pursuer_count,
            circle=self.scenario.action == "heading",
        )
        return action, sides

    heed = renamed(filter_unchecked, "heed")
