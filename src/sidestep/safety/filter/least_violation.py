"""By how much rows must give way when no action keeps them all: exact levels in the unit disc or circle.

Rows are n_i.u >= c_i with unit normals, actions u are measured in units of the speed limit, and the
violation of a row is v_i(u) = c_i - n_i.u. A *level* is the smallest largest violation some action can
reach. Rows before `first` are kept as they are; the level is that of the rows from `first` on.
"""

from collections.abc import Sequence
from itertools import combinations
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from sidestep._arrays import Lanes

_STACKED = 4
"""Up to so many rows groups of them are stacked row by row, which XLA fuses with what follows. With thousands
of groups it would compile for minutes."""


class Rows(NamedTuple):
    """Rows n.u >= c with unit normals n = (x, y); a row with n = 0 stands for no row at all."""

    x: Float[Array, "..."]
    y: Float[Array, "..."]
    c: Float[Array, "..."]


def root(value: Float[Array, "*n"]) -> Float[Array, "*n"]:
    """sqrt(max(value, 0)) whose gradient at and below 0 is 0 rather than infinite or NaN."""
    positive = value > 0.0
    return jnp.where(positive, jnp.sqrt(jnp.where(positive, value, 1.0)), 0.0)


def part(rows: Rows, start: int, stop: int | None = None) -> Rows:
    """Rows `start` to `stop`."""
    return Rows(rows.x[start:stop], rows.y[start:stop], rows.c[start:stop])


def relax(rows: Rows, first: int, circle: bool) -> tuple[Rows, Lanes]:
    """Lower the offsets of the rows from `first` on by their level, so that they can just hold.

    Offsets far above 1 are moved down together first (which moves the level, not the best action), so
    that huge offsets cost no digits.

    **Returns** the relaxed rows and by how much each gave way, in units of the speed limit, 0 if all can
    hold. The amount is capped to a few units where offsets are huge.
    """
    rows = _within_reach(rows, first)
    level = _circle_level(rows, first) if circle else _disc_level(rows, first)
    level = jnp.maximum(level, 0.0)
    c = jnp.concatenate([rows.c[:first], rows.c[first:] - level])
    return Rows(rows.x, rows.y, c), level


def _within_reach(rows: Rows, first: int) -> Rows:
    """Offsets in [-2, 2]: below -1 a row always holds, above 1 only the differences to the largest matter."""
    live = rows.x**2 + rows.y**2 > 0.0
    c = jnp.where(live, rows.c, -2.0)
    top = jnp.max(c[first:], axis=0)
    moved = jnp.where(top > 2.0, (c[first:] - top) + 2.0, c[first:])
    return Rows(rows.x, rows.y, jnp.concatenate([jnp.maximum(c[:first], -2.0), jnp.maximum(moved, -2.0)]))


def _disc_level(rows: Rows, first: int) -> Lanes:
    """Level in the unit disc.

    Helly's theorem in the plane: convex sets have a common point as soon as every three of them do. So
    the level is the largest over all triples among the disc and the rows, and each triple has a closed
    form: disc and two rows (`_free_pair`, `_kept_pair`), or three rows (`_triple`).
    """
    count = rows.c.shape[0]
    level = jnp.max(rows.c[first:], axis=0) - 1.0
    pairs = list(combinations(range(count), 2))
    if free := [pair for pair in pairs if pair[0] >= first]:
        p, q = _take(rows, free)
        level = jnp.maximum(level, jnp.max(_free_pair(p, q), axis=0))
    if mixed := [pair for pair in pairs if pair[0] < first <= pair[1]]:
        kept, other = _take(rows, mixed)
        level = jnp.maximum(level, jnp.max(_kept_pair(kept, other), axis=0))
    # At least one of the three is free; the last one, as indices ascend.
    if triples := [three for three in combinations(range(count), 3) if three[2] >= first]:
        p, q, r = _take(rows, triples)
        level = jnp.maximum(level, jnp.max(_triple(p, q, r, triples, first), axis=0))
    return level


def _take(rows: Rows, groups: Sequence[tuple[int, ...]]) -> list[Rows]:
    """The first rows of all groups, the second ones, and so on."""

    def pick(entry: Array, index: tuple[int, ...]) -> Array:
        if rows.c.shape[0] > _STACKED:
            return entry[np.array(index)]
        return jnp.stack([entry[i] for i in index])

    return [Rows(*(pick(entry, index) for entry in rows)) for index in zip(*groups, strict=True)]


