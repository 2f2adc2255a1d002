"""How seconds and memory grow with each size, and the exponents of that growth.

Every curve runs in a process of its own, sizes ascending. An exponent p of seconds ~ size^p is fitted to
the larger half of the sizes, where fixed costs no longer hide it. Nothing is extrapolated: a curve ends at
the last size that fits into its time.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from functools import partial
from typing import Any

from speed import process
from speed.children import Case
from speed.timing import durations, first_call, tail_exponent

WORLDS = 256
"""Worlds side by side where something else grows."""
PROBLEMS = 4096
"""Filter problems side by side where their rows grow."""
_TWOFOLD = [1, 2, 4, 8, 16, 32, 64]
CURVES: dict[str, tuple[list[int], dict[str, Any]]] = {
    "worlds": ([1, 16, 256, 1024, 4096, 16_384, 65_536], {"shield": "game"}),
    "obstacles, no shield": ([0, 1, 4, 16, 32, 64], {"shield": "none"}),
    "obstacles, game shield": ([0, *_TWOFOLD], {"shield": "game"}),
    "pursuers, no shield": ([1, 2, 3, 4], {"shield": "none"}),
    "pursuers, game shield": ([1, 2, 3, 4], {"shield": "game"}),
    "rows, ours": (_TWOFOLD, {"side": "ours"}),
    "rows, qpax": ([1, 4, 16, 32, 64], {"side": "qpax (float32)"}),
    "rows, ElastiQP": ([1, 4, 16, 32, 64], {"side": "cbfpy (ElastiQP)"}),
    "episodes": ([100, 1_000, 10_000, 100_000, 1_000_000], {"shield": "game", "most_seconds": 120.0}),
    "seeds, one by one": ([1, 2, 4, 8, 16], {"together": False}),
    "seeds, vmapped": ([1, 4, 16], {"together": True}),
}
"""Sizes and settings by curve; the part of the name before the comma says what grows."""


_QUICK = ("worlds", "rows, ours", "rows, qpax")


def cases(quick: bool) -> list[Case]:
    """One case for each curve; `quick` takes the first two sizes of those that compile fast."""
    made = []
    for name, (sizes, settings) in CURVES.items():
        kind = name.partition(",")[0]
        if quick and name not in _QUICK:
            continue
        environment = {"JAX_ENABLE_X64": "1"} if settings.get("side") == "cbfpy (ElastiQP)" else {}
        amount = {"sizes": sizes[:2], "seconds": 0.05, "most_seconds": 5.0} if quick else {}
        whole = {"sizes": sizes, "seconds": 0.3, "most_seconds": 45.0}
        made.append(
            Case("scaling", name, {"curve": kind, **whole, **settings, **amount}, environment=environment)
        )
    return made


def run(settings: dict[str, Any]) -> dict[str, Any]:
    """Per size: seconds of the work, seconds to compile it, and memory (MiB) at its peak above the start."""
    curve, sizes = settings["curve"], settings["sizes"]
    at_start = None
    points: list[dict[str, Any]] = []
    end = time.perf_counter() + settings["most_seconds"]
    for size, (spent, compiling, what) in zip(sizes, _CURVES[curve](settings), strict=False):
        memory = process.peak_memory_mib()
        at_start = memory if at_start is None else at_start
        points.append(
            {
                "size": size, "seconds": spent, "compile_seconds": compiling, "what": what,
                "peak_memory_mib": memory, "above_first_mib": memory - at_start,
            }
        )  # fmt: skip
        process.forget_peak_memory()
        # The next size, compiled and repeated, would take longer than is left.
        if time.perf_counter() > end or (curve == "episodes" and time.perf_counter() + 9.0 * spent > end):
            break
    return {
        "points": points,
        "complete": len(points) == len(sizes),
        "exponent": tail_exponent([p["size"] for p in points], [p["seconds"] for p in points]),
    }


Points = Iterator[tuple[float, float, str]]


def _measure(call: Callable[[int], Any], budget: float) -> tuple[float, float]:
    """Median seconds of a call, and what its first call took more."""
    _, first = first_call(lambda: call(0))
    seconds = durations(call, budget, least=3)
    median = sorted(seconds)[len(seconds) // 2]
    return median, max(0.0, first - median)


def _worlds(settings: dict[str, Any]) -> Points:
    from speed.worlds import crowded

    for size in settings["sizes"]:
        yield _stepped(*crowded(size, 1, 1), settings)


def _obstacles(settings: dict[str, Any]) -> Points:
    from speed.worlds import crowded

    for size in settings["sizes"]:
        yield _stepped(*crowded(WORLDS, size, 1), settings)


def _pursuers(settings: dict[str, Any]) -> Points:
    from speed.worlds import crowded

    for size in settings["sizes"]:
        yield _stepped(*crowded(WORLDS, 1, size), settings)


def _stepped(scenario: Any, starts: Any, settings: dict[str, Any]) -> tuple[float, float, str]:
    from sidestep._threads import useful_threads
    from speed.worlds import stepper

    periods = 10
    threads = useful_threads(starts.evader.shape[0])
    advance = stepper(scenario, settings["shield"], "turn-then-drive", starts, periods, threads=threads)
    spent, compiling = _measure(lambda _: advance(), settings["seconds"])
    return spent / periods, compiling, "one control period of all worlds"


def _rows(settings: dict[str, Any]) -> Points:
    from speed.filter import make_side
    from speed.filter_problems import problems

    for rows in settings["sizes"]:
        side = make_side(settings["side"], problems(PROBLEMS, rows))
        spent, compiling = _measure(lambda _, side=side: side.batch(), settings["seconds"])
        yield spent / PROBLEMS, compiling, f"one problem of {PROBLEMS} at once"


def _episodes(settings: dict[str, Any]) -> Points:
    """Episodes of 60 s that nothing ends but a capture: the evader circles its target."""
    import jax.numpy as jnp

    from sidestep.trials import evaluate
    from sidestep.world import load_scenario

    scenario = load_scenario(
        "paper", obstacle_count=0, episode_steps=1200, initial_separation=0.0, reach_distance=1e-9
    )

    def sideways(observation: Any) -> Any:
        return jnp.zeros_like(observation[:2]).at[1].set(1.0)

    def go(episodes: int, batch: int) -> float:
        begun = time.perf_counter()
        evaluate(scenario, sideways, settings["shield"], "turn-then-drive", episodes, 0, batch=batch)
        return time.perf_counter() - begun

    seen: set[int] = set()
    for size in settings["sizes"]:
        batch = min(size, 2048)
        compiling = 0.0 if batch in seen else go(batch, batch)
        seen.add(batch)
        yield go(size, batch), compiling, "all episodes, 60 s each"


def _seeds(settings: dict[str, Any]) -> Points:
    import equinox as eqx
    import jax
    import jax.numpy as jnp

    from speed.learning import WARMUP, training

    steps = 10
    advance, begin = training("game")
    together = eqx.filter_jit(eqx.filter_vmap(lambda state: advance(state, steps)))

    def one_by_one(states: Any) -> None:
        for state in states:
            advance(state, steps)

    def at_once(states: Any) -> None:
        jax.block_until_ready(together(states))

    for size in settings["sizes"]:
        # Straight to where updates begin: every network learns from then on.
        states = [
            eqx.tree_at(lambda s: s.decisions, state, jnp.full_like(state.decisions, WARMUP))
            for state in map(begin, range(size))
        ]
        if settings["together"]:
            stacked = jax.tree.map(lambda *leaves: jnp.stack(leaves), *states)
            work = partial(at_once, stacked)
        else:
            work = partial(one_by_one, states)
        spent, compiling = _measure(lambda _, work=work: work(), settings["seconds"])
        yield spent / steps, compiling, "one step and update of every seed"


_CURVES: dict[str, Callable[[dict[str, Any]], Points]] = {
    "worlds": _worlds,
    "obstacles": _obstacles,
    "pursuers": _pursuers,
    "rows": _rows,
    "episodes": _episodes,
    "seeds": _seeds,
}


def summary(results: list[dict[str, Any]]) -> dict[str, Any]:
    """The exponents, and from how many rows on each solver is faster than enumerating them."""
    curves = {one["name"]: one for one in results if "points" in one}
    report: dict[str, Any] = {"exponents": {name: one["exponent"] for name, one in curves.items()}}
    ours = {p["size"]: p["seconds"] for p in curves.get("rows, ours", {"points": []})["points"]}
    for name, one in curves.items():
        if name.startswith("rows,") and name != "rows, ours":
            faster = [
                p["size"] for p in one["points"] if p["size"] in ours and p["seconds"] < ours[p["size"]]
            ]
            solver = name.partition(", ")[2]
            report.setdefault("rows_from_which_faster", {})[solver] = min(faster) if faster else None
    return report
