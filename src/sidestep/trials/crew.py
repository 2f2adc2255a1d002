"""Episodes on their way, many at once in lanes: begun, advanced, and written down when they end."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any, final

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int, PRNGKeyArray

from sidestep._arrays import Count, select
from sidestep.loop.keys import episode_key, start_and_pursuit
from sidestep.loop.step import RUNNING, control_step, decide, decision_steps_of, outcome_of
from sidestep.pursuit import without_answer
from sidestep.safety import Status, start_in_lanes
from sidestep.trials.intervention_map import add_periods, no_periods
from sidestep.world import Scenario, World

_CHUNK_STEPS = 200
_THOUGHTFUL_STEPS = 20
"""Periods between two looks at what has ended, and at Ctrl-C; behind a shield that thinks ahead a tenth."""
Sums = Array | None

COLLECTED = (
    "outcome",
    "total_reward",
    "steps",
    "pursuer_clearance",
    "obstacle_clearance",
    "interventions",
    "infeasible",
    "invalid",
    "pursuer_invalid",
    "correction",
    "max_correction",
)
"""What is written down of every episode."""


class Episode(eqx.Module):
    """Episodes on their way, in lanes: where each is, what it has come to. `outcome` is -1 while it runs."""

    number: Int[Array, "batch"]
    outcome: Int[Array, "batch"]
    world: World
    memory: Any
    steps: Int[Array, "batch"]
    total_reward: Float[Array, "batch"]
    pursuer_clearance: Float[Array, "batch"]
    obstacle_clearance: Float[Array, "batch"]
    interventions: Int[Array, "batch"]
    infeasible: Int[Array, "batch"]
    invalid: Int[Array, "batch"]
    pursuer_invalid: Int[Array, "batch"]
    correction: Float[Array, "batch"]
    max_correction: Float[Array, "batch"]


@eqx.filter_jit
def _starts(scenario: Scenario, key: PRNGKeyArray, numbers: Int[Array, "batch"]) -> World:
    """The worlds in which these episodes start."""
    starts = jax.vmap(lambda number: scenario.reset(start_and_pursuit(episode_key(key, number))[0]))(numbers)
    return jax.tree.map(lambda leaf: jnp.moveaxis(leaf, 0, -1), starts)


def _begin(shield: Any, numbers: Int[Array, "batch"], worlds: World) -> Episode:
    none, zero = jnp.zeros_like(numbers), jnp.zeros_like(worlds.time)
    far = jnp.full_like(zero, jnp.inf)
    return Episode(
        number=numbers,
        outcome=jnp.full_like(numbers, RUNNING),
        world=worlds,
        memory=start_in_lanes(shield, worlds),
        steps=none,
        total_reward=zero,
        pursuer_clearance=far,
        obstacle_clearance=far,
        interventions=none,
        infeasible=none,
        invalid=none,
        pursuer_invalid=none,
        correction=zero,
        max_correction=zero,
    )


@eqx.filter_jit
def _refill(shield: Any, slots: Episode, numbers: Int[Array, "batch"], worlds: World) -> Episode:
    """Slot i becomes episode `numbers[i]` at its start, unless that is negative."""
    return select(numbers >= 0, _begin(shield, numbers, worlds), slots)


def _empty_slots(shield: Any, worlds: World, size: int) -> Episode:
    """Slots in which nothing runs."""
    numbers = jnp.full(size, RUNNING, jnp.int32)
    shapes = eqx.filter_eval_shape(_begin, shield, numbers, worlds)
    return jax.tree.map(lambda leaf: jnp.zeros(leaf.shape, leaf.dtype), shapes)


@eqx.filter_jit
def _advance(
    scenario: Scenario,
    policy: Callable[..., Any],
    shield: Any,
    pursuer: Callable[..., Any],
    key: PRNGKeyArray,
    episodes: Episode,
    decisions: Count,
    sums: Sums,
) -> tuple[Episode, Sums]:
    """Every running episode by up to `decisions` decisions; stops early when none is running.

    `sums` of the intervention map are added to, if there are any.
    """

    def period_key(number: Array, steps: Array) -> PRNGKeyArray:
        return jax.random.fold_in(start_and_pursuit(episode_key(key, number))[1], steps)

    def period(episode: Episode, sums: Sums, nominal: Array) -> tuple[Episode, Sums]:
        keys = jax.vmap(period_key)(episode.number, episode.steps)
        running = episode.outcome == RUNNING
        world, memory, events, result, wheels = control_step(
            scenario, shield, pursuer, episode.world.set_apart(~running), episode.memory, nominal, keys
        )
        if sums is not None:
            sums = add_periods(sums, scenario, episode.world, nominal, result, running)
        moved = Episode(
            number=episode.number,
            outcome=outcome_of(events),
            world=world,
            memory=memory,
            steps=episode.steps + 1,
            total_reward=episode.total_reward + events.reward,
            pursuer_clearance=jnp.minimum(episode.pursuer_clearance, events.pursuer_clearance),
            obstacle_clearance=jnp.minimum(episode.obstacle_clearance, events.obstacle_clearance),
            interventions=episode.interventions + (result.status != Status.OK).astype(jnp.int32),
            infeasible=episode.infeasible + (result.status == Status.INFEASIBLE).astype(jnp.int32),
            invalid=episode.invalid + (result.status == Status.INVALID).astype(jnp.int32),
            pursuer_invalid=episode.pursuer_invalid + without_answer(wheels).astype(jnp.int32),
            correction=episode.correction + result.intervention,
            max_correction=jnp.maximum(episode.max_correction, result.intervention),
        )
        return select(running, moved, episode), sums

    def decision(episode: Episode, sums: Sums) -> tuple[Episode, Sums]:
        nominal = decide(scenario, policy, episode.world)
        hold = lambda carry, _: (period(carry[0], carry[1], nominal), None)  # noqa: E731
        return jax.lax.scan(hold, (episode, sums), None, length=decision_steps_of(policy))[0]

    def more(carry: tuple[Count, Episode, Sums]) -> Array:
        return (carry[0] < decisions) & jnp.any(carry[1].outcome == RUNNING)

    def advance(carry: tuple[Count, Episode, Sums]) -> tuple[Count, Episode, Sums]:
        return carry[0] + 1, *decision(*carry[1:])

    _, episodes, sums = jax.lax.while_loop(more, advance, (jnp.zeros((), jnp.int32), episodes, sums))
    return episodes, sums


@dataclass(frozen=True)
class Trial:
    """What all episodes of an evaluation have in common: `width` of them run at once, in each crew."""

    scenario: Scenario
    policy: Callable[..., Any]
    shield: Any
    pursuer: Callable[..., Any]
    key: PRNGKeyArray
    width: int
    mapped: bool


@final
class Crew:
    """The episodes `begin` to `end` of a trial, `trial.width` at once, in the order of their numbers.

    There is one width for any number of episodes, slots being refilled as they fall free: each width would
    compile anew, which takes longer than ten thousand episodes.

    **Attributes:** `results` by the names of `COLLECTED`; `sums` of the intervention map, 0 without one.
    """

    def __init__(self, trial: Trial, begin: int, end: int):
        self._trial, self._begin, self._end = trial, begin, end
        self._next = begin
        self._numbers = np.full(trial.width, RUNNING, np.int32)
        self._slots: Episode | None = None
        self.results: dict[str, np.ndarray] = {}
        self.sums: Any = 0.0

    def get_ready(self) -> None:
        """Compile all that it takes, and begin the first episodes."""
        self._refill()
        self._go_on(0)

    def __iter__(self) -> Iterator[int]:
        """Run everything; yields now and then how many more episodes have ended."""
        thoughtful = getattr(self._trial.shield, "looks_ahead", False)
        steps = _THOUGHTFUL_STEPS if thoughtful else _CHUNK_STEPS
        while self._next < self._end or np.any(self._numbers >= 0):
            self._refill()
            yield self._go_on(max(1, steps // decision_steps_of(self._trial.policy)))

    def _refill(self) -> None:
        trial = self._trial
        free = np.flatnonzero(self._numbers < 0)[: self._end - self._next]
        if not len(free):
            return
        fresh = np.full(trial.width, RUNNING, np.int32)
        fresh[free] = np.arange(self._next, self._next + len(free))
        worlds = _starts(trial.scenario, trial.key, jnp.asarray(np.maximum(fresh, 0)))
        slots = self._slots or _empty_slots(trial.shield, worlds, trial.width)
        self._slots = _refill(trial.shield, slots, jnp.asarray(fresh), worlds)
        self._numbers[free] = fresh[free]
        self._next += len(free)

    def _go_on(self, decisions: int) -> int:
        assert self._slots is not None
        trial, count = self._trial, jnp.asarray(decisions, jnp.int32)
        sums = no_periods() if trial.mapped else None
        self._slots, sums = _advance(
            trial.scenario, trial.policy, trial.shield, trial.pursuer, trial.key, self._slots, count, sums
        )
        if sums is not None:
            # Single precision is enough for one chunk, not for a long trial.
            self.sums = self.sums + np.asarray(sums, np.float64)
        ended = np.flatnonzero((np.asarray(self._slots.outcome) != RUNNING) & (self._numbers >= 0))
        for name in COLLECTED:
            values = np.asarray(getattr(self._slots, name))
            whole = self.results.setdefault(name, np.zeros(self._end - self._begin, values.dtype))
            whole[self._numbers[ended] - self._begin] = values[ended]
        self._numbers[ended] = RUNNING
        return len(ended)
