"""The cross-entropy method (Rubinstein, Kroese, 2004): draw, keep the best, draw around them."""

from __future__ import annotations

from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, PRNGKeyArray


class Search(eqx.Module):
    """Size of a search: `population` drawn in each of `iterations`, of which `elites` are kept.

    `least_spread` is the share of the first spread below which it never falls, so that a search that has
    settled still looks around.
    """

    population: int = eqx.field(static=True, default=64)
    elites: int = eqx.field(static=True, default=8)
    iterations: int = eqx.field(static=True, default=4)
    least_spread: float = eqx.field(static=True, default=0.1)


class Optimum(eqx.Module):
    """The best of `searches` independent searches: where, how good, and the best so far per iteration."""

    best: Float[Array, "searches n"]
    score: Float[Array, "searches"]
    history: Float[Array, "iterations searches"]


def minimise(
    evaluate: Callable[[Float[Array, "drawn n"]], Float[Array, "drawn"]],
    mean: Float[Array, "searches n"],
    spread: Float[Array, "searches n"],
    key: PRNGKeyArray,
    search: Search,
    first: Float[Array, "searches n"] | None = None,
) -> Optimum:
    """Vectors of low score, found by several searches side by side.

    **Arguments:** `evaluate` scores many vectors in one call (search by search), +inf for those not allowed;
    `mean` and `spread` (standard deviation, per entry) where to begin; `first` vectors drawn for certain in
    the first iteration (`mean` if not given). The best of each search is drawn again in its next iteration,
    so that it never gets worse.
    """
    searches, size = mean.shape
    first = mean if first is None else first

    def iteration(carry: tuple[Array, Array, Array, Array], key: PRNGKeyArray):
        mean, deviation, best, score = carry
        noise = jax.random.normal(key, (searches, search.population, size), dtype=mean.dtype)
        drawn = mean[:, None] + deviation[:, None] * noise
        drawn = drawn.at[:, 0].set(best)
        scores = evaluate(drawn.reshape(-1, size)).reshape(searches, search.population)
        scores = jnp.where(jnp.isnan(scores), jnp.inf, scores)
        order = jnp.argsort(scores, axis=1)[:, : search.elites]
        elites = jnp.take_along_axis(drawn, order[..., None], axis=1)
        lowest = scores[jnp.arange(searches), order[:, 0]]
        # Elites that are not allowed teach nothing.
        taught = jnp.isfinite(jnp.take_along_axis(scores, order, axis=1)).all(axis=1)[:, None]
        mean = jnp.where(taught, jnp.mean(elites, axis=1), mean)
        narrow = jnp.maximum(jnp.std(elites, axis=1), search.least_spread * spread)
        deviation = jnp.where(taught, narrow, deviation)
        better = lowest < score
        best = jnp.where(better[:, None], elites[:, 0], best)
        score = jnp.where(better, lowest, score)
        return (mean, deviation, best, score), score

    start = (mean, spread, first, jnp.full((searches,), jnp.inf, mean.dtype))
    (_, _, best, score), history = jax.lax.scan(iteration, start, jax.random.split(key, search.iterations))
    return Optimum(best, score, history)
