"""One episode: control periods until it ends, with a tally of them.

All loops of the package call `advance`: training, batch evaluation, recorded episodes, the falsifier's chases
and the environments of `bridges.gym`. They differ in the source of the nominal action, in the random keys and
in what they read of each period.
"""

from __future__ import annotations

import abc
from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from sidestep._arrays import AnyArray, Lanes, length, select
from sidestep.loop.step import RUNNING, control_step, decide, decision_steps_of, outcome_of
from sidestep.pursuit import without_answer
from sidestep.safety import ShieldResult, Status, start_in_lanes
from sidestep.world import Events, Scenario, World


class Task(eqx.Module):
    """What is run: a `policy` behind its `shield` against a `pursuer` in a `scenario`.

    `policy(observation) -> action in [-1, 1]^2` decides every `decision_steps` control periods; None if the
    caller chooses the nominal action. `pursuer(scenario, world, key) -> wheel speeds (2,)` in m/s.
    """

    scenario: Scenario
    policy: Callable[..., Any] | None
    shield: Any
    pursuer: Callable[..., Any]

    @property
    def decision_steps(self) -> int:
        """Control periods between two decisions of the policy. **Raises** as `decision_steps_of`."""
        return decision_steps_of(self.policy)


class EpisodePolicy(eqx.Module):
    """A policy that is asked with the task and the episode, not with an observation. So it knows what no
    robot knows, such as the pursuer's strategy, and it may keep a plan between decisions."""

    @abc.abstractmethod
    def init(self, world: World) -> Any:
        """The plan (a pytree) at the start of an episode in `world`, or in each of many worlds in lanes."""

    @abc.abstractmethod
    def __call__(self, task: Task, episode: Episode) -> Episode:
        """The episode with a new nominal velocity, and a new plan."""


class Tally(eqx.Module):
    """Sums over an episode so far.

    **Attributes:** the `distance` (m) from the start to the target; `total_reward`; `steps`, control periods;
    the least clearances (m); the number of periods in which the shield corrected the action
    (`interventions`), could not satisfy its rows (`infeasible`), got non-finite input (`invalid`), and in
    which a pursuer's wheel speeds were not finite (`pursuer_invalid`); the sum and the maximum of |action -
    nominal| (m/s).
    """

    distance: Lanes
    total_reward: Lanes
    steps: Int[Array, "*lanes"]
    pursuer_clearance: Lanes
    obstacle_clearance: Lanes
    interventions: Int[Array, "*lanes"]
    infeasible: Int[Array, "*lanes"]
    invalid: Int[Array, "*lanes"]
    pursuer_invalid: Int[Array, "*lanes"]
    correction: Lanes
    max_correction: Lanes

    @classmethod
    def zero(cls, world: World) -> Tally:
        """The tally before the first period, for one world or for many in lanes."""
        zero = jnp.zeros_like(world.time)
        count, far = jnp.zeros_like(world.time, jnp.int32), jnp.full_like(zero, jnp.inf)
        distance = length(world.target[0] - world.evader[0], world.target[1] - world.evader[1])
        return cls(distance, zero, count, far, far, count, count, count, count, zero, zero)

    def add(self, events: Events, result: ShieldResult, wheel_speeds: Float[Array, "m 2 *lanes"]) -> Tally:
        """The tally with one more period."""
        count = lambda flags: flags.astype(jnp.int32)  # noqa: E731
        return Tally(
            distance=self.distance,
            total_reward=self.total_reward + events.reward,
            steps=self.steps + 1,
            pursuer_clearance=jnp.minimum(self.pursuer_clearance, events.pursuer_clearance),
            obstacle_clearance=jnp.minimum(self.obstacle_clearance, events.obstacle_clearance),
            interventions=self.interventions + count(result.status != Status.OK),
            infeasible=self.infeasible + count(result.status == Status.INFEASIBLE),
            invalid=self.invalid + count(result.status == Status.INVALID),
            pursuer_invalid=self.pursuer_invalid + count(without_answer(wheel_speeds)),
            correction=self.correction + result.intervention,
            max_correction=jnp.maximum(self.max_correction, result.intervention),
        )


