"""The shield `joint` by a clearance table: no capture and no collision, at a look into it per velocity."""

from __future__ import annotations

import dataclasses
import math
from typing import Any, final

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from sidestep._arrays import AnyArray, Flag, Scalar, norm, real, traced
from sidestep.safety.barriers.barrier import BarrierRows
from sidestep.safety.barriers.budget import Budget
from sidestep.safety.barriers.sampling_margin import with_margins
from sidestep.safety.clearance.table import ClearanceTable
from sidestep.safety.filter.projection import project
from sidestep.safety.filter.status import Status
from sidestep.safety.shields.answer import correction, known_parts
from sidestep.safety.shields.game import GameShield
from sidestep.safety.shields.going_round import next_turn, still_turned, turned
from sidestep.safety.shields.joint import JointShield, real_or_none
from sidestep.safety.shields.look_ahead import ramp
from sidestep.safety.shields.masked_cond import masked_cond
from sidestep.safety.shields.shield import Shield, ShieldResult
from sidestep.safety.shields.table_margins import PairMargins
from sidestep.world.scenario import Scenario
from sidestep.world.state import World

_HEADINGS = 48
_BACK = 8
"""Steps from the velocity found back to the nominal one."""


class TableMemory(eqx.Module):
    """What the shield keeps from call to call: the `turn ()` that leads it round an obstacle, see
    `going_round`, and the memory of the shield that decides `otherwise`, None without one."""

    turn: Scalar
    otherwise: Any


