"""The shield `joint`: no capture and no collision, by looking ahead inside the rows of `game`."""

from __future__ import annotations

import dataclasses
from typing import Any, final

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int, PRNGKeyArray

from sidestep._arrays import AnyArray, Flag, Scalar, norm, real, select
from sidestep.pursuit import Pursuer, make_pursuer, pursue
from sidestep.safety.barriers.barrier import BarrierRows
from sidestep.safety.barriers.budget import Budget
from sidestep.safety.barriers.sampling_margin import guarded
from sidestep.safety.filter.status import Status
from sidestep.safety.shields.answer import as_turned, correction
from sidestep.safety.shields.by_need import by_need
from sidestep.safety.shields.game import GameShield
from sidestep.safety.shields.going_round import next_turn, still_turned, turned
from sidestep.safety.shields.look_ahead import (
    STRETCHES,
    WISHES,
    Outlook,
    clearance,
    imagine,
    moved,
    stretch,
    wish,
)
from sidestep.safety.shields.shield import Shield, ShieldResult
from sidestep.safety.shields.way_out import way_out
from sidestep.world.scenario import Scenario
from sidestep.world.state import World

MODELS = ("nash", "turn-then-drive", "turn-while-driving", "pure-pursuit", "interceptor")
"""The pursuers that an imagined chase is held against."""
_VARIANTS = 12
_FORGET = 0.9
_SURPRISED = 0.1
_GIVE = 0.001
_PAUSE = 0.15
_LEAVE = 1.25


def _real_or_none(value: Any) -> Any:
    return None if value is None else real(value)


class JointMemory(eqx.Module):
    """What the shield keeps in mind.

    `sides (m,)` of the pursuit barrier; `way (stretches,)` the way out that it counts on, if `counts`,
    followed for `age` (s); `pause` the time (s) for which no other is sought; `expected (models, m, 2)` the
    wheel speeds (m/s) that each model would have driven last, and `surprise (models,)` by how much it was
    wrong of late, as a share of the wheel speed; `calls ()` so far; whether it `looked` ahead last time; the
    `turn ()` that leads it round an obstacle, see `going_round`.
    """

    sides: Float[Array, "m"]
    way: Int[Array, "stretches"]
    age: Scalar
    counts: Flag
    pause: Scalar
    expected: Float[Array, "models m 2"]
    surprise: Float[Array, "models"]
    calls: Int[Array, ""]
    looked: Flag
    turn: Scalar


class _Decision(eqx.Module):
    """`accept` the nominal action, or else follow `way`; whether that way out is `clear`, or for how long
    (s) no other need be sought while it comes to no contact."""

    accept: Flag
    way: Int[Array, "stretches"]
    age: Scalar
    clear: Flag
    pause: Scalar


