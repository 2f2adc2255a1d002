"""The shield `joint`: no capture and no collision, by looking ahead inside the rows of `game`."""

from __future__ import annotations

import dataclasses
from typing import Any, final

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int, PRNGKeyArray

from sidestep._arrays import AnyArray, Flag, Scalar, in_lanes, norm, real, select
from sidestep.pursuit import Pursuer, make_pursuer, pursue
from sidestep.safety.barriers.barrier import BarrierRows
from sidestep.safety.barriers.budget import Budget
from sidestep.safety.barriers.sampling_margin import with_margins
from sidestep.safety.filter.status import Status
from sidestep.safety.shields.answer import as_changed, correction
from sidestep.safety.shields.escape_plan import (
    CHOICES,
    SEGMENTS,
    EscapePlan,
    choice_at,
    chosen_velocity,
)
from sidestep.safety.shields.game import GameShield
from sidestep.safety.shields.going_round import next_turn, still_turned, turned
from sidestep.safety.shields.look_ahead import Outlook, clearance, imagine, moved, path
from sidestep.safety.shields.masked_cond import masked_cond
from sidestep.safety.shields.shield import Shield, ShieldResult
from sidestep.world.scenario import Scenario
from sidestep.world.state import World

MODELS = ("nash", "turn-then-drive", "turn-while-driving", "pure-pursuit", "interceptor")
"""The strategies that drive the pursuers in imagined chases."""
_VARIANTS = 12
"""Random variations of the plan that a search tries."""
_FORGET = 0.9
"""Factor per control period by which a model's surprise decays."""
_SURPRISED = 0.1
"""Surprise, as a share of the wheel speed, from which on a model no longer counts as likely."""
_GIVE = 0.001
"""Clearance (m) that a plan may lose below the present one."""
_PAUSE = 0.15
"""Time (s) for which a plan that is not clear is followed before the next search."""
_LEAVE = 1.25
"""Factor on the distances of `near_...` once the shield looks ahead, for a robot with motors."""


def real_or_none(value: Any) -> Any:
    """A field that may be None, as a real number."""
    return None if value is None else real(value)


class JointMemory(eqx.Module):
    """What the shield keeps from call to call.

    - `sides (m,)` of the pursuit barrier
    - `plan (segments,)` the escape plan, followed for `age` (s); `clear`: whether it was found to stay clear
    - `pause` s for which a plan that is not clear is followed before the next search
    - `expected (models, m, 2)` wheel speeds (m/s) that each model would have driven in the last period
    - `surprise (models,)` how wrong each model was of late, as a share of the wheel speed
    - `calls ()` so far; `looked`: whether the last one looked ahead
    - `turn ()` leads it round an obstacle, see `going_round`
    """

    sides: Float[Array, "m"]
    plan: EscapePlan
    age: Scalar
    clear: Flag
    pause: Scalar
    expected: Float[Array, "models m 2"]
    surprise: Float[Array, "models"]
    calls: Int[Array, ""]
    looked: Flag
    turn: Scalar


class _Decision(eqx.Module):
    """`accept` the nominal action, or else follow `plan`, now of `age` (s). `clear` and `pause` as in
    `JointMemory`."""

    accept: Flag
    plan: EscapePlan
    age: Scalar
    clear: Flag
    pause: Scalar


class _Inputs(eqx.Module):
    """What a decision is made from.

    - `action` m/s, what the rows leave of the nominal action; `sides` the ones they follow for it
    - `held` the sides that hold if this action is not driven
    - `wheels` m/s, what each model would drive now; `live`: whether it is a likely model
    """

    world: World
    memory: JointMemory
    action: Float[Array, "2"]
    sides: Float[Array, "m"]
    held: Float[Array, "m"]
    wheels: Float[Array, "models m 2"]
    live: Array
    key: PRNGKeyArray


