"""Run many episodes at once in lanes. A lane whose episode has ended begins the next one."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, fields
from typing import Any, final

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Int, PRNGKeyArray

from sidestep._arrays import Count, select
from sidestep.loop.episode import Episode, Period, Tally, Task, advance, ask, begin
from sidestep.loop.keys import episode_key, start_and_pursuit
from sidestep.loop.step import RUNNING
from sidestep.world import Scenario, World

_CHUNK_STEPS = 200
_LOOK_AHEAD_STEPS = 20
"""Control periods between two checks for ended episodes and for Ctrl-C; less for a shield that looks ahead,
which is slower."""
Read = Callable[[Any, Scenario, Period], Any]
"""A caller's fold over control periods: `read(kept, scenario, period)` returns the new `kept`."""


class Slots(eqx.Module):
    """Episodes in lanes, and the `number` of each; negative for an empty slot."""

    number: Int[Array, "batch"]
    episode: Episode


@eqx.filter_jit
def _starts(scenario: Scenario, key: PRNGKeyArray, numbers: Int[Array, "batch"]) -> World:
    """The start worlds of these episodes."""
    starts = jax.vmap(lambda number: scenario.reset(start_and_pursuit(episode_key(key, number))[0]))(numbers)
    return jax.tree.map(lambda leaf: jnp.moveaxis(leaf, 0, -1), starts)


@eqx.filter_jit
def _refill(task: Task, slots: Slots, numbers: Int[Array, "batch"], worlds: World) -> Slots:
    """Begin episode `numbers[i]` in slot i, unless that is negative."""
    return select(numbers >= 0, Slots(numbers, begin(task.shield, worlds, task.policy)), slots)


def _empty_slots(task: Task, worlds: World, size: int) -> Slots:
    """Empty slots."""
    shapes = eqx.filter_eval_shape(begin, task.shield, worlds, task.policy)
    empty = jax.tree.map(lambda leaf: jnp.zeros(leaf.shape, leaf.dtype), shapes)
    return Slots(jnp.zeros(size, jnp.int32), empty)


@eqx.filter_jit
def _advance(
    task: Task, key: PRNGKeyArray, slots: Slots, decisions: Count, kept: Any, read: Read | None
) -> tuple[Slots, Any]:
    """Advance every running episode by up to `decisions` decisions; stops early when none is running."""

    def period_key(number: Array, steps: Array) -> PRNGKeyArray:
        return jax.random.fold_in(start_and_pursuit(episode_key(key, number))[1], steps)

    def period(carry: tuple[Episode, Any], _: None) -> tuple[tuple[Episode, Any], None]:
        episode, kept = carry
        episode, period = advance(task, episode, jax.vmap(period_key)(slots.number, episode.tally.steps))
        return (episode, kept if read is None else read(kept, task.scenario, period)), None

    def more(carry: tuple[Count, Episode, Any]) -> Array:
        return (carry[0] < decisions) & jnp.any(carry[1].running)

    def decision(carry: tuple[Count, Episode, Any]) -> tuple[Count, Episode, Any]:
        count, episode, kept = carry
        held, _ = jax.lax.scan(period, (ask(task, episode), kept), None, length=task.decision_steps)
        return count + 1, *held

    begun = (jnp.zeros((), jnp.int32), slots.episode, kept)
    _, episode, kept = jax.lax.while_loop(more, decision, begun)
    return Slots(slots.number, episode), kept


@dataclass(frozen=True)
class Trial:
    """What all episodes of an evaluation share. Each `EpisodeBatch` runs `width` of them at once.

    With `read`, each batch folds it over its control periods, beginning with `kept`; see `Read`.
    """

    task: Task
    key: PRNGKeyArray
    width: int
    kept: Any = None
    read: Read | None = None


@final
class EpisodeBatch:
    """The episodes `begin` to `end` of a trial, `trial.width` at once, in order of their numbers.

    The width does not depend on the number of episodes, and free slots are refilled: each width compiles
    separately, which takes longer than ten thousand episodes.

    **Attributes:** `results` per episode: `outcome` and the fields of `Tally` by name; `sums`, the result of
    `trial.read`, 0 without.
    """

    def __init__(self, trial: Trial, begin: int, end: int):
        self._trial, self._begin, self._end = trial, begin, end
        self._next = begin
        self._numbers = np.full(trial.width, RUNNING, np.int32)
        self._slots: Slots | None = None
        self.results: dict[str, np.ndarray] = {}
        self.sums: Any = 0.0

    def get_ready(self) -> None:
        """Compile, and begin the first episodes."""
        self._refill()
        self._run(0)

    def __iter__(self) -> Iterator[int]:
        """Run all episodes; yields the number of episodes ended since the last yield."""
        task = self._trial.task
        looks_ahead = getattr(task.shield, "looks_ahead", False)
        steps = _LOOK_AHEAD_STEPS if looks_ahead else _CHUNK_STEPS
        while self._next < self._end or np.any(self._numbers >= 0):
            self._refill()
            yield self._run(max(1, steps // task.decision_steps))

    def _refill(self) -> None:
        trial = self._trial
        free = np.flatnonzero(self._numbers < 0)[: self._end - self._next]
        if not len(free):
            return
        fresh = np.full(trial.width, RUNNING, np.int32)
        fresh[free] = np.arange(self._next, self._next + len(free))
        worlds = _starts(trial.task.scenario, trial.key, jnp.asarray(np.maximum(fresh, 0)))
        slots = self._slots or _empty_slots(trial.task, worlds, trial.width)
        self._slots = _refill(trial.task, slots, jnp.asarray(fresh), worlds)
        self._numbers[free] = fresh[free]
        self._next += len(free)

    def _run(self, decisions: int) -> int:
        assert self._slots is not None
        trial, count = self._trial, jnp.asarray(decisions, jnp.int32)
        self._slots, sums = _advance(trial.task, trial.key, self._slots, count, trial.kept, trial.read)
        if trial.read is not None:
            # float32 suffices for one chunk, but not for a long trial.
            self.sums = self.sums + np.asarray(sums, np.float64)
        episode = self._slots.episode
        ended = np.flatnonzero(~np.asarray(episode.running) & (self._numbers >= 0))
        collected = {field.name: getattr(episode.tally, field.name) for field in fields(Tally)}
        for name, values in {"outcome": episode.outcome, **collected}.items():
            self._keep(name, np.asarray(values)[ended], self._numbers[ended])
        self._numbers[ended] = RUNNING
        return len(ended)

    def _keep(self, name: str, values: np.ndarray, numbers: np.ndarray) -> None:
        """Keep results of these episodes."""
        whole = self.results.setdefault(name, np.zeros(self._end - self._begin, values.dtype))
        whole[numbers - self._begin] = values
