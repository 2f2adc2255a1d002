"""The training loop on the device, under one `lax.scan`: act, filter, move, store, update."""

from __future__ import annotations

from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int, Key, PRNGKeyArray

from sidestep._arrays import Count, Lanes, real, select
from sidestep.learning.bounds import on_disc, through_shield
from sidestep.learning.networks import Actor
from sidestep.learning.options import TrainingOptions
from sidestep.learning.replay import Replay, Transition, sample
from sidestep.learning.td3 import Learner, Losses, update
from sidestep.loop.episode import Episode, Tally, Task, advance, begin, hold
from sidestep.loop.step import CAPTURED, COLLIDED, nominal_velocity
from sidestep.world import Scenario, World, observation_size, observe


class TrainState(eqx.Module):
    """The complete state of a training: a training restored from it continues bitwise equal.

    **Attributes:** the `episode` that runs, or one in each of many worlds in lanes; `episodes`, how many have
    ended in each world; `decisions` of each world; `env_steps`, control periods of all worlds.
    """

    learner: Learner
    replay: Replay
    episode: Episode
    key: PRNGKeyArray
    episodes: Int[Array, "*lanes"]
    decisions: Count
    env_steps: Count

    @property
    def ended(self) -> Count:
        """How many episodes have ended."""
        return jnp.sum(self.episodes)


class Report(eqx.Module):
    """The host's data of one decision: the tally, which is the episode's total when `ended`; whether the
    proposed actions were `finite`. After axes of decisions, arrays have one of worlds if there are many."""

    ended: Bool[Array, "..."]
    outcome: Int[Array, "..."]
    tally: Tally
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


def _reset(scenario: Scenario, worlds: int, key: PRNGKeyArray) -> World:
    """A start, or many in lanes."""
    if worlds == 1:
        return scenario.reset(key)
    starts = jax.vmap(scenario.reset)(jax.random.split(key, worlds))
    return jax.tree.map(lambda leaf: jnp.moveaxis(leaf, 0, -1), starts)


def _proposed(actor: Actor, observation: Float[Array, "observation *lanes"]) -> Float[Array, "2 *lanes"]:
    return actor(observation[None])[0] if observation.ndim == 1 else actor(observation.T).T


@eqx.filter_jit
def start(
    scenario: Scenario, shield: Any, options: TrainingOptions, key: PRNGKeyArray, capacity: int
) -> TrainState:
    """The state before the first decision.

    Its dtypes equal those that `run_chunk` returns. A weakly typed count, for example, would make the second
    chunk recompile.
    """
    net_key, reset_key, key = jax.random.split(key, 3)
    world = _reset(scenario, options.worlds, reset_key)
    one = jax.tree.map(lambda leaf: leaf[..., 0], world) if world.lanes else world
    example = Transition(
        world=one,
        next_world=one,
        path=jnp.zeros((options.decision_steps + 1, 2), world.evader.dtype),
        steps=jnp.zeros((), int),
        proposed=jnp.zeros_like(one.evader),
        executed=jnp.zeros_like(one.evader),
        correction=real(0.0),
        lost=jnp.asarray(False),
    )
    return TrainState(
        learner=options.algorithm.init(observation_size(scenario), 2, net_key),
        replay=Replay.init(example, capacity, options.worlds),
        episode=begin(shield, world),
        key=key,
        episodes=jnp.zeros_like(world.time, int),
        decisions=jnp.zeros((), int),
        env_steps=jnp.zeros((), int),
    )


def _drive(
    task: Task,
    options: TrainingOptions,
    episode: Episode,
    nominal: Float[Array, "2 *lanes"],
    key: PRNGKeyArray,
) -> _Drive:
    """Hold the nominal velocity for a decision, or until the episode ends."""

    def period(carry: tuple[Episode, Array, Array], key: Key[Array, "*lanes"]) -> tuple[Any, Array]:
        episode, *sums = carry
        episode, period = advance(task, episode, key)
        result = period.result
        more = [total + one for total, one in zip(sums, (result.action, result.intervention), strict=True)]
        return (episode, *select(period.running, more, sums)), episode.world.evader

    begun = (hold(episode, nominal), jnp.zeros_like(nominal), jnp.zeros_like(nominal[0]))
    keys = jax.random.split(key, (options.decision_steps, *nominal.shape[1:]))
    (end, executed, correction), places = jax.lax.scan(period, begun, keys)
    return _Drive(end, executed, correction, jnp.concatenate([episode.world.evader[None], places]))


