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

from typing import Any

import numpy as np

from sidestep._compiled import cores
from speed import filter_peers
from speed.children import Case
from speed.filter_problems import LIMIT, SINGLES, Problems, Side, disagreement, problems
from speed.process import synchronous_dispatch
from speed.timing import durations, first_call, spread

ROWS = (2, 8)
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


def make_side(name: str, given: Problems) -> Side:
    """One side with these problems prepared for it. **Raises** `MissingPeer` if it is not installed."""
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
