"""The exact filter: the closest action to the nominal one that keeps every row and the speed limit.

minimise |u - nominal|  subject to  n_i.u >= c_i  and  |u| <= s  (paper, eq. qp; or |u| = s).

In the plane the answer is the nominal action, its projection on the disc, or the closest point of one
row's line; so all are computed, and the feasible one of least distance is taken. There is no iteration,
no branch and no matrix product (which a GPU would round to TF32): everything works alike under `jit`,
`vmap` and `grad`, in float32 and float64.
"""

import functools
from collections.abc import Callable
from typing import Any, NamedTuple, TypeAlias

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from sidestep._arrays import AnyArray, Lanes, Scalar, fold, stack
from sidestep.safety.filter.least_violation import Rows, part, relax, root
from sidestep.safety.filter.status import Status

_TOLERANCE = 16.0
_ROUNDING = 8.0
_UNROLLED = 4
# Distances squared are at most 5.
_UNLIKELY = 8.0
_REJECTED = 16.0
# What rounding leaves to break, the hard rows share as little.
_HARDER = 16.0

_Pair: TypeAlias = tuple[Lanes, Lanes]
"""A velocity by its components. To be stacked last of all: XLA turns what is computed after it into a loop
over components with a branch for each, which is ten times slower."""


class Projection(eqx.Module):
    """Answer of `project`: `action (2,)`, `status` (see `Status`), `slack` = min_i (n_i.action - c_i)."""

    action: Float[Array, "2 *lanes"]
    status: Int[Array, "*lanes"]
    slack: Float[Array, "*lanes"]


class _Answer(eqx.Module):
    """An action in units of the speed limit, and by how much it misses the rows."""

    x: Lanes
    y: Lanes
    violation: Lanes


class _Aim(NamedTuple):
    """What the answer is to come close to, in units of the speed limit.

    `scaled` the nominal action, cut far out, where only its direction matters; `start` its projection on the
    disc or circle; `weight` of the distance measure, see `_aim`.
    """

    scaled: _Pair
    start: _Pair
    weight: Lanes


def tolerance(dtype: Any) -> float:
    """Largest violation of a row of unit normal, in units of the speed limit, that counts as kept."""
    return _TOLERANCE * float(jnp.finfo(dtype).eps)


