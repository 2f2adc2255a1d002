"""What control period, errors and delay cost at the paper's setting, and the certified law under attack.

    python benchmarks/certificate.py --out benchmarks/results/certificate.json

For each case: the clearance that is guaranteed, what of l_max it costs, and how much the bound may give away
(the lowest level that a real motion was found to break, less the certified one). For each control period also
what the shipped `game` shield keeps. Then the law is played at its certified level against greedy pursuers,
and a hundredth above it, where it must break, or else the attack would prove nothing.
"""

import argparse
import dataclasses
import time
from pathlib import Path
from typing import Any

from machine import machine
from sidestep.safety.certificate.greedy_chase import chase
from sidestep.safety.certificate.shield_check import shield_level
from sidestep.safety.sampled.sampled_design import (
    FINE,
    best_design,
    broken_level,
    delay_cost,
    holds,
    largest_true,
    spare,
)
from sidestep.safety.sampled.sampled_game import Design, SampledGame
from sidestep.store.files import write_json
from sidestep.world import load_scenario

PAPER = SampledGame(evader_speed=0.1574, pursuer_speed=0.2, half_axle=0.2, control_period=0.05)
PERIODS = (0.001, 0.006, 0.01, 0.02, 0.05, 0.1, 0.2)
ERRORS: tuple[dict[str, float], ...] = (
    {"position_error": 1e-3},
    {"position_error": 5e-3},
    {"heading_error": 0.01},
    {"heading_error": 0.05},
    {"delay": 0.05},
    {"position_error": 2e-3, "heading_error": 0.01, "delay": 0.05},
)


def certified(game: SampledGame) -> tuple[Design, dict[str, Any]]:
    design = best_design(game)
    assert design is not None
    clearance = design.level - delay_cost(game)
    return design, {
        **{field.name: getattr(game, field.name) for field in dataclasses.fields(game)},
        "clearance": clearance,
        "cost": game.largest_capture_distance - clearance,
        "unsure": broken_level(game, design) - design.level,
        "angle": design.angle,
    }


def attacked(game: SampledGame, design: Design, seed: int, periods: int) -> dict[str, Any]:
    played = [
        chase(game, design, seed=seed + k, periods=periods, segments=k, games=200, motions=150)
        for k in (2, 3, 5)
    ]
    higher = Design(game.usable_angle, 1.01 * design.level)
    above = chase(game, higher, seed=seed, periods=periods // 4, segments=2, games=200, motions=150)
    return {
        "decisions": sum(entry.decisions for entry in played),
        "least_value_above_level": min(entry.least_value for entry in played) - design.level,
        "least_distance_above_level": min(entry.least_distance for entry in played) - design.level,
        "a_hundredth_higher": above.least_value - higher.level,
    }


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--out", type=Path)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--periods", type=int, default=500, help="control periods of every game under attack")
    options = parser.parse_args()
    began, rows = time.perf_counter(), []
    for changes in [*({"control_period": period} for period in PERIODS), *ERRORS]:
        game = dataclasses.replace(PAPER, **changes)
        design, row = certified(game)
        row |= {"changed": changes, **attacked(game, design, options.seed, options.periods)}
        if "control_period" in changes:
            kept = shield_level(load_scenario("paper", **changes))
            row |= {"shield": kept.level, "shield_error": kept.error}
        rows.append(row)
        print(
            f"{changes}: keeps {row['clearance']:.6f} m, {1e3 * row['cost']:.3f} mm less than l_max "
            f"(at most {1e6 * row['unsure']:.0f} um more); {row['decisions']} decisions under attack, least "
            f"{1e6 * row['least_value_above_level']:+.3f} um, 1 % higher "
            f"{1e6 * row['a_hundredth_higher']:+.0f} um"
            + (f"; game shield {row['shield']:.4f} m" if "shield" in row else ""),
            flush=True,
        )
    longest = largest_true(
        lambda period: spare(dataclasses.replace(PAPER, control_period=period), 0.2, FINE), 1e-3, 0.05, 1e-5
    )
    assert holds(dataclasses.replace(PAPER, control_period=longest), 0.2, FINE)
    print(f"longest period for the paper's own 0.2 m: {1e3 * longest:.2f} ms")
    guarded = shield_level(load_scenario("paper", capture_distance=0.198))
    print(f"game shield set to 0.198 m at 20 Hz keeps {guarded.level:.4f} m")
    if options.out is not None:
        result = {
            "rows": rows,
            "longest_period": longest,
            "shield_at_0.198": dataclasses.asdict(guarded),
            "seed": options.seed,
            "seconds": time.perf_counter() - began,
            "machine": machine(),
        }
        write_json(options.out, result)


if __name__ == "__main__":
    main()
