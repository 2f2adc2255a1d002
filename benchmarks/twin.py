"""Where do noise and delay take safety away on the physics twin, and did the certificate say so?

    python benchmarks/twin.py --out benchmarks/results/twin.json
    python benchmarks/twin.py --out FILE --bases omniwheels --scenarios roomy --blocks 2

A cell of the table is a scenario, a base of the evader, a noise of the measured positions (standard
deviation, m; headings are off by 0.25 degrees per mm) and a delay (s). Three scenarios, all with random
starts and one obstacle: `paper`, the paper's own numbers, which leave 0.8 mm, `roomy`, with a capture
distance of 0.15 m, and `wide`, with one of 0.1 m. The pursuer plays `nash` and sees the truth; poses come 100
times a second. Each episode is of 30 s at most, behind `joint` with the untrained policy. Beside the counts
of a cell stands the certificate's verdict for the bounds of exactly these errors (noise is cut at three
standard deviations), the slowness of the motors counted as delay. What it guarantees is the capture distance,
or less where it says so: a cell in which the evader was nearer than that would be one where it was too
optimistic.

Work is done in blocks of episodes and written down block by block: a run that was interrupted goes on where
it stopped, and one that is asked for more blocks adds them.
"""

import argparse
import math
import time
import warnings
from pathlib import Path
from typing import Any

import study_blocks
from machine import machine, versions
from sidestep.store.files import write_json

SCENARIOS = {"paper": {}, "roomy": {"capture_distance": 0.15}, "wide": {"capture_distance": 0.1}}
NOISES = (0.0, 0.002, 0.005, 0.01, 0.02)
DELAYS = (0.0, 0.01, 0.05, 0.1, 0.2)
_HEADING_PER_METRE = math.radians(0.25) / 0.001
_COUNTED = ("captured", "collided", "reached", "timed_out", "cut")

Job = tuple[str, str, float, float, int, int, dict[str, Any]]


def _scenario(name: str) -> Any:
    from sidestep.world import load_scenario

    return load_scenario("paper", **SCENARIOS[name])


def _options(base: str, noise: float, delay: float) -> Any:
    from sidestep.plants.ground import Sensors, TwinOptions

    sensors = Sensors(
        rate=100.0,
        position_noise=noise,
        heading_noise=_HEADING_PER_METRE * noise,
        delay=delay,
        synchronised=True,
    )
    return TwinOptions(base=base, sensors=sensors)


def verdict(scenario: str, noise: float, delay: float) -> dict[str, Any]:
    """What the certificate says of a cell."""
    from sidestep.plants.ground import bounded_errors
    from sidestep.safety import certify

    chosen = _scenario(scenario)
    errors: dict[str, Any] = bounded_errors(chosen, _options("servo", noise, delay))
    certificate = certify(chosen, **errors, check_shield=False)
    return {
        "scenario": scenario,
        "noise": noise,
        "delay": delay,
        "errors": errors,
        "guaranteed": certificate.guaranteed,
        "guaranteed_clearance": certificate.guaranteed_clearance,
    }


def run_block(job: Job) -> dict[str, Any]:
    """A block of episodes: (scenario, base, noise, delay, block, episodes, settings) to its counts."""
    scenario, base, noise, delay, block, episodes, settings = job
    from sidestep.plants.ground import settings_for, twin_episode
    from sidestep.robot import Onboard
    from sidestep.safety.barriers.budget import BudgetWarning

    begun = time.perf_counter()
    chosen, options = _scenario(scenario), _options(base, noise, delay)
    figures = []
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", BudgetWarning)
        onboard = Onboard(chosen, settings["shield"], "goal-seeking", settings_for(options))
        for number in range(episodes):
            seed = settings["seed"] + block * episodes + number
            episode = twin_episode(onboard, settings["pursuer"], seed, options, settings["steps"])
            figures.append(episode.to_dict())
    counts = {name: sum(one["outcome"] == name for one in figures) for name in _COUNTED}
    return {
        "scenario": scenario,
        "base": base,
        "noise": noise,
        "delay": delay,
        "block": block,
        "episodes": episodes,
        **counts,
        "least_pursuer_distance": min(one["least_pursuer_distance"] for one in figures),
        "least_obstacle_distance": min(one["least_obstacle_distance"] for one in figures),
        "lost": [one["seed"] for one in figures if one["outcome"] in ("captured", "collided")],
        "seconds": time.perf_counter() - begun,
    }


def _cell(block: dict[str, Any]) -> tuple[Any, ...]:
    return tuple(block[name] for name in ("scenario", "base", "noise", "delay"))


