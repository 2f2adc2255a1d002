"""What an accelerator does per second: worlds, filters, decisions of `joint`, trainings side by side.

Runs only where `jax.default_backend()` is one; elsewhere each case is one line that says so.
"""

from __future__ import annotations

from typing import Any

from speed.children import Case
from speed.timing import durations, first_call, spread

CASES: dict[str, dict[str, Any]] = {
    "worlds, game shield": {"kind": "worlds", "shield": "game", "size": 1_048_576, "periods": 20},
    "worlds, joint shield": {"kind": "worlds", "shield": "joint", "size": 16_384, "periods": 5},
    "filter, 2 rows": {"kind": "filter", "rows": 2, "size": 4_194_304},
    "filter, 8 rows": {"kind": "filter", "rows": 8, "size": 1_048_576},
    "training, 1 seed": {"kind": "training", "size": 1},
    "training, 64 seeds": {"kind": "training", "size": 64},
    "training, 4096 worlds": {"kind": "training", "size": 4096, "hidden": [64, 64]},
}


def cases(quick: bool) -> list[Case]:
    """All, or none but one tiny case."""
    # The caller's machine decides the platform here; everywhere else it is the CPU.
    platform = {"JAX_PLATFORMS": ""}
    if quick:
        return [
            Case("gpu", "filter, 2 rows", {"kind": "filter", "rows": 2, "size": 64, "seconds": 0.1},
                 environment=platform)
        ]  # fmt: skip
    return [
        Case("gpu", name, {**settings, "seconds": 5.0}, environment=platform)
        for name, settings in CASES.items()
    ]


def run(settings: dict[str, Any]) -> dict[str, Any]:
    """Per second of whatever the case counts; on a CPU only what is said in its place."""
    import jax

    device = jax.devices()[0]
    if jax.default_backend() == "cpu" and not settings.get("even_without"):
        return {"missing": "no accelerator: jax.default_backend() is cpu"}
    call, count, unit = _WORK[settings["kind"]](settings)
    _, compiling = first_call(lambda: call(0))
    seconds = durations(call, settings["seconds"])
    memory = device.memory_stats() or {}
    return {
        "device": device.device_kind,
        "latency": spread(seconds, "ms"),
        "throughput": {"value": count / (sum(seconds) / len(seconds)), "unit": unit},
        "compile_seconds": compiling,
        "device_peak_mib": memory.get("peak_bytes_in_use", 0) / 2**20,
    }


def _worlds(settings: dict[str, Any]) -> tuple[Any, int, str]:
    from sidestep.world import load_scenario
    from speed.worlds import drawn, stepper

    scenario, size, periods = load_scenario("paper"), settings["size"], settings["periods"]
    starts = drawn(scenario, size)
    advance = stepper(scenario, settings["shield"], "turn-then-drive", starts, periods)
    return lambda _: advance(), size * periods, "decisions/s" if settings["shield"] == "joint" else "steps/s"


def _filter(settings: dict[str, Any]) -> tuple[Any, int, str]:
    from speed.filter import make_side
    from speed.filter_problems import problems

    side = make_side("ours", problems(settings["size"], settings["rows"]))
    return lambda _: side.batch(), settings["size"], "problems/s"


def _training(settings: dict[str, Any]) -> tuple[Any, int, str]:
    """So many trainings at once, each with a world, networks and a replay of its own."""
    import equinox as eqx
    import jax
    import jax.numpy as jnp

    from sidestep.learning import decide_and_learn, make_options, start
    from sidestep.pursuit import make_pursuer
    from sidestep.safety import make_shield
    from sidestep.world import load_scenario

    scenario, steps, size = load_scenario("paper"), 20, settings["size"]
    options = make_options(
        decision_steps=1,
        updates_per_decision=1,
        batch_size=64 if size > 64 else 256,
        hidden=settings.get("hidden", [256, 256]),
        warmup_decisions=1,
    )
    shield, pursuer = make_shield("game", scenario), make_pursuer("turn-then-drive")
    keys, forever = jax.random.split(jax.random.key(0), size), jnp.asarray(2**30)
    states = eqx.filter_vmap(lambda key: start(scenario, shield, options, key, 1_000))(keys)

    @eqx.filter_jit
    def advance(states: Any) -> Any:
        one = lambda state: decide_and_learn(scenario, shield, pursuer, options, state, forever)[0]  # noqa: E731
        return jax.lax.scan(lambda s, _: (eqx.filter_vmap(one)(s), None), states, None, length=steps)[0]

    def call(_: int) -> None:
        nonlocal states
        states = jax.block_until_ready(advance(states))

    return call, size * steps, "updates/s"


_WORK = {"worlds": _worlds, "filter": _filter, "training": _training}


def summary(results: list[dict[str, Any]]) -> dict[str, Any]:
    """What each case did per second, or why there is nothing."""
    found = {one["name"]: one["throughput"]["value"] for one in results if "throughput" in one}
    if found:
        return {"per_second": found}
    reasons = [one[key] for one in results for key in ("missing", "error") if key in one]
    return {"nothing_measured": reasons[0] if reasons else "no case"}