def project(
    nominal: Float[AnyArray, "2 *lanes"],
    normals: Float[AnyArray, "k 2 *lanes"],
    offsets: Float[AnyArray, "k *lanes"],
    speed_limit: Float[AnyArray, ""] | float,
    *,
    hard: int = 0,
    circle: bool = False,
) -> Projection:
    """The closest action to `nominal` with n_i.u >= c_i for all rows and |u| <= `speed_limit`.

    Rows may be scaled at will: only the half-plane matters. A row n = 0 says 0 >= c; one that cannot
    hold makes the status infeasible and takes no other part. Each row is kept to within 16 rounding
    units of the speed limit, and so is the limit itself.

    If no action keeps all rows: the largest violation (in m/s, by which n_i.u/|n_i| falls short) of the
    first `hard` rows is made as small as can be; at that level, the largest of the others; at both levels
    the answer is the closest to `nominal`. The levels are exact, see `least_violation`.

    **Arguments:** `nominal` (m/s); `normals`, `offsets` the k >= 0 rows; `speed_limit` s (m/s); `hard`
    the number of leading rows kept first; `circle` for |u| = s instead of |u| <= s (a zero nominal action
    then counts as one towards +x, since every heading is equally close).

    **Returns** `Projection(action, status, slack)`. `slack` uses the rows as given and is +inf without
    rows. Non-finite input gives `Status.INVALID` and a finite action: a non-finite nominal action counts
    as a stop, a non-finite row is dropped, a non-finite or negative limit counts as 0.

    **Raises** `ValueError` if `hard` is negative or exceeds the number of rows.
    """
    nominal = jnp.asarray(nominal)
    dtype = nominal.dtype
    normals, offsets = jnp.asarray(normals, dtype), jnp.asarray(offsets, dtype)
    limit = jnp.asarray(speed_limit, dtype)
    count = offsets.shape[0]
    if not 0 <= hard <= count:
        raise ValueError(f"hard = {hard}: it must be between 0 and the number of rows, {count}")

    nominal_valid = jnp.isfinite(nominal[0]) & jnp.isfinite(nominal[1])
    limit_valid = jnp.isfinite(limit) & (limit >= 0.0)
    row_valid = jnp.isfinite(normals[:, 0]) & jnp.isfinite(normals[:, 1]) & jnp.isfinite(offsets)
    valid = nominal_valid & limit_valid & fold(jnp.logical_and, row_valid, True)
    wanted = jnp.where(nominal_valid, nominal[0], 0.0), jnp.where(nominal_valid, nominal[1], 0.0)
    limit = jnp.where(limit_valid, limit, 0.0)
    x = jnp.where(row_valid, normals[:, 0], 0.0)
    y = jnp.where(row_valid, normals[:, 1], 0.0)
    c = jnp.where(row_valid, offsets, 0.0)

    moving = limit > 0.0
    unit = jnp.where(moving, limit, 1.0)
    aim, unchanged = _aim(wanted, unit, circle)
    rows, void = _normalise(x, y, c, unit)
    never = fold(jnp.logical_or, void & (c > tolerance(dtype) * unit), False)

    answer, given_way = _solve(aim, rows, hard, circle)

    infeasible = (given_way > tolerance(dtype)) | (answer.violation > tolerance(dtype))
    # A robot that cannot move has one action: zero.
    infeasible = never | jnp.where(moving, infeasible, fold(jnp.logical_or, c > 0.0, False))
    stopped = (wanted[0] == 0.0) & (wanted[1] == 0.0)
    kept = ~infeasible & (
        jnp.where(moving, unchanged & (answer.x == aim.start[0]) & (answer.y == aim.start[1]), stopped)
    )
    action = jnp.where(kept, wanted[0], answer.x * limit), jnp.where(kept, wanted[1], answer.y * limit)
    status = jnp.where(
        valid,
        jnp.where(infeasible, Status.INFEASIBLE, jnp.where(kept, Status.OK, Status.CORRECTED)),
        Status.INVALID,
    ).astype(jnp.int32)
    slack = jnp.where(row_valid, x * action[0] + y * action[1] - c, jnp.inf)
    return Projection(stack(*action), status, fold(jnp.minimum, slack, jnp.inf))


def project_known(
    nominal: Float[Array, "2 *lanes"],
    normals: Float[Array, "k 2 *lanes"],
    offsets: Float[Array, "k *lanes"],
    speed_limit: Scalar,
    *,
    hard: int = 0,
    circle: bool = False,
) -> Float[Array, "2 *lanes"]:
    """The action of `project` alone, for input that is known to be good: a third of the work.

    **Arguments:** as for `project`, but everything finite, normals of unit length, |nominal| <= the limit,
    and that more than 0.
    """
    if circle:
        aim, _ = _aim((nominal[0], nominal[1]), speed_limit, circle)
    else:
        scaled = nominal[0] / speed_limit, nominal[1] / speed_limit
        aim = _Aim(scaled, scaled, jnp.zeros_like(nominal[0]))
    rows = Rows(normals[:, 0], normals[:, 1], offsets / speed_limit)
    answer, _ = _solve(aim, rows, hard, circle)
    return stack(speed_limit * answer.x, speed_limit * answer.y)