@final
class JointShield(Shield):
    """The `game` shield with a look-ahead inside its rows.

    **Decision.** The shield holds an escape plan (see `escape_plan`). It accepts the nominal action if the
    plan, followed from the next period on, stays clear of pursuers and obstacles for the whole horizon,
    whichever of `models` drives the pursuers. Otherwise it searches among all constant plans and random
    variations of the present one. Of the plans that stay clear against every model it takes the one whose
    first velocity is closest to the action. If there is none, it takes the plan that stays clear longest:
    first against the models that have predicted the pursuers well, then against all. If that plan comes to no
    contact within the horizon, and only closer than the margin, it is followed for 0.15 s before the next
    search, as long as that stays true.

    **What holds.** Every action has passed the rows of `game`, pursuers first, so what holds for that shield
    holds for this one. What the look-ahead adds towards obstacles is measured, not proved. Where the evader
    is stuck behind an obstacle, the nominal action is turned aside first (see `going_round`).

    **When.** The shield looks ahead only if the clearance of the nearest obstacle, or of a second pursuer, is
    at most `near_obstacle` (m) and the least pursuit barrier at most `near_pursuer` (m).

    **Arguments.**

    - `pursuer_gain` 1/s, replaces the scenario's. A larger one leaves more room to move and to change sides
      close to a pursuer's axis.
    - `margin` m: a plan is clear if it keeps that much clearance, or what there is now if that is less.
    - `horizon` s, imagined in `steps` periods, or in control periods of the robot where those are longer.
      Longer periods promise too much, because an evader gains on a pursuer that decides less often. The cost
      of a decision is proportional to `steps`.
    - `budget`: the rows keep it (see `GameShield`), and clear means that much more.
    - `acceleration` m/s^2: the imagined evader changes its velocity no faster, starting from
      `world.evader_velocity`, which must then be the robot's. Changing direction then costs distance. So the
      sides follow only actions that are driven, and the shield stops looking ahead only at 1.25 times the
      distances at which it began.

    The action carries derivatives, the choice between action and plan does not.
    """

    keeps_pursuit_barrier = True
    scenario: Scenario
    pursuer_gain: Scalar = eqx.field(converter=real, default=4.0)
    near_obstacle: Scalar = eqx.field(converter=real, default=0.8)
    near_pursuer: Scalar = eqx.field(converter=real, default=0.5)
    margin: Scalar = eqx.field(converter=real, default=0.02)
    horizon: Scalar = eqx.field(converter=real, default=8.0)
    budget: Budget | None = None
    acceleration: Scalar | None = eqx.field(converter=real_or_none, default=None)
    steps: int = eqx.field(static=True, default=160)
    models: tuple[str, ...] = eqx.field(static=True, default=MODELS)

    @property
    def rows_only(self) -> GameShield:
        scenario = eqx.tree_at(lambda s: s.pursuer_gain, self.scenario, self.pursuer_gain)
        return GameShield(scenario, self.budget, nominal_picks_side=True)

    def init(self, world: World) -> JointMemory:
        count, m = len(self.models), self.scenario.pursuer_count
        return JointMemory(
            sides=self.rows_only.init(world),
            plan=jnp.full(SEGMENTS, CHOICES - 1, jnp.int32),
            age=jnp.zeros_like(world.time),
            clear=jnp.zeros((), bool),
            pause=jnp.zeros_like(world.time),
            expected=jnp.broadcast_to(world.wheel_speeds, (count, m, 2)),
            surprise=jnp.zeros(count, world.evader.dtype),
            calls=jnp.zeros((), jnp.int32),
            looked=jnp.zeros((), bool),
            turn=jnp.zeros_like(world.time),
        )

    def __call__(
        self, world: World, nominal: Float[AnyArray, "2"], memory: JointMemory
    ) -> tuple[ShieldResult, JointMemory]:
        result, after, _ = self._decided(world, nominal, memory, look=True)
        return result, after

    def at_once(
        self, world: World, nominal: Float[AnyArray, "2"], memory: JointMemory
    ) -> tuple[ShieldResult, JointMemory, Flag]:
        result, after, need = self._decided(world, nominal, memory, look=False)
        return result, after, ~need

    def _decided(
        self, world: World, nominal: Float[AnyArray, "2"], memory: JointMemory, *, look: bool
    ) -> tuple[ShieldResult, JointMemory, Flag]:
        """The answer, the next memory, and whether it needs a look-ahead, which it takes with `look`."""
        kept = with_margins(self.scenario, self.budget)
        nominal = jnp.asarray(nominal, world.evader.dtype)
        turn = still_turned(kept, world, nominal, memory.turn)
        result, after, accepted, need = self._filtered(world, nominal, turn, memory, look=look)
        # Where the look-ahead rejects the action, the evader is not stuck behind an obstacle.
        moved_on = ~accepted | (result.status == Status.INVALID)
        towards_pursuers = result.barriers[: self.scenario.pursuer_count]
        turn = next_turn(kept, world, nominal, result.action, turn, towards_pursuers)
        turn = jnp.where(moved_on, 0.0, turn).astype(memory.turn.dtype)
        return result, eqx.tree_at(lambda memory: memory.turn, after, turn), need

    def rows(self, world: World, memory: JointMemory) -> BarrierRows:
        return self.rows_only.rows(world, memory.sides)

    def filter_by_rows(
        self, world: World, nominal: Float[AnyArray, "2"], memory: JointMemory
    ) -> tuple[ShieldResult, JointMemory]:
        result, sides = self.rows_only(world, nominal, memory.sides)
        return result, eqx.tree_at(lambda memory: memory.sides, memory, sides)

    def has_plan(self, memory: JointMemory) -> Flag:
        return memory.clear | (memory.pause > 0.0)

    @eqx.filter_jit
    def plan(self, world: World, memory: JointMemory) -> Float[Array, "n 2"]:
        if not self.scenario.pursuer_count:
            return super().plan(world, memory)
        following = memory.sides, memory.plan, memory.age, self.horizon, self.acceleration
        return path(self.scenario, self.rows_only.filter_unchecked, world, *following)

    def with_acceleration(self, acceleration: float) -> JointShield:
        return dataclasses.replace(self, acceleration=acceleration)

    def _filtered(
        self, world: World, nominal: Float[Array, "2"], turn: Scalar, memory: JointMemory, *, look: bool
    ) -> tuple[ShieldResult, JointMemory, Flag, Flag]:
        """The answer to a nominal action that is turned aside by `turn`, the next memory, whether that action
        was accepted, and whether it needs a look-ahead. Without `look` the rest is void where it does."""
        game = self.rows_only
        greedy, sides = game(world, turned(nominal, turn), memory.sides)
        greedy = as_changed(greedy, nominal, turn != 0.0)
        m = self.scenario.pursuer_count
        if m == 0 or m + self.scenario.obstacle_count == 1:
            after = eqx.tree_at(lambda memory: memory.sides, memory, sides)
            return greedy, after, jnp.ones((), bool), jnp.zeros((), bool)
        # The rows towards the nearest pursuer can be kept alone; with anything beside it they may not.
        towards_pursuers = jnp.sort(greedy.barriers[:m])
        far = 1.0 if self.acceleration is None else jnp.where(memory.looked, _LEAVE, 1.0)
        near = jnp.min(greedy.barriers[m:], initial=jnp.inf) <= far * self.near_obstacle
        near |= jnp.min(towards_pursuers[1:], initial=jnp.inf) <= far * self.near_obstacle
        need = near & (towards_pursuers[0] <= far * self.near_pursuer)
        # An unknown world cannot be imagined.
        need &= greedy.status != Status.INVALID

        wrong = jnp.max(jnp.abs(memory.expected - world.wheel_speeds), axis=(1, 2))
        wrong = jnp.where(memory.calls > 0, wrong, 0.0) / self.scenario.pursuer_speed
        wrong = jnp.where(jnp.isfinite(wrong), wrong, 1.0)
        surprise = jnp.maximum(_FORGET * memory.surprise, wrong)
        live = surprise < _SURPRISED
        live |= ~jnp.any(live)
        models = tuple(make_pursuer(name) for name in self.models)
        key = jax.random.key(0)
        wheels = jnp.stack([pursue(self.scenario, model, world, key) for model in models])
        # A robot that reaches every velocity at once can change sides and back at no cost.
        held = sides if self.acceleration is None else memory.sides
        idle = _Decision(~need, memory.plan, memory.age, jnp.zeros((), bool), jnp.zeros_like(memory.pause))
        if look:
            next_key = jax.random.fold_in(key, memory.calls)
            inputs = _Inputs(world, memory, greedy.action, sides, held, wheels, live, next_key)
            decision = self._look(need, idle, inputs)
            result, sides = self._followed(decision, inputs, greedy, nominal)
        else:
            decision, result = idle, greedy
        after = JointMemory(
            sides,
            decision.plan,
            decision.age + self.scenario.control_period,
            need & decision.clear,
            jnp.where(need, decision.pause - self.scenario.control_period, 0.0),
            wheels,
            surprise,
            memory.calls + 1,
            need,
            turn,
        )
        return result, after, decision.accept, need

    def _followed(
        self, decision: _Decision, inputs: _Inputs, greedy: ShieldResult, nominal: Float[Array, "2"]
    ) -> tuple[ShieldResult, Float[Array, "m"]]:
        """The answer and the sides: those of the accepted action (`greedy`), or of the escape plan."""
        choice = choice_at(decision.plan, decision.age, self.horizon / SEGMENTS)
        planned = chosen_velocity(self.scenario, inputs.world, inputs.held, choice)
        evasive, evasive_sides = self.rows_only(inputs.world, planned, inputs.held)
        wanted = jnp.where(jnp.all(jnp.isfinite(nominal)), nominal, 0.0)
        evasive = eqx.tree_at(
            lambda result: (result.status, result.intervention),
            evasive,
            (jnp.maximum(evasive.status, Status.CORRECTED), correction(evasive.action, wanted)),
        )
        sides = jnp.where(decision.accept, inputs.sides, evasive_sides)
        return select(decision.accept, greedy, evasive), sides

    def _look(self, need: Flag, idle: _Decision, inputs: _Inputs) -> _Decision:
        """Whether the action is accepted, and the escape plan to hold or else to follow."""
        arrays, fixed = eqx.partition(self, eqx.is_array)
        arrays, inputs = jax.lax.stop_gradient((arrays, inputs))
        memory = inputs.memory

        def confirm(arrays: Any, inputs: _Inputs) -> _Decision:
            holds = eqx.combine(arrays, fixed)._confirm(inputs)
            memory = inputs.memory
            clear = holds & memory.clear
            pause = jnp.where(holds & ~clear, memory.pause, 0.0)
            return _Decision(clear, memory.plan, memory.age, clear, pause)

        def search(arrays: Any, inputs: _Inputs) -> _Decision:
            return eqx.combine(arrays, fixed)._search(inputs)

        quick = masked_cond(confirm, need & self.has_plan(memory), idle, arrays, inputs, width=4)
        seek = ~quick.accept & (quick.pause <= 0.0)
        return masked_cond(search, seek, quick, arrays, inputs, width=1)

    def _confirm(self, inputs: _Inputs) -> Flag:
        """Whether the plan stays clear after the action, whichever model drives. For a plan that was not
        clear: whether it still comes to no contact."""
        now, memory, count = inputs.world, inputs.memory, len(self.models)
        lanes, action = in_lanes((now, inputs.action), count)
        after = moved(self.scenario, lanes, action, jnp.moveaxis(inputs.wheels, 0, -1), self.acceleration)
        worlds = jax.tree.map(lambda leaf: leaf[..., None], select(memory.clear, after, lanes))
        sides = jnp.where(memory.clear, inputs.sides, inputs.held)
        outlook = self._imagine(worlds, sides, memory.plan[None], memory.age[None])
        # Where the action itself leads counts too.
        least = jnp.minimum(jnp.min(outlook.least), jnp.min(clearance(self.scenario, worlds)))
        return jnp.where(memory.clear, least >= self._floor(now), least > 0.0)

    def _floor(self, world: World) -> Scalar:
        """Clearance (m) that a clear plan keeps: margin and budget, or what there is now if that is less."""
        now = clearance(self.scenario, world)
        more = 0.0 if self.budget is None else self.budget.towards_obstacles(self.scenario)
        return jnp.clip(now - _GIVE, 0.0, self.margin + more)

    def _search(self, inputs: _Inputs) -> _Decision:
        memory = inputs.memory
        keep_key, choice_key = jax.random.split(inputs.key)
        constant = jnp.broadcast_to(jnp.arange(CHOICES, dtype=jnp.int32)[:, None], (CHOICES, SEGMENTS))
        shape = (_VARIANTS, SEGMENTS)
        segment = self.horizon / SEGMENTS
        starts = memory.age + segment * jnp.arange(SEGMENTS).astype(segment.dtype)
        rest = jax.vmap(choice_at, in_axes=(None, 0, None))(memory.plan, starts, segment)
        other = jax.random.randint(choice_key, shape, 0, CHOICES, jnp.int32)
        variants = jnp.where(jax.random.bernoulli(keep_key, 0.5, shape), other, rest)
        plans = jnp.concatenate([memory.plan[None], constant, variants])
        ages = jnp.zeros(len(plans), segment.dtype).at[0].set(memory.age)
        worlds = in_lanes(inputs.world, len(self.models), len(plans))
        outlook = self._imagine(worlds, inputs.held, plans, ages)
        least = jnp.min(outlook.least, axis=0)
        clear = least >= self._floor(inputs.world)
        likely = jnp.min(jnp.where(inputs.live[:, None], outlook.time, jnp.inf), axis=0)
        always = jnp.min(outlook.time, axis=0)
        first = jax.vmap(lambda choice: chosen_velocity(self.scenario, inputs.world, inputs.held, choice))(
            plans[:, 0]
        )
        correction = norm(first - inputs.action)
        best = jnp.where(
            jnp.any(clear),
            jnp.argmin(jnp.where(clear, correction, jnp.inf)),
            jnp.argmax(100.0 * likely + always + least),
        )
        pause = jnp.where((least[best] > 0.0) & ~clear[best], _PAUSE, 0.0).astype(least.dtype)
        return _Decision(jnp.zeros((), bool), plans[best], ages[best], clear[best], pause)

    def _imagine(self, worlds: World, sides: Any, plans: Any, ages: Any) -> Outlook:
        models: tuple[Pursuer, ...] = tuple(make_pursuer(name) for name in self.models)
        all_sides = jnp.broadcast_to(sides[:, None, None], (*sides.shape, len(models), len(plans)))
        period = jnp.maximum(self.scenario.control_period, self.horizon / self.steps)
        paced = eqx.tree_at(lambda scenario: scenario.control_period, self.scenario, period)
        return imagine(
            paced,
            self.rows_only.filter_unchecked,
            models,
            worlds,
            all_sides,
            plans,
            ages,
            self.horizon / SEGMENTS,
            self.steps,
            self.acceleration,
        )
