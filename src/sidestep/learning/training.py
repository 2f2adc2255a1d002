"""The training loop: act, shield, move, store, update, all on the device under one `lax.scan`."""

from __future__ import annotations

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int, PRNGKeyArray

from sidestep._arrays import Count, Flag, Scalar, real
from sidestep.learning.bounds import on_disc, through_shield
from sidestep.learning.options import TrainingOptions
from sidestep.learning.replay import Replay, Transition, sample
from sidestep.learning.td3 import Learner, Losses, update
from sidestep.loop.step import RUNNING, control_step, nominal_velocity, outcome_of
from sidestep.pursuit import without_answer
from sidestep.safety.filter.status import Status
from sidestep.world import Scenario, World, observation_size, observe


class Tally(eqx.Module):
    """What one episode has come to so far. Clearances in m, correction in m/s summed over periods; periods
    that the shield corrected, those of them with rows that could not hold, and with input not finite, and
    periods in which a pursuer's wheel speeds were not finite."""

    total_reward: Scalar
    steps: Count
    pursuer_clearance: Scalar
    obstacle_clearance: Scalar
    interventions: Count
    infeasible: Count
    invalid: Count
    pursuer_invalid: Count
    correction: Scalar

    @classmethod
    def init(cls) -> Tally:
        zero, count, far = real(0.0), jnp.zeros((), int), real(jnp.inf)
        return cls(zero, count, far, far, count, count, count, count, zero)


class TrainState(eqx.Module):
    """Everything a training is: save it and the training goes on bit for bit."""

    learner: Learner
    replay: Replay
    world: World
    memory: Any
    tally: Tally
    key: PRNGKeyArray
    episodes: Count
    decisions: Count
    env_steps: Count


class Report(eqx.Module):
    """What one decision reports to the host: the tally, which is an episode's when `ended`; whether the
    action asked for was `finite`."""

    ended: Bool[Array, "..."]
    outcome: Int[Array, "..."]
    tally: Tally
    env_steps: Int[Array, "..."]
    losses: Losses
    finite: Bool[Array, "..."]


class _Drive(eqx.Module):
    """Carry of the control periods within one decision."""

    world: World
    memory: Any
    tally: Tally
    alive: Flag
    lost: Flag
    outcome: Count
    steps: Count
    executed: Float[Array, "2"]
    correction: Scalar


@eqx.filter_jit
def start(
    scenario: Scenario, shield: Any, options: TrainingOptions, key: PRNGKeyArray, capacity: int
) -> TrainState:
    """The state before the first decision.

    Its types are exactly those that `run_chunk` returns: a weakly typed count, say, would make the second
    chunk compile anew.
    """
    net_key, reset_key, key = jax.random.split(key, 3)
    world = scenario.reset(reset_key)
    example = Transition(
        world=world,
        next_world=world,
        path=jnp.zeros((options.decision_steps + 1, 2), world.evader.dtype),
        steps=jnp.zeros((), int),
        proposed=jnp.zeros_like(world.evader),
        executed=jnp.zeros_like(world.evader),
        correction=real(0.0),
        lost=jnp.asarray(False),
    )
    return TrainState(
        learner=options.algorithm.init(observation_size(scenario), 2, net_key),
        replay=Replay.init(example, capacity),
        world=world,
        memory=shield.init(world),
        tally=Tally.init(),
        key=key,
        episodes=jnp.zeros((), int),
        decisions=jnp.zeros((), int),
        env_steps=jnp.zeros((), int),
    )


