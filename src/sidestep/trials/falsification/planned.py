"""Planning attacks: wheel speeds and starts found by the cross-entropy method, with the shield in the
loop."""

from __future__ import annotations

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PRNGKeyArray

from sidestep._arrays import Count, select
from sidestep.trials.falsification.attackers import script
from sidestep.trials.falsification.chases import Chase, Target, begin, forget, run, shortfall
from sidestep.trials.falsification.cross_entropy import Optimum, Search, minimise
from sidestep.trials.falsification.starts import admissible, decode, encode
from sidestep.world import World


class Planning(eqx.Module):
    """Options of a planning attack, in control periods.

    Wheel speeds are held for `hold`; a plan spans `horizon`, of which `execute` are driven before the next
    plan; a start is searched together with a first plan of `opening`.
    """

    search: Search
    start_search: Search
    hold: int = eqx.field(static=True)
    horizon: int = eqx.field(static=True)
    execute: int = eqx.field(static=True)
    opening: int = eqx.field(static=True)


def _drive(target: Target, planning: Planning, knots: Array, periods: int) -> Float[Array, "n t m 2"]:
    """Wheel speeds (m/s) of vectors of knots, which are in units of V and clipped to [-1, 1]."""
    m = target.scenario.pursuer_count
    levels = jnp.clip(knots, -1.0, 1.0).reshape(knots.shape[0], -1, m, 2)
    return target.scenario.pursuer_speed * jnp.repeat(levels, planning.hold, axis=1)[:, :periods]


def _try(
    target: Target, chases: Chase, plans: Array, begun: Count, goal: str
) -> tuple[Float[Array, "n"], Chase]:
    """Each plan's `shortfall`, and the chases after it."""
    count, periods = plans.shape[:2]
    keys = jax.random.split(jax.random.key(0), count)  # a plan needs no random numbers
    parts = (plans, jnp.broadcast_to(begun, (count,)))
    ended, _ = run(target, script, parts, forget(chases), begun, periods, keys)
    return shortfall(goal, ended), ended


def _spread(leaves: Any, count: int) -> Any:
    return jax.tree.map(lambda leaf: jnp.repeat(leaf, count, axis=0), leaves)


@eqx.filter_jit
def search_starts(
    target: Target,
    planning: Planning,
    bases: World,
    freedom: Float[Array, "n"],
    goal: str,
    key: PRNGKeyArray,
) -> tuple[World, Float[Array, "searches knots"], Optimum]:
    """Improve each of several start worlds; returns them with the knots of their first plans.

    **Arguments:** `freedom` from `starts.freedom`.
    """
    scenario, search = target.scenario, planning.start_search
    vectors = jax.vmap(lambda world: encode(scenario, world))(bases)
    count, entries = vectors.shape
    knots = 2 * scenario.pursuer_count * -(-planning.opening // planning.hold)
    knot_key, key = jax.random.split(key)
    guess = 0.5 * jax.random.normal(knot_key, (count, knots), dtype=vectors.dtype)
    mean = jnp.concatenate([vectors, guess], axis=1)
    spread = jnp.concatenate(
        [jnp.broadcast_to(freedom, vectors.shape), jnp.ones((count, knots), vectors.dtype)], axis=1
    )

    def start_of(base: World, vector: Array) -> World:
        moved = decode(scenario, base, vector)
        return select(jnp.any(freedom > 0.0), moved, base)

    def evaluate(drawn: Array) -> Array:
        worlds = jax.vmap(start_of)(_spread(bases, drawn.shape[0] // count), drawn[:, :entries])
        chases = jax.vmap(lambda world: begin(target, world))(worlds)
        plans = _drive(target, planning, drawn[:, entries:], planning.opening)
        scores, _ = _try(target, chases, plans, jnp.zeros((), jnp.int32), goal)
        allowed = jax.vmap(lambda world: admissible(scenario, world))(worlds)
        return jnp.where(allowed, scores, jnp.inf)

    found = minimise(evaluate, mean, spread, key, search)
    worlds = jax.vmap(start_of)(bases, found.best[:, :entries])
    return worlds, found.best[:, entries:], found


@eqx.filter_jit
def plan_and_drive(
    target: Target,
    planning: Planning,
    chases: Chase,
    knots: Float[Array, "chases knots"],
    begun: Count,
    goal: str,
    key: PRNGKeyArray,
) -> tuple[Chase, Float[Array, "chases t m 2"], Float[Array, "chases knots"], Float[Array, "chases"]]:
    """Plan from the current state of the chases, and drive the first part of the plans.

    **Arguments:** `knots` the rest of the previous plans, with which the search begins.

    **Returns** the chases after `execute` control periods, the commanded wheel speeds (m/s), the rest of the
    plans, and the plans' `shortfall`.
    """

    def evaluate(drawn: Array) -> Array:
        plans = _drive(target, planning, drawn, planning.horizon)
        return _try(target, _spread(chases, drawn.shape[0] // knots.shape[0]), plans, begun, goal)[0]

    found = minimise(evaluate, knots, jnp.ones_like(knots), key, planning.search)
    driven = _drive(target, planning, found.best, planning.execute)
    count = driven.shape[0]
    keys = jax.random.split(jax.random.key(0), count)
    parts = (driven, jnp.broadcast_to(begun, (count,)))
    chases, wheels = run(target, script, parts, chases, begun, planning.execute, keys)
    gone = planning.execute // planning.hold * 2 * target.scenario.pursuer_count
    # The plan is extended by its last knots.
    last = found.best[:, -2 * target.scenario.pursuer_count :]
    rest = jnp.concatenate([found.best[:, gone:], jnp.tile(last, (1, planning.execute // planning.hold))], 1)
    return chases, wheels, rest, found.score


def fit_knots(knots: Array, planning: Planning, pursuers: int) -> Float[Array, "chases knots"]:
    """Knots of an opening, truncated to a plan's horizon or extended by their last ones."""
    wanted = 2 * pursuers * (planning.horizon // planning.hold)
    missing = max(0, wanted - knots.shape[1])
    last = knots[:, -2 * pursuers :]
    return jnp.concatenate([knots, jnp.tile(last, (1, missing // (2 * pursuers)))], axis=1)[:, :wanted]


def chase_with_plans(
    target: Target,
    planning: Planning,
    worlds: World,
    knots: Float[Array, "chases knots"],
    periods: int,
    goal: str,
    key: PRNGKeyArray,
) -> tuple[Chase, Float[np.ndarray, "chases t m 2"]]:
    """Plan and drive in turn until every chase has ended or `periods` have passed."""
    chases = jax.vmap(lambda world: begin(target, world))(worlds)
    knots = fit_knots(knots, planning, target.scenario.pursuer_count)
    driven = []
    for number in range(max(1, periods // planning.execute)):
        begun = jnp.asarray(number * planning.execute, jnp.int32)
        plan_key = jax.random.fold_in(key, number)
        chases, wheels, knots, _ = plan_and_drive(target, planning, chases, knots, begun, goal, plan_key)
        driven.append(np.asarray(wheels))
        if not np.any(np.asarray(chases.running)):
            break
    return chases, np.concatenate(driven, axis=1)
