"""One decision as the decision core of a robot makes it, in JAX and by compiled C, beside the filter alone.

The call is `sidestep.robot.answering.Answering`, or `sidestep.bridges.compiled.CompiledAnswering`: from the
estimated world, NumPy arrays, to the answer, NumPy arrays, on a core with one thread. The evader heads for
the target over whole episodes, the pursuer is `nash`; both and the physics are not timed. Where `joint` looks
ahead, JAX decides on both sides. `filter` is the call of the section of that name, for two rows; by compiled
C it gives and gets NumPy arrays.
"""

from __future__ import annotations

import itertools
import tempfile
import time
from pathlib import Path
from typing import Any

import numpy as np

from speed import filter as filters
from speed.children import Case
from speed.filter_problems import LIMIT, SINGLES, problems
from speed.process import synchronous_dispatch
from speed.timing import durations, spread

SHIELDS = {"game": {}, "joint": {}, "joint, with a budget": {"delay": 0.02}}
"""Shields of the preset `paper`, and budgets: `joint` without one goes by its table."""
FILTERS = {"ours": {}, "ours, compiled C": {}, "cbfpy (ElastiQP)": filters.X64}


def cases(quick: bool) -> list[Case]:
    """Every shield and the filter, each side."""
    amount = {"seconds": 0.2, "decisions": 50} if quick else {"seconds": 30.0, "decisions": 20_000}
    once = {"rows": 2, "calls": "single", "seconds": 0.1 if quick else 0.7, "batch": 64}
    made = [
        Case("decision", f"filter: {side}", {"side": side, **once}, threads=1, environment=environment)
        for side, environment in FILTERS.items()
    ]
    for name, budget in SHIELDS.items():
        if quick and name != "game":
            continue
        made += [
            Case(
                "decision",
                f"{name}: {how}",
                {"shield": name, "budget": budget, "how": how, **amount},
                threads=1,
            )
            for how in ("JAX", "compiled C")
        ]
    return made


def run(settings: dict[str, Any]) -> dict[str, Any]:
    """Microseconds of each call."""
    if settings.get("side") == "ours, compiled C":
        return _filter(settings)
    if "side" in settings:
        return filters.run(settings)
    return _decisions(settings)


def _filter(settings: dict[str, Any]) -> dict[str, Any]:
    import ctypes

    import jax.numpy as jnp

    from sidestep.bridges.export.library import build, c_code, compiler
    from sidestep.safety import project
    from speed.peers import MissingPeer

    given = problems(SINGLES, settings["rows"])
    program = compiler()
    if program is None:
        raise MissingPeer("a C compiler")
    first = (given.nominal[0], given.normals[0], given.offsets[0])

    def filtered(nominal: Any, normals: Any, offsets: Any) -> tuple[Any, ...]:
        result = project(nominal, normals, offsets, jnp.float32(LIMIT))
        return result.action, result.status, result.slack

    begun = time.perf_counter()
    code = c_code(filtered, *(part.astype(np.float32) for part in first))
    with tempfile.TemporaryDirectory() as folder:
        path, why = build(Path(folder), code, program)
        if path is None:
            raise RuntimeError(why)
        decide = ctypes.PyDLL(str(path)).sidestep_decide
    compiling = time.perf_counter() - begun
    decide.argtypes, decide.restype = [ctypes.c_void_p], None
    parts = [np.ravel(part) for part in first]
    ends = np.cumsum([0, *map(len, parts)])
    words = np.zeros(ends[-1] + 4, np.float32)
    nominal, normals, offsets = (words[a:b] for a, b in itertools.pairwise(ends))
    normals, address, answer = normals.reshape(-1, 2), words.ctypes.data, words[ends[-1] :]

    def call(i: int) -> np.ndarray:
        k = i % SINGLES
        nominal[:], normals[...], offsets[:] = given.nominal[k], given.normals[k], given.offsets[k]
        decide(address)
        return answer[:2].copy()

    seconds = durations(call, settings["seconds"], least=SINGLES, warm_up=SINGLES)
    answers = np.stack([call(i) for i in range(SINGLES)])
    return {
        "latency": spread(seconds),
        "throughput": {"value": 1.0 / float(np.mean(seconds)), "unit": "problems/s"},
        "compile_seconds": compiling,
        **filters.disagreement(given, answers),
    }