def _free_pair(p: Rows, q: Rows) -> Float[Array, "..."]:
    """min over the disc of max(v_p, v_q), where that is not the level of a single row (then -inf).

    With d = n_p - n_q and m = n_p + n_q (at right angles) the best action has v_p = v_q and lies on the
    circle towards m: level = (c_p + c_q)/2 - |m|/2 sqrt(1 - (c_p - c_q)^2/|d|^2).
    """
    squared = (p.x - q.x) ** 2 + (p.y - q.y) ** 2
    across = (p.x + q.x) ** 2 + (p.y + q.y) ** 2
    gap = jnp.abs(p.c - q.c)
    both = gap < squared / 2.0
    share = gap**2 / jnp.where(both, squared, 1.0)
    return jnp.where(both, (p.c + q.c - root(across * (1.0 - share))) / 2.0, -jnp.inf)


def _kept_pair(kept: Rows, free: Rows) -> Float[Array, "..."]:
    """min of v_free over the part of the disc where `kept` holds, if it is not c - 1 (then -inf).

    The most favourable action n_free violates `kept`; the best one left is where the line of `kept`
    meets the circle.
    """
    along = kept.x * free.x + kept.y * free.y
    aside = jnp.abs(kept.x * free.y - kept.y * free.x)
    best = kept.c * along + aside * root(1.0 - kept.c**2)
    return jnp.where(along < kept.c, free.c - best, -jnp.inf)


def _triple(
    p: Rows, q: Rows, r: Rows, groups: Sequence[tuple[int, ...]], first: int
) -> Float[Array, "triples *lanes"]:
    """Level of three rows without the disc, by linear duality; -inf where it is unbounded.

    With multipliers l >= 0 such that sum l_i n_i = 0 (the cross products of the other two normals) the
    level is sum l_i c_i / (sum of l_i over the free rows). Rounding is subtracted, so that rows which
    can hold are never said not to.
    """
    eps = float(jnp.finfo(p.c.dtype).eps)
    free = (first <= np.array(groups).T).astype(p.c.dtype)
    free1, free2, free3 = free.reshape(*free.shape, *[1] * (p.c.ndim - 1))
    one, two, three = q.x * r.y - q.y * r.x, r.x * p.y - r.y * p.x, p.x * q.y - p.y * q.x
    weight = one * free1 + two * free2 + three * free3
    total = one * p.c + two * q.c + three * r.c
    positive = (one > 0.0) & (two > 0.0) & (three > 0.0)
    negative = (one < 0.0) & (two < 0.0) & (three < 0.0)
    bounded = (positive | negative) & (jnp.abs(weight) > 64.0 * eps)
    safe = jnp.where(bounded, weight, 1.0)
    return jnp.where(bounded, jnp.minimum(total / safe, 4.0) - 32.0 * eps / jnp.abs(safe), -jnp.inf)


def _circle_level(rows: Rows, first: int) -> Lanes:
    """Level on the unit circle: the best of the actions where the largest violation can be least.

    On the circle v_i is a sinusoid, so the least of their maximum lies at the bottom n_i of one, where
    two cross, or at an end of an arc allowed by the rows that are kept. All are tried.
    """
    free, kept = part(rows, first), part(rows, 0, first)
    eps = float(jnp.finfo(rows.c.dtype).eps)
    p = Rows(free.x[:, None], free.y[:, None], free.c[:, None])
    dx, dy, gap = p.x - free.x, p.y - free.y, p.c - free.c
    squared = dx**2 + dy**2
    meet = (gap**2 <= squared) & (squared > 0.0)
    safe = jnp.where(meet, squared, 1.0)
    foot, rise = gap / safe, root(1.0 - gap**2 / safe) / jnp.sqrt(safe)
    # Swapping the two rows gives the other of the two crossings.
    crossings = (
        jnp.where(meet, foot * dx - rise * dy, p.x).reshape(-1, *rows.c.shape[1:]),
        jnp.where(meet, foot * dy + rise * dx, p.y).reshape(-1, *rows.c.shape[1:]),
    )
    half = root(1.0 - kept.c**2)
    x = jnp.concatenate(
        [free.x, crossings[0], kept.c * kept.x - half * kept.y, kept.c * kept.x + half * kept.y]
    )
    y = jnp.concatenate(
        [free.y, crossings[1], kept.c * kept.y + half * kept.x, kept.c * kept.y - half * kept.x]
    )
    on_circle = jnp.abs(x**2 + y**2 - 1.0) <= 64.0 * eps
    violation = rows.c - x[:, None] * rows.x - y[:, None] * rows.y
    excess = jnp.maximum(jnp.max(violation[:, :first], axis=1, initial=-jnp.inf), 0.0)
    level = jnp.max(violation[:, first:], axis=1)
    key = jnp.where(on_circle, jnp.where(excess <= 64.0 * eps, level, 8.0 + excess), jnp.inf)
    lowest = jnp.argmin(key, axis=0)
    best = lowest == jnp.arange(key.shape[0]).reshape(-1, *[1] * lowest.ndim)
    # With no action on the circle (every row void) nothing can be violated.
    return jnp.where(jnp.any(on_circle, axis=0), jnp.sum(jnp.where(best, level, 0.0), axis=0), 0.0)