def _drive(
    scenario: Scenario,
    shield: Any,
    pursuer: Any,
    options: TrainingOptions,
    state: TrainState,
    nominal: Float[Array, "2"],
    key: PRNGKeyArray,
) -> tuple[_Drive, Float[Array, "knots 2"]]:
    """Hold the nominal velocity for a decision; nothing moves any more once the episode has ended."""

    def period(carry: _Drive, key: PRNGKeyArray) -> tuple[_Drive, Float[Array, "2"]]:
        world, memory, events, result, wheels = control_step(
            scenario, shield, pursuer, carry.world.set_apart(~carry.alive), carry.memory, nominal, key
        )
        tally = carry.tally
        moved = _Drive(
            world=world,
            memory=memory,
            tally=Tally(
                total_reward=tally.total_reward + events.reward,
                steps=tally.steps + 1,
                pursuer_clearance=jnp.minimum(tally.pursuer_clearance, events.pursuer_clearance),
                obstacle_clearance=jnp.minimum(tally.obstacle_clearance, events.obstacle_clearance),
                interventions=tally.interventions + (result.status != Status.OK).astype(tally.steps.dtype),
                infeasible=tally.infeasible + (result.status == Status.INFEASIBLE).astype(tally.steps.dtype),
                invalid=tally.invalid + (result.status == Status.INVALID).astype(tally.steps.dtype),
                pursuer_invalid=tally.pursuer_invalid + without_answer(wheels).astype(tally.steps.dtype),
                correction=tally.correction + result.intervention,
            ),
            alive=~(events.terminated | events.truncated),
            lost=events.captured | events.collided,
            outcome=outcome_of(events),
            steps=carry.steps + 1,
            executed=carry.executed + result.action,
            correction=carry.correction + result.intervention,
        )
        carry = jax.tree.map(lambda new, old: jnp.where(carry.alive, new, old), moved, carry)
        return carry, carry.world.evader

    begin = _Drive(
        world=state.world,
        memory=state.memory,
        tally=state.tally,
        alive=jnp.asarray(True),
        lost=jnp.asarray(False),
        outcome=jnp.asarray(RUNNING, jnp.int32),
        steps=jnp.asarray(0),
        executed=jnp.zeros_like(nominal),
        correction=real(0.0),
    )
    end, places = jax.lax.scan(period, begin, jax.random.split(key, options.decision_steps))
    return end, jnp.concatenate([state.world.evader[None], places])


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
    """One decision of the policy, its control periods, and the updates that follow it.

    Once `limit` episodes have ended nothing changes any more, so a training stops exactly at the end of
    an episode wherever its chunks end.
    """
    active = state.episodes < limit
    key, noise_key, random_key, drive_key, learn_key, reset_key = jax.random.split(state.key, 6)

    wanted = state.learner.actor(observe(scenario, state.world)[None])[0]
    noise = options.exploration_noise * jax.random.normal(noise_key, (2,), dtype=float)
    explored = jnp.clip(wanted + noise, -1.0, 1.0)
    anything = jax.random.uniform(random_key, (2,), dtype=float, minval=-1.0, maxval=1.0)
    warm = state.decisions < options.warmup_decisions
    nominal = nominal_velocity(scenario, state.world, jnp.where(warm, anything, explored))

    end, path = _drive(scenario, shield, pursuer, options, state, nominal, drive_key)
    periods = end.steps.astype(nominal.dtype)
    replay = state.replay.add(
        Transition(
            world=state.world,
            next_world=end.world,
            path=path,
            steps=end.steps,
            proposed=nominal,
            executed=end.executed / periods,
            correction=end.correction / periods,
            lost=end.lost,
        ),
        state.episodes,
        active,
    )
    learner, losses = jax.lax.cond(
        active & ~warm,
        lambda learner: _learn(scenario, shield, options, learner, replay, learn_key),
        lambda learner: (learner, Losses(real(0.0), real(0.0), real(0.0))),
        state.learner,
    )

    ended = ~end.alive
    fresh = scenario.reset(reset_key)
    begun = (fresh, shield.init(fresh), Tally.init())
    world, memory, tally = jax.tree.map(
        lambda new, old: jnp.where(ended, new, old), begun, (end.world, end.memory, end.tally)
    )
    env_steps = state.env_steps + end.steps
    moved = TrainState(
        learner=learner,
        replay=replay,
        world=world,
        memory=memory,
        tally=tally,
        key=key,
        episodes=state.episodes + ended.astype(state.episodes.dtype),
        decisions=state.decisions + 1,
        env_steps=env_steps,
    )
    # Replay and learner were gated where they change; selecting the rest costs nothing.
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
