"""How far away must a straight wall be? Its clearance table, by how long the evader is to stay free.

    python benchmarks/clearance_wall.py --json benchmarks/results/clearance-wall.json

The evader (0.1574 m/s) must stay 0.1 m from the wall; pursuer, axle and period as in the paper, without
anything to spare. Against a faster pursuer no distance does for ever. There it says, for several capture
distances and two grids, the largest clearance for every two seconds more, the rise at the end (m/s) and the
worst state. Against slower ones it solves for ever, and asks whether the table keeps its promise (see
`clearance.py`). A run that is stopped goes on with the cases that its JSON lacks.
"""

from __future__ import annotations

import argparse
import json
import math
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

import sidestep
from clearance import best_margins, boundary
from sidestep.safety.clearance import ClearanceGame, ClearanceTable, Resolution, Solution, solve
from sidestep.store.files import write_json

ROUGH = Resolution(
    height=0.006, growth=1.5, farthest=0.5, share=0.04, share_growth=1.7, bearings=6, angles=48, ridge=0.06,
    headings=24, turns=3,
)  # fmt: skip
GRIDS = {
    "rough": ROUGH,
    "coarse": replace(
        ROUGH, height=0.003, growth=1.25, share=0.02, share_growth=1.5, bearings=10, angles=72, ridge=0.04
    ),
}
SECONDS = 10.0
MOST = 1.3
EVADER_SPEED = 0.1574


def game(speed: float, level: float) -> ClearanceGame:
    """A pursuer of this speed (m/s) beside a wall, at this capture distance (m)."""
    scenario = sidestep.load_scenario("paper", capture_distance=level)
    one = ClearanceGame.of(scenario, angle=math.radians(30.0) if speed < EVADER_SPEED else None)
    return replace(one, pursuer_speed=speed, collision_distance=0.1, obstacle_speed=0.0, wall=True)


def worst(solution: Solution) -> dict[str, Any]:
    """The state with the largest clearance."""
    node, angle = np.unravel_index(np.argmax(solution.clearance), solution.clearance.shape)
    phi = float(solution.ridge[node] + solution.directions.nodes[angle])
    return {
        "largest clearance, m": float(solution.clearance[node, angle]),
        "worst z, m": solution.grid.points[node].tolist(),
        "worst direction of p, deg": math.degrees(math.remainder(phi, 2.0 * math.pi)),
    }


def for_a_time(one: ClearanceGame, resolution: Resolution) -> dict[str, Any]:
    """The largest clearance by the time for which it does."""
    needed: dict[str, float] = {}
    step = round(2.0 / one.control_period)

    def note(solution: Solution) -> None:
        if solution.stage == 2 and solution.sweeps % step == 0:
            needed[f"{solution.sweeps * one.control_period:g}"] = float(np.max(solution.clearance))

    solved = solve(one, resolution, periods=round(SECONDS / one.control_period), most=MOST, progress=note)
    last = list(needed.values())[-2:]
    return {
        "clearance by time, s: m": needed,
        "rise at the end, m/s": (last[1] - last[0]) / 2.0,
        **worst(solved),
    }


def for_ever(one: ClearanceGame, resolution: Resolution) -> dict[str, Any]:
    """The table against a slower pursuer, and how well it keeps its promise."""
    solved = solve(one, resolution, most=MOST)
    table = ClearanceTable.of(one, solved)
    margins = best_margins(table, *boundary(table, 4000, seed=0), 0.0)
    return {
        "sweeps": solved.sweeps,
        "change, m": solved.change,
        **worst(solved),
        "boundary states": len(margins),
        "kept share": float(np.mean(margins >= 0.0)),
        "worst margin, m": float(np.min(margins)),
    }


def main() -> None:
    """Solve case after case, print, and write JSON after each."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--capture-distances", type=float, nargs="*", default=[0.10, 0.15, 0.05])
    parser.add_argument("--slower", type=float, nargs="*", default=[0.10, 0.12, 0.14], help="m/s")
    parser.add_argument("--json", type=Path, required=True)
    asked = parser.parse_args()
    results: dict[str, Any] = json.loads(asked.json.read_text()) if asked.json.exists() else {}
    cases = [(0.1, speed, name) for speed in asked.slower for name in GRIDS]
    cases += [(level, 0.2, name) for name in GRIDS for level in asked.capture_distances]
    for level, speed, name in cases:
        key = f"l {level:g} m, V {speed:g} m/s, {name}"
        if key in results:
            continue
        begun, one = time.perf_counter(), game(speed, level)
        study = for_a_time if speed > EVADER_SPEED else for_ever
        figures = {"game": one.as_dict, **study(one, GRIDS[name])}
        results[key] = {**figures, "seconds": time.perf_counter() - begun}
        print(f"{key}: {results[key]}", flush=True)
        write_json(asked.json, results)


if __name__ == "__main__":
    main()
