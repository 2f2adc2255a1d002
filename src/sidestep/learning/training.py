"""The training loop on the device, under one `lax.scan`: act, filter, move, store, update."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int, Key, PRNGKeyArray

from sidestep._arrays import Count, Lanes, real, select
from sidestep.learning.bounds import through_shield
from sidestep.learning.networks import Actor
from sidestep.learning.options import TrainingOptions
from sidestep.learning.players import EVADING, Player
from sidestep.learning.replay import Replay, Transition, sample
from sidestep.learning.td3 import Bound, Learner, Losses, update
from sidestep.learning.variation import FIXED, Variation
from sidestep.loop.episode import Episode, Period, Tally, Task, begin
from sidestep.loop.step import CAPTURED, COLLIDED
from sidestep.world import Scenario, World


class TrainState(eqx.Module):
    """The complete state of a training: a training restored from it continues bitwise equal.

    **Attributes:** the `episode` that runs, or one in each of many worlds in lanes, and what the robots of it
    have `drawn` (see `Variation`); `episodes`, how many have ended in each world; `decisions` of each world;
    `env_steps`, control periods of all worlds.
    """

    learner: Learner
    replay: Replay
    episode: Episode
    drawn: Float[Array, "varied *lanes"]
    key: PRNGKeyArray
    episodes: Int[Array, "*lanes"]
    decisions: Count
    env_steps: Count

    @property
    def ended(self) -> Count:
        """How many episodes have ended."""
        return jnp.sum(self.episodes)


class Report(eqx.Module):
    """The host's data of one decision: the tally, which is the episode's total when `ended`; the evader's
    speed (m/s); whether the proposed actions were `finite`. After axes of decisions, arrays have one of
    worlds if there are many."""

    ended: Bool[Array, "..."]
    outcome: Int[Array, "..."]
    tally: Tally
    evader_speed: Float[Array, "..."]
    env_steps: Int[Array, "..."]
    losses: Losses
    finite: Bool[Array, "..."]


class _Drive(NamedTuple):
    """One decision: the episode after it, the sums of the executed actions and of the corrections (m/s), and
    the evader's `path`."""

    end: Episode
    executed: Float[Array, "2 *lanes"]
    correction: Lanes
    path: Float[Array, "knots 2 *lanes"]


class Course(eqx.Module):
    """What is trained, and how."""

    scenario: Scenario
    shield: Any
    pursuer: Any
    options: TrainingOptions
    player: Player
    variation: Variation

    def inside(self, function: Callable[..., Any], drawn: Array, *arguments: Any) -> Any:
        """`function(scenario, shield, *arguments)` with the drawn robots, see `Variation.inside`."""
        return self.variation.inside(function, self.scenario, self.shield, drawn, *arguments)

    def reset(self, key: PRNGKeyArray) -> tuple[World, Float[Array, "varied *lanes"]]:
        """A start, or many in lanes, and what was drawn for it."""

        def one(key: PRNGKeyArray) -> tuple[World, Float[Array, "varied"]]:
            drawn = self.variation.draw(jax.random.fold_in(key, 0))
            return self.variation.start(self.scenario, drawn, key), drawn

        if self.options.worlds == 1:
            return one(key)
        starts = jax.vmap(one)(jax.random.split(key, self.options.worlds))
        return jax.tree.map(lambda leaf: jnp.moveaxis(leaf, 0, -1), starts)

    def begin(self, drawn: Float[Array, "varied *lanes"], world: World) -> Episode:
        """An episode in `world`."""
        return self.inside(lambda scenario, shield, world: begin(shield, world), drawn, world)

    def observe(
        self, drawn: Float[Array, "varied *lanes"], world: World
    ) -> Float[Array, "observation *lanes"]:
        """The player's observation."""
        return self.inside(lambda scenario, shield, world: self.player.observe(scenario, world), drawn, world)

    def command(
        self, drawn: Float[Array, "varied *lanes"], world: World, action: Float[Array, "2 *lanes"]
    ) -> Float[Array, "2 *lanes"]:
        """The player's command (m/s)."""

        def command(scenario: Scenario, shield: Any, world: World, action: Array) -> Array:
            return self.player.command(scenario, world, action)

        return self.inside(command, drawn, world, action)

    def guide(
        self, drawn: Float[Array, "varied *lanes"], world: World, key: PRNGKeyArray
    ) -> Float[Array, "2 *lanes"]:
        """The command (m/s) of the strategy that drives the `guided` worlds, which decides as seldom."""

        def guide(scenario: Scenario, shield: Any, world: World, key: Any) -> Array:
            seldom = self.options.decision_steps * scenario.control_period
            paced = eqx.tree_at(lambda scenario: scenario.control_period, scenario, seldom)
            return self.player.guide(paced, self.pursuer, world, key)

        return self.inside(guide, drawn, world, jax.random.split(key, self.options.worlds))

    def speed(self, drawn: Float[Array, "varied *lanes"], world: World) -> Lanes:
        """The evader's speed (m/s)."""

        def speed(scenario: Scenario, shield: Any, world: World) -> Lanes:
            return jnp.broadcast_to(scenario.evader_speed, world.time.shape)

        return self.inside(speed, drawn, world)