def _solve(aim: _Aim, rows: Rows, hard: int, circle: bool) -> tuple[_Answer, Lanes]:
    """The best action, and by how much rows had to give way for it, both in units of the speed limit."""
    relaxed, given_way = rows, jnp.zeros_like(aim.weight)
    for first, last in ((0, hard), (hard, rows.c.shape[0])):
        if first < last:
            # Harder rows already have their final offsets; softer ones do not count yet.
            tier, level = relax(part(relaxed, 0, last), first, circle)
            relaxed = Rows(*(jnp.concatenate([a, b[last:]]) for a, b in zip(tier, relaxed, strict=True)))
            given_way = jnp.maximum(given_way, level)
    return _closest(aim, relaxed, hard, circle), given_way


def _aim(nominal: _Pair, unit: Scalar, circle: bool) -> tuple[_Aim, Bool[Array, "*lanes"]]:
    """What to come close to, and whether the nominal action is on the disc or circle already.

    Distances to a far nominal action all look the same in floating point. With q the nominal action, p
    its projection on the disc and w = 1 - 1/|q|, |u - q|^2 is, up to a constant and a positive factor,
    |u - p|^2 + w (1 - |u|^2), which loses no digits.
    """
    dtype = nominal[0].dtype
    eps = float(jnp.finfo(dtype).eps)
    size = jax.lax.stop_gradient(jnp.maximum(jnp.abs(nominal[0]), jnp.abs(nominal[1])))
    some = size > 0.0
    safe = jnp.where(some, size, 1.0)
    x, y = jnp.where(some, nominal[0] / safe, 1.0), jnp.where(some, nominal[1] / safe, 0.0)
    norm = jnp.sqrt(x**2 + y**2)
    x, y = x / norm, y / norm
    speed = jnp.where(some, norm * safe, 0.0) / unit
    close, cut = speed <= 2.0, jnp.minimum(speed, 1.0 / eps)
    near = jnp.where(close, nominal[0] / unit, x * cut), jnp.where(close, nominal[1] / unit, y * cut)
    slack = tolerance(dtype)
    if circle:
        inside = jnp.abs(speed - 1.0) <= slack
        weight = jnp.zeros_like(speed)
    else:
        inside = speed <= 1.0 + slack
        weight = jnp.where(inside, 0.0, 1.0 - 1.0 / jnp.where(inside, 1.0, speed))
    return _Aim(near, (jnp.where(inside, near[0], x), jnp.where(inside, near[1], y)), weight), inside


def _normalise(
    x: Float[Array, "k *lanes"], y: Float[Array, "k *lanes"], c: Float[Array, "k *lanes"], unit: Scalar
) -> tuple[Rows, Array]:
    """Unit normals and offsets in units of the limit; rows without a normal become n = 0, c = -2."""
    largest = float(jnp.finfo(x.dtype).max) / 8.0
    size = jax.lax.stop_gradient(jnp.maximum(jnp.abs(x), jnp.abs(y)))
    void = ~(size > 0.0)
    safe = jnp.where(void, 1.0, size)
    x, y = x / safe, y / safe
    inverse = jax.lax.rsqrt(jnp.where(void, 1.0, x**2 + y**2))
    distance = jnp.clip(c / safe / unit * inverse, -largest, largest)
    return Rows(x * inverse, y * inverse, jnp.where(void, -2.0, distance)), void


def _worst(measure: Callable[[Any, Any], Any], lines: Any, rows: Any) -> Any:
    """For every line the largest of `measure(line, row)` over the rows; both are tuples of (k,) arrays.

    A few rows are taken one by one, which XLA fuses into one vectorised loop over a batch; many at once.
    """
    count = rows[0].shape[0]
    if count <= _UNROLLED:
        each = [measure(lines, [entry[j] for entry in rows]) for j in range(count)]
        return functools.reduce(lambda a, b: jax.tree.map(jnp.maximum, a, b), each)
    table = measure([entry[:, None] for entry in lines], [entry[None] for entry in rows])
    return jax.tree.map(lambda entry: jnp.max(entry, axis=1), table)