class _Situation(eqx.Module):
    """What a decision is made from: the `action` that the rows let through, the `sides` that they follow for
    it, the `held` ones that count if it is not driven, and the `wheels` (m/s) that each model would drive."""

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

    An action is accepted if, after it, the way out that the shield counts on (see `look_ahead`) stays clear
    of pursuers and obstacles for the whole horizon against every pursuer of `models`. Else a new one is
    sought among all constant wishes and random variations of the old one: of those that stay clear against
    all, the one whose first wish is closest to the action; if there is none, the one that stays clear
    longest, first against those models that drive as the pursuers have been seen to, then against all. If
    that one touches nothing within the horizon, and only keeps less than the margin, it is followed for
    0.15 s, as long as that stays true, before another is sought.

    Whatever is driven has passed the rows of `game`, pursuers first: what holds for that shield holds for
    this one too. What the look-ahead adds towards obstacles is measured, not proved. Behind an obstacle that
    it is stuck at, the nominal action is turned aside first (see `going_round`).

    It is run only near: `near_obstacle` and `near_pursuer` bound the clearance of the nearest obstacle and
    the pursuit barrier's value (m) up to which the rows cannot vouch on their own. Clear means `margin` (m)
    away from obstacles, or what there is now if that is less. `pursuer_gain` (1/s) replaces the scenario's: a
    larger one leaves more room to move, and to change sides close to a pursuer's axis. A chase is imagined
    `horizon` (s) ahead in `steps` periods, or in as many of the robot's own where those are longer. Periods
    longer than the robot's promise too much, because an evader gains on a pursuer that decides less often;
    `steps` is what a decision costs. With a `budget` the rows keep it (see `GameShield`), and clear means so
    much more. The decision carries no derivatives; the action does.

    With an `acceleration` (m/s^2) imagined robots change their velocity no faster, from
    `world.evader_velocity` on, which must be the robot's; to change sides then costs distance, and a side
    that only the nominal action would change to counts as changed only where that is driven. To turn back and
    forth costs as much, so what is near remains so up to 1.25 times as far.
    """

    keeps_pursuit_barrier = True
    scenario: Scenario
    pursuer_gain: Scalar = eqx.field(converter=real, default=4.0)
    near_obstacle: Scalar = eqx.field(converter=real, default=0.8)
    near_pursuer: Scalar = eqx.field(converter=real, default=0.5)
    margin: Scalar = eqx.field(converter=real, default=0.02)
    horizon: Scalar = eqx.field(converter=real, default=8.0)
    budget: Budget | None = None
    acceleration: Scalar | None = eqx.field(converter=_real_or_none, default=None)
    steps: int = eqx.field(static=True, default=160)
    models: tuple[str, ...] = eqx.field(static=True, default=MODELS)

    @property
    def _game(self) -> GameShield:
        scenario = eqx.tree_at(lambda s: s.pursuer_gain, self.scenario, self.pursuer_gain)
        return GameShield(scenario, self.budget, wish_picks_side=True)

    @property
    def rows_only(self) -> GameShield:
        return self._game

    def init(self, world: World) -> JointMemory:
        count, m = len(self.models), self.scenario.pursuer_count
        return JointMemory(
            sides=self._game.init(world),
            way=jnp.full(STRETCHES, WISHES - 1, jnp.int32),
            age=jnp.zeros_like(world.time),
            counts=jnp.zeros((), bool),
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
        kept = guarded(self.scenario, self.budget)
        nominal = jnp.asarray(nominal, world.evader.dtype)
        turn = still_turned(kept, world, nominal, memory.turn)
        result, after, accepted = self._filtered(world, nominal, turn, memory)
        # What the look-ahead avoids is not what it is stuck behind.
        moved_on = ~accepted | (result.status == Status.INVALID)
        towards_pursuers = result.barriers[: self.scenario.pursuer_count]
        turn = next_turn(kept, world, nominal, result.action, turn, towards_pursuers)
        turn = jnp.where(moved_on, 0.0, turn)
        return result, eqx.tree_at(lambda memory: memory.turn, after, turn.astype(memory.turn.dtype))

    def rows(self, world: World, memory: JointMemory) -> BarrierRows:
        return self._game.rows(world, memory.sides)

    def filter_by_rows(
        self, world: World, nominal: Float[AnyArray, "2"], memory: JointMemory
    ) -> tuple[ShieldResult, JointMemory]:
        result, sides = self._game(world, nominal, memory.sides)
        return result, eqx.tree_at(lambda memory: memory.sides, memory, sides)

    def has_plan(self, memory: JointMemory) -> Flag:
        return memory.counts | (memory.pause > 0.0)

    @eqx.filter_jit
    def plan(self, world: World, memory: JointMemory) -> Float[Array, "n 2"]:
        """Where (m) the way out that the shield counts on leads, against a pursuer that plays `nash`."""
        if not self.scenario.pursuer_count:
            return super().plan(world, memory)
        return way_out(
            self.scenario,
            self._game.heed,
            world,
            memory.sides,
            memory.way,
            memory.age,
            self.horizon,
            self.acceleration,
        )

    def with_acceleration(self, acceleration: float) -> JointShield:
        return dataclasses.replace(self, acceleration=acceleration)

    def _filtered(
        self, world: World, nominal: Float[Array, "2"], turn: Scalar, memory: JointMemory
    ) -> tuple[ShieldResult, JointMemory, Flag]:
        """The answer to a nominal action that is turned aside by `turn`, the next memory, and whether that
        action was accepted."""
        game = self._game
        greedy, sides = game(world, turned(nominal, turn), memory.sides)
        greedy = as_turned(greedy, nominal, turn)
        m = self.scenario.pursuer_count
        if m == 0 or m + self.scenario.obstacle_count == 1:
            return greedy, eqx.tree_at(lambda memory: memory.sides, memory, sides), jnp.ones((), bool)
        # The rows of the nearest pursuer can be kept; whether those of anything beside it can is not said.
        towards_pursuers = jnp.sort(greedy.barriers[:m])
        far = 1.0 if self.acceleration is None else jnp.where(memory.looked, _LEAVE, 1.0)
        near = jnp.min(greedy.barriers[m:], initial=jnp.inf) <= far * self.near_obstacle
        near |= jnp.min(towards_pursuers[1:], initial=jnp.inf) <= far * self.near_obstacle
        need = near & (towards_pursuers[0] <= far * self.near_pursuer)
        # What is not known cannot be imagined.
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
        # Who drives at once takes a change of sides back at no cost.
        held = sides if self.acceleration is None else memory.sides
        situation = _Situation(
            world, memory, greedy.action, sides, held, wheels, live, jax.random.fold_in(key, memory.calls)
        )
        decision = self._look(need, situation)

        length = self.horizon / STRETCHES
        chosen = wish(self.scenario, world, held, stretch(decision.way, decision.age, length))
        evasive, evasive_sides = game(world, chosen, held)
        wanted = jnp.where(jnp.all(jnp.isfinite(nominal)), nominal, 0.0)
        evasive = eqx.tree_at(
            lambda result: (result.status, result.intervention),
            evasive,
            (jnp.maximum(evasive.status, Status.CORRECTED), correction(evasive.action, wanted)),
        )
        result = select(decision.accept, greedy, evasive)
        after = JointMemory(
            jnp.where(decision.accept, sides, evasive_sides),
            decision.way,
            decision.age + self.scenario.control_period,
            need & decision.clear,
            jnp.where(need, decision.pause - self.scenario.control_period, 0.0),
            wheels,
            surprise,
            memory.calls + 1,
            need,
            turn,
        )
        return result, after, decision.accept

    def _look(self, need: Flag, situation: _Situation) -> _Decision:
        """Whether the action may be taken, and the way out counted on or to be taken instead."""
        arrays, fixed = eqx.partition(self, eqx.is_array)
        arrays, situation = jax.lax.stop_gradient((arrays, situation))
        memory = situation.memory
        nothing = jnp.zeros_like(memory.pause)
        idle = _Decision(~need, memory.way, memory.age, jnp.zeros((), bool), nothing)

        def confirm(arrays: Any, situation: _Situation) -> _Decision:
            holds = eqx.combine(arrays, fixed)._confirm(situation)
            memory = situation.memory
            clear = holds & memory.counts
            pause = jnp.where(holds & ~clear, memory.pause, 0.0)
            return _Decision(clear, memory.way, memory.age, clear, pause)

        def search(arrays: Any, situation: _Situation) -> _Decision:
            return eqx.combine(arrays, fixed)._search(situation)

        quick = by_need(confirm, need & self.has_plan(memory), idle, arrays, situation, width=4)
        seek = ~quick.accept & (quick.pause <= 0.0)
        return by_need(search, seek, quick, arrays, situation, width=1)

    def _confirm(self, situation: _Situation) -> Flag:
        """Whether the way out counted on stays clear after the action, whichever model drives; or, if none
        is counted on, whether the one that is followed still comes to no contact."""
        now, memory = situation.world, situation.memory
        after = [
            select(memory.counts, self._stepped(now, situation.action, wheels), now)
            for wheels in situation.wheels
        ]
        worlds = jax.tree.map(lambda *leaves: jnp.stack(leaves, axis=-1)[..., None], *after)
        sides = jnp.where(memory.counts, situation.sides, situation.held)
        outlook = self._imagine(worlds, sides, memory.way[None], memory.age[None])
        # Where the action itself leads counts too.
        least = jnp.minimum(jnp.min(outlook.least), jnp.min(clearance(self.scenario, worlds)))
        return jnp.where(memory.counts, least >= self._floor(now), least > 0.0)

    def _stepped(self, world: World, action: Float[Array, "2"], wheels: Float[Array, "m 2"]) -> World:
        if self.acceleration is None:
            return self.scenario.step(world, action, wheels)[0]
        return moved(self.scenario, world, action, wheels, self.acceleration)

    def _floor(self, world: World) -> Scalar:
        """The clearance (m) that a way out must keep: the margin and the budget, or what there is now if that
        is less."""
        now = clearance(self.scenario, world)
        more = 0.0 if self.budget is None else self.budget.towards_obstacles(self.scenario)
        return jnp.clip(now - _GIVE, 0.0, self.margin + more)

    def _search(self, situation: _Situation) -> _Decision:
        memory = situation.memory
        choice_key, wish_key = jax.random.split(situation.key)
        constant = jnp.broadcast_to(jnp.arange(WISHES, dtype=jnp.int32)[:, None], (WISHES, STRETCHES))
        shape = (_VARIANTS, STRETCHES)
        length = self.horizon / STRETCHES
        starts = memory.age + length * jnp.arange(STRETCHES).astype(length.dtype)
        rest = jax.vmap(stretch, in_axes=(None, 0, None))(memory.way, starts, length)
        other = jax.random.randint(wish_key, shape, 0, WISHES, jnp.int32)
        variants = jnp.where(jax.random.bernoulli(choice_key, 0.5, shape), other, rest)
        ways = jnp.concatenate([memory.way[None], constant, variants])
        ages = jnp.zeros(len(ways), length.dtype).at[0].set(memory.age)
        count = len(self.models)
        worlds = jax.tree.map(
            lambda leaf: jnp.broadcast_to(leaf[..., None, None], (*leaf.shape, count, len(ways))),
            situation.world,
        )
        outlook = self._imagine(worlds, situation.held, ways, ages)
        least = jnp.min(outlook.least, axis=0)
        clear = least >= self._floor(situation.world)
        likely = jnp.min(jnp.where(situation.live[:, None], outlook.time, jnp.inf), axis=0)
        always = jnp.min(outlook.time, axis=0)
        first = jax.vmap(lambda number: wish(self.scenario, situation.world, situation.held, number))(
            ways[:, 0]
        )
        correction = norm(first - situation.action)
        best = jnp.where(
            jnp.any(clear),
            jnp.argmin(jnp.where(clear, correction, jnp.inf)),
            jnp.argmax(100.0 * likely + always + least),
        )
        pause = jnp.where((least[best] > 0.0) & ~clear[best], _PAUSE, 0.0).astype(least.dtype)
        return _Decision(jnp.zeros((), bool), ways[best], ages[best], clear[best], pause)

    def _imagine(self, worlds: World, sides: Any, ways: Any, ages: Any) -> Outlook:
        models: tuple[Pursuer, ...] = tuple(make_pursuer(name) for name in self.models)
        all_sides = jnp.broadcast_to(sides[:, None, None], (*sides.shape, len(models), len(ways)))
        period = jnp.maximum(self.scenario.control_period, self.horizon / self.steps)
        paced = eqx.tree_at(lambda scenario: scenario.control_period, self.scenario, period)
        return imagine(
            paced,
            self._game.heed,
            models,
            worlds,
            all_sides,
            ways,
            ages,
            self.horizon / STRETCHES,
            self.steps,
            self.acceleration,
        )