@final
class TableShield(Shield):
    """Keeps the evader where the table says that it can stay free of every pursuer and obstacle.

    **Decision.** There are two margins, m. Towards pursuers it is the least h'(z) - `spare_pursuer`, towards
    obstacles the least |p| - R(z, p) - `spare_obstacle` over all pairs of pursuer and obstacle. With m the
    smaller one, the shield takes the velocity nearest to the nominal one after which both are, whatever the
    pursuers and obstacles do in the period, at least (1 - `gain` T) m. If there is none, it takes the nearest
    with both >= 0 (to change the side of a pursuer's axis spends h'). If there is none of these, pursuers go
    first: of the velocities that keep h', or else of those that lose least of it, it takes the one with the
    largest margin towards obstacles, and the status is `INFEASIBLE`. It chooses among 48 headings at full and
    at half speed and a stop, then goes back towards the nominal velocity as far as it may.

    **What holds.** For one pursuer and one obstacle what the table promises (see `ClearanceTable`): it is
    computed, not proved. A table for so many `periods` promises that much from each state of its set, not
    that the evader stays in it. Several obstacles or pursuers are kept by the worst of all pairs, which
    promises as much while no two matter at once. An evader that is stuck behind an obstacle goes round it,
    see `going_round`.

    **Otherwise.** Where that leaves no margin towards obstacles, and where a second obstacle or pursuer is
    within `near` (m) of contact, the shield `otherwise` decides if there is one. `make_shield` gives a
    look-ahead.

    **Arguments:** `budget` is kept beside what is to spare, and a tracking error e costs e T more in every
    period; `acceleration` m/s^2: in the period the evader changes its velocity, `world.evader_velocity`, no
    faster.

    The barriers reported are h' and |p| - R, m. The action carries the derivative of the nominal one where
    that is accepted, else none; `rows_only` is the shield to learn through.

    **Raises** `ValueError` for a table of another game.
    """

    keeps_pursuit_barrier = True
    scenario: Scenario
    table: ClearanceTable
    gain: Scalar = eqx.field(converter=real, default=4.0)
    spare_pursuer: Scalar = eqx.field(converter=real, default=0.001)
    spare_obstacle: Scalar = eqx.field(converter=real, default=0.002)
    budget: Budget | None = None
    acceleration: Scalar | None = eqx.field(converter=real_or_none, default=None)
    near: Scalar = eqx.field(converter=real, default=0.8)
    otherwise: TableShield | JointShield | None = None

    def __check_init__(self) -> None:
        if not traced(self.scenario) and (why := self.table.game.refuses(self.scenario)):
            raise ValueError(f"the clearance table does not serve this scenario: {why}")

    @property
    def rows_only(self) -> GameShield:
        return GameShield(self.scenario, self.budget, nominal_picks_side=True)

    @property
    def looks_ahead(self) -> bool:
        return self.otherwise is not None and self.otherwise.looks_ahead

    def plan(self, world: World, memory: TableMemory) -> Float[Array, "n 2"]:
        if self.otherwise is None:
            return super().plan(world, memory)
        return self.otherwise.plan(world, memory.otherwise)

    def filter_by_rows(
        self, world: World, nominal: Float[AnyArray, "2"], memory: TableMemory
    ) -> tuple[ShieldResult, TableMemory]:
        result, after, _ = self._by_table(world, jnp.asarray(nominal, world.evader.dtype), memory)
        return result, after

    def init(self, world: World) -> TableMemory:
        otherwise = None if self.otherwise is None else self.otherwise.init(world)
        return TableMemory(jnp.zeros_like(world.time), otherwise)

    def has_plan(self, memory: TableMemory) -> Flag:
        return jnp.zeros((), bool) if self.otherwise is None else self.otherwise.has_plan(memory.otherwise)

    def margin(self, world: World) -> Scalar:
        """The margin m (m) now: at least 0 where the evader can stay free of every pursuer and obstacle."""
        return jnp.min(self.margins.now(world).least)

    def rows(self, world: World, memory: Any) -> BarrierRows:
        game = self.rows_only
        return game.rows(world, game.init(world))

    def __call__(
        self, world: World, nominal: Float[AnyArray, "2"], memory: TableMemory
    ) -> tuple[ShieldResult, TableMemory]:
        nominal = jnp.asarray(nominal, world.evader.dtype)
        result, waiting, decided = self.at_once(world, nominal, memory)
        if self.otherwise is None:
            return result, waiting
        arrays, fixed = eqx.partition(self.otherwise, eqx.is_array)

        def ask(arrays: Any, world: World, nominal: Float[Array, "2"], memory: TableMemory) -> Any:
            result, after = eqx.combine(arrays, fixed)(world, nominal, memory.otherwise)
            return result, TableMemory(jnp.zeros_like(memory.turn), after)

        inputs = jax.lax.stop_gradient((arrays, world, nominal, memory))
        start = jax.lax.stop_gradient((result, waiting))
        asked, after = masked_cond(ask, ~decided, start, *inputs, width=4)
        action = jnp.where(decided, result.action, asked.action)
        return eqx.tree_at(lambda result: result.action, asked, action), after

    def at_once(
        self, world: World, nominal: Float[AnyArray, "2"], memory: TableMemory
    ) -> tuple[ShieldResult, TableMemory, Flag]:
        result, after, kept = self._by_table(world, jnp.asarray(nominal, world.evader.dtype), memory)
        if self.otherwise is None:
            return result, after, jnp.ones((), bool)
        # It begins anew each time.
        waiting = TableMemory(after.turn, self.otherwise.init(world))
        return result, waiting, (kept & ~self._is_crowded(world)) | (result.status == Status.INVALID)

    def _is_crowded(self, world: World) -> Flag:
        """Whether a second obstacle or pursuer is near."""
        gaps = norm(world.obstacles[:, :2] - world.evader) - self.scenario.collision_distance
        others = norm(world.pursuers[:, :2] - world.evader) - self.scenario.capture_distance
        return (jnp.sum(gaps < self.near) > 1) | (jnp.sum(others < self.near) > 1)

    def _by_table(
        self, world: World, nominal: Float[Array, "2"], memory: TableMemory
    ) -> tuple[ShieldResult, TableMemory, Flag]:
        """The answer, the next memory, and whether it keeps the margin towards obstacles."""
        if not self.scenario.obstacle_count:
            result, kept = self._filtered(world, nominal, nominal)
            return result, memory, kept
        kept = with_margins(self.scenario, self.budget)
        turn = still_turned(kept, world, nominal, memory.turn)
        result, kept_free = self._filtered(world, turned(nominal, turn), nominal)
        towards_pursuers = result.barriers[: self.scenario.pursuer_count]
        turn = next_turn(kept, world, nominal, result.action, turn, towards_pursuers)
        turn = jnp.where(result.status == Status.INVALID, 0.0, turn)
        return result, TableMemory(turn.astype(memory.turn.dtype), memory.otherwise), kept_free

    def _filtered(
        self, world: World, wanted: Float[Array, "2"], nominal: Float[Array, "2"]
    ) -> tuple[ShieldResult, Flag]:
        """The answer to `nominal`, in place of which `wanted` is tried, and whether it keeps the margin
        towards obstacles."""
        scenario, finite = self.scenario, jnp.all(jnp.isfinite(nominal))
        known = known_parts(world)
        everything = jnp.all(known)
        none = jnp.zeros((0, 2), wanted.dtype)
        limited = project(
            jnp.where(everything, wanted, 0.0),
            none,
            none[:, 0],
            scenario.evader_speed,
            circle=scenario.action == "heading",
        )
        first = limited.action
        arrays, fixed = eqx.partition(self, eqx.is_array)
        now = self.margins.now(world)
        least = jnp.min(now.least)
        aim = jnp.where(
            least > 0.0,
            (1.0 - self.gain * scenario.control_period) * least,
            jnp.minimum(now.least, 0.0),
        )
        margin = self._margin_after(world, first)
        accepted = jnp.all(margin >= aim)

        def choose(arrays: Any, world: World, first: Float[Array, "2"], aim: Float[Array, "2"]) -> Any:
            return eqx.combine(arrays, fixed)._choose(world, first, aim)

        start = jax.lax.stop_gradient((first, margin))
        inputs = jax.lax.stop_gradient((arrays, world, first, aim))
        action, margin = masked_cond(choose, ~accepted, start, *inputs, width=8)
        action = jnp.where(accepted, first, action)
        same = accepted & (limited.status == Status.OK) & jnp.all(wanted == nominal)
        status = jnp.where(
            jnp.all(margin >= 0.0), jnp.where(same, Status.OK, Status.CORRECTED), Status.INFEASIBLE
        )
        status = jnp.where(everything & finite, status, Status.INVALID)
        barriers = jnp.concatenate([now.towards_pursuers, now.towards_obstacles])
        result = ShieldResult(
            action=action,
            status=status.astype(limited.status.dtype),
            barriers=jnp.where(known, barriers, -jnp.inf),
            slack=jnp.min(margin - aim) / scenario.control_period,
            intervention=correction(action, jnp.where(finite, nominal, 0.0)),
        )
        return result, margin[1] >= 0.0

    def _choose(
        self, world: World, first: Float[Array, "2"], aim: Float[Array, "2"]
    ) -> tuple[Float[Array, "2"], Float[Array, "2"]]:
        """The velocity (m/s) in place of `first`, and the margins (m) after it."""
        speed, circle = self.scenario.evader_speed, self.scenario.action == "heading"
        heading = 2.0 * np.pi * np.arange(_HEADINGS) / _HEADINGS
        full = speed * jnp.asarray(np.stack([np.cos(heading), np.sin(heading)], -1), first.dtype)
        # Along the tip's normals, where h' falls least.
        tips = [self._tips(pose[2]) for pose in world.pursuers]
        tips = [jnp.where(jnp.isfinite(tip), tip, 0.0) for tip in tips]
        full = jnp.concatenate([full, *tips])
        options = full if circle else jnp.concatenate([full, 0.5 * full, jnp.zeros((1, 2), first.dtype)])
        after = jax.vmap(lambda option: self._margin_after(world, option))(options)
        kept = jnp.all(after >= aim, axis=-1)
        aim = jnp.where(jnp.any(kept), aim, 0.0)
        kept = jnp.all(after >= aim, axis=-1)
        # Pursuers first: of those that keep away from them, or else come nearest to it, the best one towards
        # obstacles.
        free = after[:, 0] >= jnp.minimum(jnp.max(after[:, 0]), 0.0)
        change = norm(options - first)
        best = jnp.where(
            jnp.any(kept),
            jnp.argmin(jnp.where(kept, change, jnp.inf)),
            jnp.argmax(jnp.where(free, after[:, 1], -jnp.inf)),
        )
        # Back towards the nominal velocity, as far as one step after the other still keeps the aim.
        share = jnp.arange(1, _BACK).astype(first.dtype)[:, None] / _BACK
        back = options[best] + share * (first - options[best])
        if circle:
            back = back * (speed / jnp.maximum(norm(back), 1e-6 * speed))[:, None]
        back_after = jax.vmap(lambda option: self._margin_after(world, option))(back)
        steps = jnp.sum(jnp.cumprod(jnp.all(back_after >= aim, axis=-1).astype(jnp.int32)))
        moved = jnp.maximum(steps - 1, 0)
        return (
            jnp.where(steps > 0, back[moved], options[best]),
            jnp.where(steps > 0, back_after[moved], after[best]),
        )

    def _tips(self, heading: Scalar) -> Float[Array, "4 2"]:
        angle = self.table.game.angle
        turns = np.array([angle, math.pi - angle, math.pi + angle, 2.0 * math.pi - angle])
        towards = heading + jnp.asarray(turns, heading.dtype)
        return self.scenario.evader_speed * jnp.stack([jnp.cos(towards), jnp.sin(towards)], -1)

    def _margin_after(self, world: World, action: Float[Array, "2"]) -> Float[Array, "2"]:
        """The margins (m) a period after `action` (m/s), whatever pursuers and obstacles do."""
        period = self.scenario.control_period
        if self.acceleration is not None:
            action, _ = ramp(world.evader_velocity, action, self.acceleration, period)
        return self.margins.after(world, period * action).least

    @property
    def margins(self) -> PairMargins:
        """What is to spare towards every pursuer and obstacle."""
        return PairMargins(self.scenario, self.table, self.spare_pursuer, self.spare_obstacle, self.budget)

    def with_acceleration(self, acceleration: float) -> TableShield:
        otherwise = None if self.otherwise is None else self.otherwise.with_acceleration(acceleration)
        return dataclasses.replace(self, acceleration=acceleration, otherwise=otherwise)
