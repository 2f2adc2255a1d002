"""Worlds with a pursuer, stepped: ours many at once, and the peer's one by one in a Gymnasium loop.

Ours are shared among as many threads as there are cores; the loop has one. Both live through the scenario
`paper` with the pursuer `turn-then-drive` and head straight for the target.
Ours is timed behind the shield `game` as well as without one; the Gymnasium environment has none.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from speed.children import Case
from speed.timing import durations, first_call, spread

PURSUER = "turn-then-drive"
SIDES = {"ours, game shield": "game", "ours, no shield": "none", "Gymnasium loop": None}


def cases(quick: bool) -> list[Case]:
    """Ours with and without a shield, and the loop."""
    amount = (
        {"seconds": 0.2, "worlds": 64, "periods": 5}
        if quick
        else {"seconds": 5.0, "worlds": 8192, "periods": 20}
    )
    return [Case("simulation", name, {"shield": shield, **amount}) for name, shield in SIDES.items()]


def run(settings: dict[str, Any]) -> dict[str, Any]:
    """Control periods of worlds per second."""
    if settings["shield"] is None:
        return _loop(settings["seconds"])
    from sidestep._threads import useful_threads
    from sidestep.world import load_scenario
    from speed.worlds import drawn, stepper

    worlds, periods = settings["worlds"], settings["periods"]
    scenario = load_scenario("paper")
    starts, threads = drawn(scenario, worlds), useful_threads(worlds)
    advance = stepper(scenario, settings["shield"], PURSUER, starts, periods, threads=threads)
    _, compiling = first_call(advance)
    seconds = durations(lambda _: advance(), settings["seconds"])
    per_period = [spent / periods for spent in seconds]
    return {
        "latency": spread(per_period, "ms"),
        "throughput": {"value": worlds / float(np.mean(per_period)), "unit": "steps/s"},
        "compile_seconds": max(0.0, compiling - float(np.median(seconds))),
    }


def _loop(budget: float) -> dict[str, Any]:
    from speed.gymnasium_task import make_environment

    environment = make_environment()
    action = np.array([1.0, 0.0], np.float32)
    environment.reset(seed=0)
    chunk = 500

    def go_on(_: int) -> None:
        for _ in range(chunk):
            _, _, terminated, truncated, _ = environment.step(action)
            if terminated or truncated:
                environment.reset()

    per_step = [spent / chunk for spent in durations(go_on, budget, least=3)]
    return {
        "latency": spread(per_step),
        "throughput": {"value": 1.0 / float(np.mean(per_step)), "unit": "steps/s"},
        "compile_seconds": 0.0,
    }


def summary(results: list[dict[str, Any]]) -> dict[str, Any]:
    """Steps per second of each side, and ours against the loop."""
    found = {one["name"]: one["throughput"]["value"] for one in results if "throughput" in one}
    loop = found.get("Gymnasium loop")
    ratios = {f"{name} / Gymnasium loop": value / loop for name, value in found.items() if loop}
    ratios.pop("Gymnasium loop / Gymnasium loop", None)
    return {"steps_per_second": found, "ratios": ratios}