def straight_times(
    scenario: Scenario, distances: Float[np.ndarray, "n"], speeds: Float[np.ndarray, "n"] | None = None
) -> Float[np.ndarray, "n"]:
    """Times (s) straight to targets at these distances (m) at full speed, the scenario's or these (m/s).
    No policy can beat them."""
    full = np.asarray(scenario.evader_speed) if speeds is None else speeds
    return np.maximum(distances - np.asarray(scenario.reach_distance), 0.0) / full


class Episode(eqx.Module):
    """The state of an episode. Once it has ended, it does not change.

    **Attributes:** `world`; the shield's `memory`; the `nominal` velocity (m/s, world axes), held until the
    next decision; `outcome`, `RUNNING` or an index into `store.runs.OUTCOMES`; the `tally`; the `plan` of an
    `EpisodePolicy`, None with other policies.
    """

    world: World
    memory: Any
    nominal: Float[Array, "2 *lanes"]
    outcome: Int[Array, "*lanes"]
    tally: Tally
    plan: Any = None

    @property
    def running(self) -> Bool[Array, "*lanes"]:
        """Whether it has not ended."""
        return self.outcome == RUNNING


class Period(NamedTuple):
    """The data of one control period, for callers to read.

    `world` at its beginning and `after` at its end; `nominal` velocity (m/s); the `ShieldResult`; the
    pursuers' commanded `wheel_speeds (m, 2)` in m/s; the `Events`. Not valid where the episode was not
    `running` at its beginning.
    """

    world: World
    after: World
    nominal: Float[Array, "2 *lanes"]
    result: ShieldResult
    wheel_speeds: Float[Array, "m 2 *lanes"]
    events: Events
    running: Bool[Array, "*lanes"]


def begin(shield: Any, world: World, policy: Any = None) -> Episode:
    """Start an episode in `world`, or in each of many worlds in lanes; `policy` if it may keep a plan."""
    plan = policy.init(world) if isinstance(policy, EpisodePolicy) else None
    return continued(world, start_in_lanes(shield, world), plan)


def continued(world: World, memory: Any, plan: Any = None) -> Episode:
    """An episode from `world` on, with the shield's `memory`, an empty tally and a policy's `plan`."""
    return Episode(
        world=world,
        memory=memory,
        nominal=jnp.zeros_like(world.evader),
        outcome=jnp.full_like(world.time, RUNNING, jnp.int32),
        tally=Tally.zero(world),
        plan=plan,
    )


def hold(episode: Episode, nominal: Float[AnyArray, "2 *lanes"]) -> Episode:
    """The episode with a new nominal velocity (m/s, world axes)."""
    return eqx.tree_at(lambda episode: episode.nominal, episode, nominal)


def ask(task: Task, episode: Episode) -> Episode:
    """The episode with a new nominal velocity, from the policy."""
    assert task.policy is not None
    if isinstance(task.policy, EpisodePolicy):
        return task.policy(task, episode)
    return hold(episode, decide(task.scenario, task.policy, episode.world))


def ask_in_time(task: Task, episode: Episode, count: Int[Array, ""]) -> Episode:
    """`ask` if a decision is due after `count` control periods, for one episode or for all lanes."""
    due = count % task.decision_steps == 0
    return jax.lax.cond(due, lambda: ask(task, episode), lambda: episode)


def advance(task: Task, episode: Episode, key: Any) -> tuple[Episode, Period]:
    """Advance by one control period with the episode's nominal velocity.

    For one episode, or many in lanes (see `control_step`); then `key` has one entry per lane.
    """
    running = episode.running
    world, memory, events, result, wheel_speeds = control_step(
        task.scenario,
        task.shield,
        task.pursuer,
        episode.world.set_apart(~running),
        episode.memory,
        episode.nominal,
        key,
    )
    moved = Episode(
        world=world,
        memory=memory,
        nominal=episode.nominal,
        outcome=outcome_of(events),
        tally=episode.tally.add(events, result, wheel_speeds),
        plan=episode.plan,
    )
    period = Period(episode.world, world, episode.nominal, result, wheel_speeds, events, running)
    return select(running, moved, episode), period