def _learn(
    scenario: Scenario,
    shield: Any,
    options: TrainingOptions,
    learner: Learner,
    replay: Replay,
    key: PRNGKeyArray,
) -> tuple[Learner, Losses]:
    def one(learner: Learner, key: PRNGKeyArray) -> tuple[Learner, Losses]:
        sample_key, update_key = jax.random.split(key)
        batch, world, next_world = sample(
            scenario,
            replay,
            sample_key,
            options.batch_size,
            hindsight=options.hindsight,
            mirror=options.mirror,
            executed_action=options.replay_action == "executed",
            correction_penalty=options.correction_penalty,
            time_cost=options.time_cost,
            reward_scale=options.reward_scale,
        )
        executed = options.replay_action == "executed"
        target_bound = through_shield(scenario, shield, next_world) if executed else on_disc
        bound = through_shield(scenario, shield, world) if options.filter_gradients else on_disc
        best = options.reward_scale * scenario.reach_reward if options.bound_values else None
        return update(options.algorithm, learner, batch, update_key, bound, target_bound, best)

    learner, losses = jax.lax.scan(one, learner, jax.random.split(key, options.updates_per_decision))
    return learner, jax.tree.map(lambda loss: loss[-1], losses)


def decide_and_learn(
    scenario: Scenario, shield: Any, pursuer: Any, options: TrainingOptions, state: TrainState, limit: Count
) -> tuple[TrainState, Report]:
    """One decision of the policy in every world, its control periods, and the updates that follow it.

    After `limit` episodes the state does not change, so a training stops exactly at the end of an episode; of
    many worlds, others may end one in the same decision.
    """
    active = state.ended < limit
    world, task = state.episode.world, Task(scenario, None, shield, pursuer)
    key, noise_key, random_key, drive_key, learn_key, reset_key = jax.random.split(state.key, 6)

    wanted = _proposed(state.learner.actor, observe(scenario, world))
    noise = options.exploration_noise * jax.random.normal(noise_key, wanted.shape, dtype=float)
    explored = jnp.clip(wanted + noise, -1.0, 1.0)
    anything = jax.random.uniform(random_key, wanted.shape, dtype=float, minval=-1.0, maxval=1.0)
    warm = state.decisions * options.worlds < options.warmup_decisions
    # A learner that another training has begun does not start with random actions.
    begun = state.learner.updates > 0
    nominal = nominal_velocity(scenario, world, jnp.where(warm & ~begun, anything, explored))

    drive = _drive(task, options, state.episode, nominal, drive_key)
    end, steps = drive.end, drive.end.tally.steps - state.episode.tally.steps
    periods = steps.astype(nominal.dtype)
    replay = state.replay.add(
        Transition(
            world=world,
            next_world=end.world,
            path=drive.path,
            steps=steps.astype(int),
            proposed=nominal,
            executed=drive.executed / periods,
            correction=drive.correction / periods,
            lost=(end.outcome == CAPTURED) | (end.outcome == COLLIDED),
        ),
        state.episodes,
        active,
    )
    now = options.after(state.ended, limit)
    learner, losses = jax.lax.cond(
        active & ~warm,
        lambda learner: _learn(scenario, shield, now, learner, replay, learn_key),
        lambda learner: (learner, Losses(real(0.0), real(0.0), real(0.0))),
        state.learner,
    )

    ended = ~end.running
    episode = select(ended, begin(shield, _reset(scenario, options.worlds, reset_key)), end)
    env_steps = state.env_steps + jnp.sum(steps).astype(state.env_steps.dtype)
    moved = TrainState(
        learner=learner,
        replay=replay,
        episode=episode,
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
        env_steps=env_steps,
        losses=losses,
        finite=~active | jnp.all(jnp.isfinite(nominal)),
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
) -> tuple[TrainState, Report]:
    """`length` decisions in one compiled loop; the report has a leading axis of `length`."""

    def body(state: TrainState, _: None) -> tuple[TrainState, Report]:
        return decide_and_learn(scenario, shield, pursuer, options, state, limit)

    return jax.lax.scan(body, state, None, length=length)
