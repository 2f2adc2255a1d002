"""Batched Monte Carlo: many episodes of any policy, shield and pursuer at once."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int, PRNGKeyArray

from sidestep._arrays import Count, select
from sidestep.learning.control_step import RUNNING, control_step, decide, decision_steps_of, outcome_of
from sidestep.pursuit import as_pursuer
from sidestep.safety import Shield, Status, as_shield, start_in_lanes
from sidestep.trials.evaluation import Evaluation
from sidestep.trials.intervention_map import InterventionMap, add_periods, map_reach, no_periods
from sidestep.trials.keys import as_key, episode_key, start_and_pursuit
from sidestep.trials.policies import as_policy
from sidestep.world import Scenario, World

_CHUNK_STEPS = 200
Sums = Array | None


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
        world, memory, events, result, _ = control_step(
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


def _positive(name: str, value: Any) -> int:
    if isinstance(value, bool) or not isinstance(value, (int, np.integer)) or value < 1:
        raise ValueError(f"{name} = {value!r}: it must be a whole number of at least 1")
    return int(value)


def evaluate(
    scenario: Scenario,
    policy: str | Callable[..., Any],
    shield: str | Shield,
    pursuer: str | Callable[..., Any],
    episodes: int,
    key: PRNGKeyArray | int,
    *,
    batch: int = 256,
    progress: Callable[[int, int], None] | None = None,
    mapped: bool = False,
) -> Evaluation:
    """Run `episodes` independent episodes to their ends and report what happened.

    Episode i draws all its random numbers from `fold_in(key, i)`: neither `batch` nor the number of
    episodes changes them (rounding may differ in the last digit between batch sizes).

    **Arguments:**

    - `policy` any `(observation) -> action in [-1, 1]^2`, in JAX or not, or `"goal-seeking"`; asked every
      `policy.decision_steps` control periods (1 if it has none)
    - `shield` a name or a `Shield`; `pursuer` a name, a `Pursuer` or a callable
      `(scenario, world, key) -> wheel speeds (2,)`
    - `key` a random key or a seed
    - `batch` episodes that run at once; `progress(finished, episodes)` is called between chunks
    - `mapped` whether to sum up where the shield stepped in, as `Evaluation.map`

    **Raises** `ValueError` for a number that is not positive, for an unknown name and for an answer of the
    wrong shape. An action that is not finite is passed on to the shield and counted as `invalid`.
    """
    episodes, batch = _positive("episodes", episodes), _positive("batch", batch)
    key = as_key(key)
    policy = as_policy(policy, scenario)
    shield = as_shield(shield, scenario)
    pursuer = as_pursuer(pursuer)
    decisions = jnp.asarray(max(1, _CHUNK_STEPS // decision_steps_of(policy)), jnp.int32)

    # One width for every number of episodes, slots refilled as they fall free: each width would compile
    # anew, which takes longer than ten thousand episodes.
    numbers = np.full(batch, RUNNING, np.int32)
    slots: Episode | None = None
    results: dict[str, np.ndarray] = {}
    whole: Any = 0.0
    begun = finished = 0
    while finished < episodes:
        free = np.flatnonzero(numbers < 0)[: episodes - begun]
        if len(free):
            fresh = np.full(batch, RUNNING, np.int32)
            fresh[free] = np.arange(begun, begun + len(free))
            worlds = _starts(scenario, key, jnp.asarray(np.maximum(fresh, 0)))
            slots = _refill(shield, slots or _empty_slots(shield, worlds, batch), jnp.asarray(fresh), worlds)
            numbers[free] = fresh[free]
            begun += len(free)
        assert slots is not None
        sums = no_periods() if mapped else None
        slots, sums = _advance(scenario, policy, shield, pursuer, key, slots, decisions, sums)
        if sums is not None:
            # Single precision is enough for one chunk, not for a long trial.
            whole = whole + np.asarray(sums, np.float64)
        ended = np.flatnonzero((np.asarray(slots.outcome) != RUNNING) & (numbers >= 0))
        _collect(results, slots, ended, numbers[ended], episodes)
        numbers[ended] = RUNNING
        finished += len(ended)
        if progress is not None:
            progress(finished, episodes)
    where = InterventionMap.of_sums(float(map_reach(scenario)), whole) if mapped else None
    return _evaluation(scenario, results, where)


_COLLECTED = (
    "outcome",
    "total_reward",
    "steps",
    "pursuer_clearance",
    "obstacle_clearance",
    "interventions",
    "infeasible",
    "invalid",
    "correction",
    "max_correction",
)


def _collect(
    results: dict[str, np.ndarray], slots: Episode, ended: np.ndarray, numbers: np.ndarray, episodes: int
) -> None:
    for name in _COLLECTED:
        values = np.asarray(getattr(slots, name))
        results.setdefault(name, np.zeros(episodes, values.dtype))[numbers] = values[ended]


def _evaluation(
    scenario: Scenario, results: dict[str, np.ndarray], where: InterventionMap | None
) -> Evaluation:
    steps = results["steps"]
    return Evaluation(
        outcome=results["outcome"],
        returns=results["total_reward"],
        steps=steps,
        times=steps * np.asarray(scenario.control_period, dtype=float),
        min_pursuer_clearance=results["pursuer_clearance"],
        min_obstacle_clearance=results["obstacle_clearance"],
        interventions=results["interventions"],
        infeasible=results["infeasible"],
        invalid=results["invalid"],
        mean_correction=results["correction"] / steps,
        max_correction=results["max_correction"],
        map=where,
    )
