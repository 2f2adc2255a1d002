"""The cross-entropy method (Rubinstein, Kroese, 2004): sample, keep the elites, sample around them."""

from __future__ import annotations

from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, PRNGKeyArray


class Search(eqx.Module):
    """Size of a search: `population` samples in each of `iterations`, of which `elites` are kept.

    `least_spread` is the lower bound of the spread, as a share of the first one, so that a converged search
    still explores.
    """

    population: int = eqx.field(static=True, default=64)
    elites: int = eqx.field(static=True, default=8)
    iterations: int = eqx.field(static=True, default=4)
    least_spread: float = eqx.field(static=True, default=0.1)


class Optimum(eqx.Module):
    """The best vector of each of `searches` independent searches, its score, and the best score per
    iteration."""

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
    """Minimise a score by several searches in parallel.

    **Arguments:** `evaluate` returns the scores of many vectors (search by search), +inf for inadmissible
    ones; `mean` and `spread` (standard deviation, per entry) of the first samples; `first` vectors that are
    among the first samples (default `mean`). Each iteration includes the best vector so far, so the best
    score never increases.
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
        # Inadmissible elites are ignored.
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