def _decisions(settings: dict[str, Any]) -> dict[str, Any]:
    import jax
    import jax.numpy as jnp

    from sidestep.bridges.compiled import CompiledAnswering
    from sidestep.pursuit import make_pursuer, pursue
    from sidestep.robot.answering import Answering, Estimate
    from sidestep.safety import Budget, make_shield
    from sidestep.world import load_scenario, to_velocity
    from speed.worlds import AHEAD

    synchronous_dispatch()
    scenario, pursuer = load_scenario("paper"), make_pursuer("nash")
    budget = Budget(**settings["budget"]) if settings["budget"] else None
    shield = make_shield(settings["shield"].partition(",")[0], scenario, budget)
    answering = (CompiledAnswering if settings["how"] == "compiled C" else Answering)(shield, None)

    def seen(world: Any) -> tuple[Any, Any]:
        ahead = jnp.asarray(AHEAD, world.evader.dtype)
        return world, to_velocity(scenario, world, ahead)

    @jax.jit
    def begin(key: Any) -> Any:
        return seen(scenario.reset(key))

    @jax.jit
    def move(world: Any, action: Any, key: Any) -> Any:
        moved, events = scenario.step(world, action, pursue(scenario, pursuer, world, key))
        return seen(moved), events.terminated | events.truncated

    def numbers(world: Any) -> Estimate:
        world = jax.device_get(world)
        still = world.evader_velocity, world.wheel_speeds, float(world.time)
        return Estimate(world.evader, world.pursuers, world.obstacles, world.target, *still)

    key = jax.random.key(0)
    world, nominal = begin(key)
    estimate = numbers(world)
    memory = answering.start(estimate)
    begun = time.perf_counter()
    answer, _ = answering(estimate, np.asarray(nominal), False, False, 0.0, memory)
    compiling = time.perf_counter() - begun
    jax.block_until_ready(move(world, jnp.asarray(answer.action, world.evader.dtype), key))
    seconds: list[float] = []
    statuses: dict[int, int] = {}
    end, episode = time.perf_counter() + settings["seconds"], 0
    while len(seconds) < settings["decisions"] and time.perf_counter() < end:
        key = jax.random.fold_in(jax.random.key(0), episode)
        world, nominal = begin(key)
        memory, ended = answering.start(numbers(world)), False
        while not ended and len(seconds) < settings["decisions"] and time.perf_counter() < end:
            estimate, given = numbers(world), np.asarray(nominal)
            begun = time.perf_counter()
            answer, memory = answering(estimate, given, False, False, 0.0, memory)
            seconds.append(time.perf_counter() - begun)
            statuses[answer.status] = statuses.get(answer.status, 0) + 1
            (world, nominal), over = move(world, jnp.asarray(answer.action, world.evader.dtype), key)
            ended = bool(over)
        episode += 1
    return {
        "latency": spread(seconds),
        "throughput": {"value": len(seconds) / sum(seconds), "unit": "decisions/s"},
        "compile_seconds": compiling,
        "compiled": isinstance(answering, CompiledAnswering) and answering.compiled,
        "statuses": {str(status): count for status, count in sorted(statuses.items())},
    }


def summary(results: list[dict[str, Any]]) -> dict[str, Any]:
    """p50, p99 and worst of each, in microseconds."""
    return {
        one["name"]: {key: one["latency"][key] for key in ("p50", "p99", "worst")}
        for one in results
        if "latency" in one
    }