def _proposed(actor: Actor, observation: Float[Array, "observation *lanes"]) -> Float[Array, "2 *lanes"]:
    return actor(observation[None])[0] if observation.ndim == 1 else actor(observation.T).T


@eqx.filter_jit
def start(
    scenario: Scenario,
    shield: Any,
    options: TrainingOptions,
    key: PRNGKeyArray,
    capacity: int,
    player: Player = EVADING,
    variation: Variation = FIXED,
) -> TrainState:
    """The state before the first decision.

    Its dtypes equal those that `run_chunk` returns. A weakly typed count, for example, would make the second
    chunk recompile.
    """
    course = Course(scenario, shield, None, options, player, variation)
    net_key, reset_key, key = jax.random.split(key, 3)
    world, drawn = course.reset(reset_key)
    one, values = jax.tree.map(lambda leaf: leaf[..., 0], (world, drawn)) if world.lanes else (world, drawn)
    example = Transition(
        world=one,
        next_world=one,
        drawn=values,
        path=jnp.zeros((options.decision_steps + 1, 2), world.evader.dtype),
        steps=jnp.zeros((), int),
        proposed=jnp.zeros_like(one.evader),
        executed=jnp.zeros_like(one.evader),
        correction=real(0.0),
        lost=jnp.asarray(False),
    )
    return TrainState(
        learner=options.algorithm.init(player.observation_size(scenario), 2, net_key),
        replay=Replay.init(example, capacity, options.worlds),
        episode=course.begin(drawn, world),
        drawn=drawn,
        key=key,
        episodes=jnp.zeros_like(world.time, int),
        decisions=jnp.zeros((), int),
        env_steps=jnp.zeros((), int),
    )


def _drive(course: Course, state: TrainState, command: Float[Array, "2 *lanes"], key: PRNGKeyArray) -> _Drive:
    """Hold the command for a decision, or until the episode ends."""

    def advance(
        scenario: Scenario, shield: Any, episode: Episode, command: Array, key: Any
    ) -> tuple[Episode, Period]:
        return course.player.advance(Task(scenario, None, shield, course.pursuer), episode, command, key)

    def period(carry: tuple[Episode, Array, Array], key: Key[Array, "*lanes"]) -> tuple[Any, Array]:
        episode, *sums = carry
        episode, period = course.inside(advance, state.drawn, episode, command, key)
        result = period.result
        more = [total + one for total, one in zip(sums, (result.action, result.intervention), strict=True)]
        return (episode, *select(period.running, more, sums)), episode.world.evader

    begun = (state.episode, jnp.zeros_like(command), jnp.zeros_like(command[0]))
    keys = jax.random.split(key, (course.options.decision_steps, *command.shape[1:]))
    (end, executed, correction), places = jax.lax.scan(period, begun, keys)
    return _Drive(end, executed, correction, jnp.concatenate([state.episode.world.evader[None], places]))


def _learn(
    course: Course, options: TrainingOptions, learner: Learner, replay: Replay, key: PRNGKeyArray
) -> tuple[Learner, Losses]:
    def one(learner: Learner, key: PRNGKeyArray) -> tuple[Learner, Losses]:
        sample_key, update_key = jax.random.split(key)
        batch, before, after, drawn = sample(
            course.scenario,
            replay,
            sample_key,
            options.batch_size,
            hindsight=options.hindsight,
            mirror=options.mirror,
            executed_action=options.replay_action == "executed",
            correction_penalty=options.correction_penalty,
            time_cost=options.time_cost,
            reward_scale=options.reward_scale,
            player=course.player,
            variation=course.variation,
        )

        def shielded(worlds: World) -> Bound:
            return through_shield(course.scenario, course.shield, worlds, course.variation, drawn)

        target_bound = shielded(after) if options.replay_action == "executed" else course.player.bound
        bound = shielded(before) if options.filter_gradients else course.player.bound
        most = course.player.most(course.scenario) if options.bound_values else None
        best = None if most is None else options.reward_scale * most
        return update(options.algorithm, learner, batch, update_key, bound, target_bound, best)

    learner, losses = jax.lax.scan(one, learner, jax.random.split(key, options.updates_per_decision))
    return learner, jax.tree.map(lambda loss: loss[-1], losses)