def _closest(aim: _Aim, rows: Rows, hard: int, circle: bool) -> _Answer:
    """The closest feasible point, given that there is one; if rounding hides it, the least bad candidate.

    On line i, u = c_i n_i + t n_i' with n_i' a quarter turn to the left. Row j allows a t >= b there, with
    a = n_i x n_j and b = c_j - c_i n_i.n_j; the disc allows t^2 <= 1 - c_i^2. The closest point of the line
    is the scaled nominal action's t clipped to what all others allow.
    """
    scaled, start, weight = aim
    if rows.c.shape[0] == 0:
        return _Answer(start[0], start[1], jnp.zeros_like(weight))
    eps = float(jnp.finfo(rows.c.dtype).eps)
    x, y, c = rows
    half = root(1.0 - c**2)

    def meet(line: Any, row: Any) -> tuple[Array, Array]:
        return (
            line[0] * row[1] - line[1] * row[0],
            row[2] - line[2] * (line[0] * row[0] + line[1] * row[1]),
        )

    def miss(line: Any, row: Any) -> Array:
        across, short = meet(line, row)
        return short - across * line[3]

    def limits(line: Any, row: Any) -> tuple[Array, Array]:
        """Lower limit and negated upper limit; both eased by rounding, and void for parallel rows."""
        across, short = meet(line, row)
        steep = jnp.abs(across) > _ROUNDING * eps
        end = (short - _ROUNDING * eps) / jnp.where(steep, across, 1.0)
        return (
            jnp.where(steep & (across > 0.0), end, -jnp.inf),
            jnp.where(steep & (across < 0.0), -end, -jnp.inf),
        )

    short_of_start = c - x * start[0] - y * start[1]
    if circle:
        # Both ends of the arc that row i allows.
        x, y, c, half = (jnp.concatenate([entry, entry]) for entry in (x, y, c, half))
        count = rows.c.shape[0]
        t = jnp.concatenate([half[:count], -half[count:]])
        likely = jnp.ones_like(c, bool)
    else:
        low, minus_high = _worst(limits, (x, y, c), rows)
        allowed = jnp.minimum(jnp.maximum(x * scaled[1] - y * scaled[0], low), -minus_high)
        # The disc last: should the limits contradict each other, `violation` below will show it.
        t = jnp.clip(allowed, -half, half)
        # Some row that the start violates is active at the answer; the others only help against rounding.
        likely = short_of_start > 0.0
    lines, outside = (x, y, c, t), jnp.abs(c) - 1.0
    violation = jnp.maximum(_worst(miss, lines, rows), outside)
    ahead = c - x * start[0] - y * start[1]
    aside = t - (x * start[1] - y * start[0])
    distance = ahead**2 + aside**2 + weight * (1.0 - c**2 - t**2)
    key = jnp.where(likely, distance, _UNLIKELY + distance)
    rank = violation
    if 0 < hard < rows.c.shape[0]:
        rank = jnp.maximum(rank, _HARDER * jnp.maximum(_worst(miss, lines, part(rows, 0, hard)), outside))
    key = jnp.where(violation <= tolerance(c.dtype), key, _REJECTED + rank)
    c = jnp.clip(c, -1.0, 1.0)  # whatever rounding did, the speed limit holds
    least, *best = _least(key, c * x - t * y, c * y + t * x, violation)
    missed = fold(jnp.maximum, short_of_start, -jnp.inf)
    stay = (missed <= tolerance(c.dtype)) | (_REJECTED + missed <= least)
    answer = (jnp.where(stay, a, b) for a, b in zip((*start, missed), best, strict=True))
    return _Answer(*answer)


def _least(key: Float[Array, "k *lanes"], *entries: Float[Array, "k *lanes"]) -> tuple[Lanes, ...]:
    """The smallest key, and the entries that go with it."""
    lowest = jnp.argmin(key, axis=0)
    chosen = lowest == jnp.arange(key.shape[0]).reshape(-1, *[1] * lowest.ndim)
    return jnp.min(key, axis=0), *(jnp.sum(jnp.where(chosen, entry, 0.0), axis=0) for entry in entries)
