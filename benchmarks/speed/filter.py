"""The filter: the closest action to the nominal one that keeps all rows and the speed limit.

The problems are random and feasible: k rows n.u >= c that all hold at some point well inside the speed
limit, and nominal actions up to twice as fast. Ours and Clarabel keep |u| <= s, the disc that a robot's speed
is bounded by; for quadratic programs there is only the square of |u_x| <= s and |u_y| <= s. Where the disc is
not active at the answer, all have the same one; how far each side is from it is reported with its times.

A single call gives one answer, with one thread and, for JAX's sides, synchronous dispatch; these get and give
JAX arrays, the others NumPy arrays. A batch is many problems at once, with a thread per core: ours with the
problems last, JAX's others under `vmap`. OSQP and Clarabel take one problem at a time, and what they do per
second is that.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from sidestep._compiled import cores
from speed.children import Case
from speed.process import synchronous_dispatch
from speed.timing import durations, first_call, spread

LIMIT = 0.18
"""Speed limit, m/s."""
ROWS = (2, 8)
SINGLES = 256
"""Problems that single calls go round."""
ACTIVE = 0.999
"""The disc counts as active from this share of the limit on."""
X64 = {"JAX_ENABLE_X64": "1"}
LOOPED = ("OSQP", "Clarabel")
"""These take one problem at a time."""
SIDES: dict[str, dict[str, str]] = {
    "ours": {},
    "cbfpy (ElastiQP)": X64,
    "cbfpy (qpax)": X64,
    "qpax": X64,
    "qpax (float32)": {},
    "OSQP": {},
    "Clarabel": {},
}
"""Every side with the environment that its authors advise; qpax in both precisions."""


@dataclass(frozen=True)
class Problems:
    """N problems of k rows: `nominal (N, 2)`, `normals (N, k, 2)`, `offsets (N, k)`, in m/s."""

    nominal: np.ndarray
    normals: np.ndarray
    offsets: np.ndarray


@dataclass(frozen=True)
class Side:
    """How one side answers: problem i of the first ones, and all at once; then answers as (2,) and (N, 2)."""

    single: Callable[[int], Any]
    batch: Callable[[], Any]
    answer: Callable[[Any], np.ndarray]
    answers: Callable[[Any], np.ndarray]


def problems(count: int, rows: int, seed: int = 0) -> Problems:
    """Random feasible problems, the same for every side."""
    random = np.random.default_rng([seed, rows])
    angle = random.uniform(-np.pi, np.pi, (count, rows))
    normals = np.stack([np.cos(angle), np.sin(angle)], axis=-1)
    inside = 0.7 * LIMIT * random.uniform(-1.0, 1.0, (count, 1, 2)) / np.sqrt(2.0)
    margin = random.uniform(0.0, 0.5 * LIMIT, (count, rows))
    direction = random.uniform(-np.pi, np.pi, count)
    speed = 2.0 * LIMIT * np.sqrt(random.uniform(size=count))
    nominal = speed[:, None] * np.stack([np.cos(direction), np.sin(direction)], axis=-1)
    return Problems(nominal, normals, np.sum(normals * inside, axis=-1) - margin)


def cases(quick: bool) -> list[Case]:
    """Every side with both numbers of rows: single calls with one thread, batches with one per core."""
    amount = {"seconds": 0.1, "batch": 64} if quick else {"seconds": 0.7, "batch": 65_536}
    return [
        Case(
            "filter",
            name,
            {"side": name, "rows": rows, "calls": calls, **amount},
            threads=1 if calls == "single" else cores(),
            environment=environment,
        )
        for rows in (ROWS[:1] if quick else ROWS)
        for name, environment in SIDES.items()
        for calls in ("single", "batch")
        if calls == "single" or name not in LOOPED
    ]


def run(settings: dict[str, Any]) -> dict[str, Any]:
    """Microseconds of a single call, or problems per second in a batch; checked against the exact answer."""
    name, budget = settings["side"], settings["seconds"]
    batched = settings["calls"] == "batch"
    if not batched and name not in LOOPED:
        synchronous_dispatch()
    given = problems(settings["batch"] if batched else SINGLES, settings["rows"], seed=int(batched))
    side = make_side(name, given)
    answers, compiling = first_call(side.batch if batched else lambda: side.single(0))
    figures: dict[str, Any] = {"compile_seconds": 0.0 if name in LOOPED else compiling}
    if batched:
        seconds = durations(lambda _: side.batch(), budget)
        per_second = len(given.nominal) / float(np.median(seconds))
        figures |= {"latency": spread(seconds, "ms"), **disagreement(given, side.answers(answers))}
    else:
        seconds = durations(lambda i: side.single(i % SINGLES), budget, least=SINGLES, warm_up=SINGLES)
        per_second = 1.0 / float(np.mean(seconds))
        found = np.stack([side.answer(side.single(i)) for i in range(SINGLES)])
        figures |= {"latency": spread(seconds), **disagreement(given, found)}
    return {**figures, "throughput": {"value": per_second, "unit": "problems/s"}}


def disagreement(given: Problems, answers: np.ndarray) -> dict[str, Any]:
    """Largest distance (m/s) to the exact answer where the disc is not active there, and how many those are.

    The exact answer is computed here in NumPy and double precision: the best of the nominal action, its
    projections on the rows' lines and the lines' crossings, among those that keep all rows.
    """
    exact, inside = exact_answers(given)
    apart = np.linalg.norm(answers[inside] - exact[inside], axis=-1)
    return {
        "compared": int(inside.sum()),
        "largest_difference": float(apart.max()),
        "median_difference": float(np.median(apart)),
    }


def exact_answers(given: Problems) -> tuple[np.ndarray, np.ndarray]:
    """The closest actions that keep all rows, without any speed limit, and where they are within it."""
    wish, normals, offsets = given.nominal, given.normals, given.offsets
    count, rows = offsets.shape
    candidates = [wish]
    for i in range(rows):
        short = offsets[:, i] - np.sum(normals[:, i] * wish, axis=-1)
        candidates.append(wish + short[:, None] * normals[:, i])
        for j in range(i):
            pair = np.stack([normals[:, i], normals[:, j]], axis=1)
            crossing = pair[:, 0, 0] * pair[:, 1, 1] - pair[:, 0, 1] * pair[:, 1, 0]
            sound = np.abs(crossing) > 1e-9
            scale = 1.0 / np.where(sound, crossing, 1.0)
            x = (offsets[:, i] * pair[:, 1, 1] - offsets[:, j] * pair[:, 0, 1]) * scale
            y = (offsets[:, j] * pair[:, 0, 0] - offsets[:, i] * pair[:, 1, 0]) * scale
            candidates.append(np.where(sound[:, None], np.stack([x, y], axis=-1), np.inf))
    best, least = np.full((count, 2), np.nan), np.full(count, np.inf)
    for candidate in candidates:
        finite = np.where(np.isfinite(candidate), candidate, 1e3)
        kept = np.all(np.einsum("nkc,nc->nk", normals, finite) >= offsets - 1e-12, axis=-1)
        distance = np.where(kept, np.linalg.norm(finite - wish, axis=-1), np.inf)
        closer = distance < least
        best[closer], least[closer] = finite[closer], distance[closer]
    return best, np.linalg.norm(best, axis=-1) < ACTIVE * LIMIT


def make_side(name: str, given: Problems) -> Side:
    """One side with these problems prepared for it. **Raises** `MissingPeer` if it is not installed."""
    from speed import filter_peers

    if name == "ours":
        return _ours(given)
    if name.startswith("cbfpy"):
        return filter_peers.cbfpy(given, "elastiqp" if "ElastiQP" in name else "qpax")
    make = {"qpax": filter_peers.qpax, "OSQP": filter_peers.osqp, "Clarabel": filter_peers.clarabel}
    return make[name.split(" ")[0]](given)


def _ours(given: Problems) -> Side:
    import jax
    import jax.numpy as jnp

    from sidestep.safety import project

    solve = jax.jit(project)
    limit = jnp.asarray(LIMIT, jnp.float32)
    # Lanes last: components first, the problems behind them.
    nominal = jnp.asarray(given.nominal.T, jnp.float32)
    normals = jnp.asarray(np.moveaxis(given.normals, 0, -1), jnp.float32)
    offsets = jnp.asarray(given.offsets.T, jnp.float32)
    singles = [(nominal[:, i], normals[..., i], offsets[:, i]) for i in range(min(SINGLES, nominal.shape[1]))]
    return Side(
        lambda i: jax.block_until_ready(solve(*singles[i], limit)),
        lambda: jax.block_until_ready(solve(nominal, normals, offsets, limit)),
        lambda answer: np.asarray(answer.action),
        lambda answer: np.asarray(answer.action).T,
    )


def summary(results: list[dict[str, Any]]) -> dict[str, Any]:
    """Ours against each side: how many times as many problems per second, and as short a call."""
    found = {
        (one["name"], one["settings"]["rows"], one["settings"]["calls"]): one
        for one in results
        if "latency" in one
    }
    ratios: dict[str, dict[str, float]] = {}
    for (name, rows, calls), one in found.items():
        ours = found.get(("ours", rows, calls))
        if name != "ours" and ours:
            ratio = ratios.setdefault(f"{name}, {rows} rows", {})
            if calls == "single":
                ratio["single_p50"] = one["latency"]["p50"] / ours["latency"]["p50"]
            batched = found.get(("ours", rows, "batch"))
            if batched and (calls == "batch" or name in LOOPED):
                ratio["batch"] = batched["throughput"]["value"] / one["throughput"]["value"]
    return {"ratios": ratios}