def decide_and_learn(
    scenario: Scenario,
    shield: Any,
    pursuer: Any,
    options: TrainingOptions,
    state: TrainState,
    limit: Count,
    player: Player = EVADING,
    variation: Variation = FIXED,
) -> tuple[TrainState, Report]:
    """One decision of the policy in every world, its control periods, and the updates that follow it.

    After `limit` episodes the state does not change, so a training stops exactly at the end of an episode; of
    many worlds, others may end one in the same decision.
    """
    course = Course(scenario, shield, pursuer, options, player, variation)
    active = state.ended < limit
    world, drawn = state.episode.world, state.drawn
    key, noise_key, random_key, drive_key, learn_key, reset_key = jax.random.split(state.key, 6)

    wanted = _proposed(state.learner.actor, course.observe(drawn, world))
    noise = options.exploration_noise * jax.random.normal(noise_key, wanted.shape, dtype=float)
    explored = jnp.clip(wanted + noise, -1.0, 1.0)
    anything = jax.random.uniform(random_key, wanted.shape, dtype=float, minval=-1.0, maxval=1.0)
    warm = state.decisions * options.worlds < options.warmup_decisions
    # A learner that another training has begun does not start with random actions.
    begun = state.learner.updates > 0
    command = course.command(drawn, world, jnp.where(warm & ~begun, anything, explored))
    if options.guided > 0.0:
        led = jnp.arange(options.worlds) < round(options.guided * options.worlds)
        command = jnp.where(led, course.guide(drawn, world, jax.random.fold_in(drive_key, 0)), command)

    drive = _drive(course, state, command, drive_key)
    end, steps = drive.end, drive.end.tally.steps - state.episode.tally.steps
    periods = steps.astype(command.dtype)
    replay = state.replay.add(
        Transition(
            world=world,
            next_world=end.world,
            path=drive.path,
            steps=steps.astype(int),
            proposed=command,
            executed=drive.executed / periods,
            correction=drive.correction / periods,
            lost=(end.outcome == CAPTURED) | (end.outcome == COLLIDED),
            drawn=drawn,
        ),
        state.episodes,
        active,
    )
    now = options.after(state.ended, limit)
    learner, losses = jax.lax.cond(
        active & ~warm,
        lambda learner: _learn(course, now, learner, replay, learn_key),
        lambda learner: (learner, Losses(real(0.0), real(0.0), real(0.0))),
        state.learner,
    )

    ended = ~end.running
    fresh, redrawn = course.reset(reset_key)
    env_steps = state.env_steps + jnp.sum(steps).astype(state.env_steps.dtype)
    moved = TrainState(
        learner=learner,
        replay=replay,
        episode=select(ended, course.begin(redrawn, fresh), end),
        drawn=jnp.where(ended, redrawn, drawn),
        key=key,
        episodes=state.episodes + ended.astype(state.episodes.dtype),
        decisions=state.decisions + 1,
        env_steps=env_steps,
    )
    # Replay and learner are conditional where they change; selecting the rest is cheap.
    heavy = lambda s: (s.learner, s.replay)  # noqa: E731
    frozen = eqx.tree_at(heavy, state, (learner, replay))
    state = eqx.tree_at(
        heavy,
        jax.tree.map(
            lambda new, old: jnp.where(active, new, old),
            eqx.tree_at(heavy, moved, (None, None)),
            eqx.tree_at(heavy, frozen, (None, None)),
        ),
        (learner, replay),
        is_leaf=lambda leaf: leaf is None,
    )
    report = Report(
        ended=ended & active,
        outcome=end.outcome,
        tally=end.tally,
        evader_speed=course.speed(drawn, world),
        env_steps=env_steps,
        losses=losses,
        finite=~active | jnp.all(jnp.isfinite(command)),
    )
    return state, report


@eqx.filter_jit(donate="none")
def run_chunk(
    scenario: Scenario,
    shield: Any,
    pursuer: Any,
    options: TrainingOptions,
    state: TrainState,
    limit: Int[Array, ""],
    length: int,
    player: Player = EVADING,
    variation: Variation = FIXED,
) -> tuple[TrainState, Report]:
    """`length` decisions in one compiled loop; the report has a leading axis of `length`."""

    def body(state: TrainState, _: None) -> tuple[TrainState, Report]:
        return decide_and_learn(scenario, shield, pursuer, options, state, limit, player, variation)

    return jax.lax.scan(body, state, None, length=length)
