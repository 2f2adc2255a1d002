"""One decision of a shield at a time, as on a robot: over whole episodes, every call timed.

The evader heads for the target, the pursuer is `nash`. The call is the compiled shield,
`equinox.filter_jit(shield)`, dispatched synchronously and waited for; the pursuer and the physics between two
calls are not timed.
"""

from __future__ import annotations

import time
from typing import Any

from speed.children import Case
from speed.process import synchronous_dispatch
from speed.timing import first_call, spread

PURSUER = "nash"
MOST_EPISODES = 1000


def cases(quick: bool) -> list[Case]:
    """The shield `joint`, its two forms alone, and `game` beside it."""
    amount = {"seconds": 0.2, "decisions": 20} if quick else {"seconds": 20.0, "decisions": 20_000}
    kinds = {
        "joint shield": ("joint", "paper"),
        "joint shield, looking ahead": ("joint:look-ahead", "paper"),
        "joint shield, by its table": ("joint:table", "paper-0.15"),
        "game shield": ("game", "paper"),
    }
    return [
        Case("joint", name, {"shield": shield, "scenario": scenario, **amount, "pursuer": PURSUER}, threads=1)
        for name, (shield, scenario) in kinds.items()
        if not (quick and shield in ("joint", "joint:look-ahead"))
    ]


def run(settings: dict[str, Any]) -> dict[str, Any]:
    """Microseconds of each decision."""
    import equinox as eqx
    import jax
    import jax.numpy as jnp

    from sidestep.pursuit import make_pursuer, pursue
    from sidestep.safety import make_shield
    from sidestep.world import load_scenario, to_velocity
    from speed.worlds import AHEAD

    synchronous_dispatch()
    scenario = load_scenario(settings["scenario"])
    shield, pursuer = make_shield(settings["shield"], scenario), make_pursuer(PURSUER)

    @eqx.filter_jit
    def begin(key: Any) -> Any:
        world = scenario.reset(key)
        return world, shield.init(world)

    @eqx.filter_jit
    def nominal_of(world: Any) -> Any:
        return to_velocity(scenario, world, jnp.asarray(AHEAD, world.evader.dtype))

    @eqx.filter_jit
    def move(world: Any, action: Any, key: Any) -> Any:
        moved, events = scenario.step(world, action, pursue(scenario, pursuer, world, key))
        return moved, events.terminated | events.truncated

    decide, key = eqx.filter_jit(shield), jax.random.key(0)
    world, memory = begin(key)
    nominal = jax.block_until_ready(nominal_of(world))
    (result, _), compiling = first_call(lambda: jax.block_until_ready(decide(world, nominal, memory)))
    jax.block_until_ready(move(world, result.action, key))

    seconds: list[float] = []
    statuses: dict[int, int] = {}
    worst_at: tuple[float, int, int] = (0.0, 0, 0)
    end, episode = time.perf_counter() + settings["seconds"], 0
    while episode < MOST_EPISODES:
        start_key, key = jax.random.split(jax.random.fold_in(jax.random.key(0), episode))
        world, memory = begin(start_key)
        ended, period = False, 0
        while not ended:
            nominal = jax.block_until_ready(nominal_of(world))
            begun = time.perf_counter()
            result, memory = jax.block_until_ready(decide(world, nominal, memory))
            spent = time.perf_counter() - begun
            seconds.append(spent)
            worst_at = max(worst_at, (spent, episode, period))
            statuses[int(result.status)] = statuses.get(int(result.status), 0) + 1
            world, over = jax.block_until_ready(move(world, result.action, key))
            ended, period = bool(over), period + 1
            if len(seconds) >= settings["decisions"] or time.perf_counter() > end:
                episode, ended = MOST_EPISODES, True
        episode += 1
    return {
        "latency": spread(seconds),
        "throughput": {"value": len(seconds) / sum(seconds), "unit": "decisions/s"},
        "compile_seconds": compiling,
        "statuses": {str(status): count for status, count in sorted(statuses.items())},
        "worst_at": {"episode": worst_at[1], "period": worst_at[2]},
    }


def summary(results: list[dict[str, Any]]) -> dict[str, Any]:
    """p50, p99 and worst of each, in milliseconds."""
    return {
        one["name"]: {key: one["latency"][key] / 1000.0 for key in ("p50", "p99", "worst")}
        for one in results
        if "latency" in one
    }