def summary(blocks: list[dict[str, Any]], verdicts: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """One entry per cell: counts, 95 % bounds, least distances, and what the certificate said."""
    from sidestep.trials import wilson_interval

    said = {(one["scenario"], one["noise"], one["delay"]): one for one in verdicts}
    cells = []
    for cell in sorted(set(map(_cell, blocks))):
        mine = [block for block in blocks if _cell(block) == cell]
        scenario, base, noise, delay = cell
        entry: dict[str, Any] = {"scenario": scenario, "base": base, "noise": noise, "delay": delay}
        for name in ("episodes", *_COUNTED):
            entry[name] = sum(block[name] for block in mine)
        for name in ("captured", "collided", "reached"):
            low, high = wilson_interval(entry[name], entry["episodes"])
            entry |= {f"{name}_rate_low": low, f"{name}_rate_high": high}
        for name in ("least_pursuer_distance", "least_obstacle_distance"):
            entry[name] = min(block[name] for block in mine)
        verdict = said[(scenario, noise, delay)]
        entry["guaranteed"] = verdict["guaranteed"]
        entry["guaranteed_clearance"] = verdict["guaranteed_clearance"]
        kept = min(verdict["guaranteed_clearance"], float(_scenario(scenario).capture_distance))
        entry["optimistic"] = entry["least_pursuer_distance"] < kept
        cells.append(entry)
    return cells


def _write(path: Path, settings: dict[str, Any], blocks: list[Any], verdicts: list[Any]) -> None:
    report = {
        "what": "episodes on the physics twin over noise and delay, beside the certificate's verdict",
        "settings": settings,
        "machine": machine(),
        "versions": versions("mujoco"),
        "cells": summary(blocks, verdicts),
        "verdicts": verdicts,
        "blocks": sorted(blocks, key=lambda block: (*_cell(block), block["block"])),
    }
    write_json(path, report)


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--scenarios", nargs="*", default=list(SCENARIOS), choices=list(SCENARIOS))
    parser.add_argument("--bases", nargs="*", default=["servo"], choices=["servo", "omniwheels"])
    parser.add_argument("--noises", nargs="*", type=float, default=list(NOISES), help="m")
    parser.add_argument("--delays", nargs="*", type=float, default=list(DELAYS), help="s")
    parser.add_argument("--blocks", type=int, default=2, help="blocks for each cell")
    parser.add_argument("--block", type=int, default=10, help="episodes in a block")
    parser.add_argument("--steps", type=int, default=600, help="control periods at most")
    parser.add_argument("--shield", default="joint")
    parser.add_argument("--pursuer", default="nash")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--processes", type=int, default=1)
    arguments = parser.parse_args()

    settings = {
        "shield": arguments.shield, "pursuer": arguments.pursuer, "policy": "goal-seeking",
        "seed": arguments.seed, "episodes_per_block": arguments.block, "steps": arguments.steps,
    }  # fmt: skip
    earlier = study_blocks.earlier(arguments.out, settings)
    blocks: list[dict[str, Any]] = earlier.get("blocks", [])
    verdicts: list[dict[str, Any]] = earlier.get("verdicts", [])
    done = {(*_cell(block), block["block"]) for block in blocks}
    judged = {(one["scenario"], one["noise"], one["delay"]) for one in verdicts}
    # Block by block over all cells: an interrupted run has the whole table, of fewer episodes.
    jobs: list[Job] = [
        (scenario, base, noise, delay, block, arguments.block, settings)
        for block in range(arguments.blocks)
        for scenario in arguments.scenarios
        for base in arguments.bases
        for noise in arguments.noises
        for delay in arguments.delays
        if (scenario, base, noise, delay, block) not in done
    ]
    print(f"{len(done)} blocks are done, {len(jobs)} to do, {arguments.block} episodes each", flush=True)
    try:
        for scenario, _, noise, delay, *_ in jobs:
            if (scenario, noise, delay) not in judged:
                judged.add((scenario, noise, delay))
                verdicts.append(verdict(scenario, noise, delay))
        begun = time.perf_counter()
        for count, result in enumerate(study_blocks.results(run_block, jobs, arguments.processes), 1):
            blocks.append(result)
            _write(arguments.out, settings, blocks, verdicts)
            left = (time.perf_counter() - begun) / count * (len(jobs) - count)
            print(
                f"{result['scenario']:>6} {result['base']:>10} noise {1e3 * result['noise']:g} mm, "
                f"delay {1e3 * result['delay']:g} ms: "
                f"{result['captured']} captured, {result['collided']} collided, "
                f"{result['reached']} reached of {result['episodes']}, least "
                f"{result['least_pursuer_distance']:.4f} m, {left / 60:.0f} min left",
                flush=True,
            )
    except KeyboardInterrupt:
        print(f"interrupted; the same command goes on after the {len(blocks)} blocks in {arguments.out}")
    _print_table(summary(blocks, verdicts))


def _words(cell: dict[str, Any] | None) -> str:
    if cell is None:
        return "-"
    return f"{cell['captured']} + {cell['collided']} of {cell['episodes']}{'*' * cell['guaranteed']}"


def _print_table(cells: list[dict[str, Any]]) -> None:
    """Captured and collided of all episodes in each cell; `*` where the certificate excludes capture."""
    for scenario, base in dict.fromkeys((cell["scenario"], cell["base"]) for cell in cells):
        mine = [cell for cell in cells if (cell["scenario"], cell["base"]) == (scenario, base)]
        delays = sorted({cell["delay"] for cell in mine})
        print(
            f"\n{scenario}, {base}: captured + collided of episodes (* capture excluded by the certificate)"
        )
        print("noise, mm \\ delay, ms " + "".join(f"{1e3 * delay:>14g}" for delay in delays))
        for noise in sorted({cell["noise"] for cell in mine}):
            row = {cell["delay"]: cell for cell in mine if cell["noise"] == noise}
            words = [_words(row.get(delay)) for delay in delays]
            print(f"{1e3 * noise:>21g} " + "".join(f"{word:>14}" for word in words))
    wrong = sum(cell["optimistic"] for cell in cells)
    print(f"\n{wrong} cells in which the certificate was too optimistic")


if __name__ == "__main__":
    main()
