"""Is the quadrotor safe from the aircraft, in physics, and does it arrive?

    python benchmarks/quadrotor.py --json benchmarks/results/quadrotor.json

flies 50 seeds of the preset `quadrotor` (random starts, three columns) on MuJoCo for each shield, pursuer and
policy: the untrained one, and one that `sidestep train --scenario quadrotor --pursuer chauffeur` gives, which
is trained first unless `--run` names its folder. Every row of the table is what
`sidestep fly RUN --scenario quadrotor --seeds 50` prints. About 15 minutes on two cores.
"""

import argparse
import tempfile
from pathlib import Path
from typing import Any

import sidestep
from machine import load, machine, versions
from sidestep.commands.fly import flight_counts
from sidestep.learning import load_policy
from sidestep.learning import train as run_training
from sidestep.plants.air import FlightOptions, Pilot, certificate_of, errors_of, fly
from sidestep.store.files import write_json
from sidestep.world import load_scenario, scenario_to_dict

PURSUERS = ("chauffeur", "nash", "turn-while-driving")
KEPT = (
    "episodes", "captured", "collided", "reached", "timed_out", "captured_rate_high", "collided_rate_high",
    "least_pursuer_distance", "least_obstacle_distance", "within_assumptions", "lost_within_assumptions",
    "infeasible_periods", "tracking_error_max", "periods_not_normal",
)  # fmt: skip


def flights(pilot: Pilot, pursuer: str, seeds: int, certificate: Any) -> dict[str, Any]:
    """The counts over seeds, and what each flight that did not arrive came to."""
    figures = [fly(pilot, pursuer, seed, certificate=certificate).to_dict() for seed in range(seeds)]
    counts = flight_counts(figures)
    lost = [figure for figure in figures if figure["outcome"] != "reached"]
    return {name: counts[name] for name in KEPT} | {"not_reached": lost}


def main() -> None:
    plain = argparse.RawDescriptionHelpFormatter
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=plain)
    parser.add_argument("--run", type=Path, help="folder of a trained policy; trained here if not given")
    parser.add_argument("--seeds", type=int, default=50)
    parser.add_argument("--shields", nargs="*", default=["none", "game", "joint"])
    parser.add_argument("--pursuers", nargs="*", default=list(PURSUERS))
    parser.add_argument("--json", type=Path)
    arguments = parser.parse_args()
    scenario, options = load_scenario("quadrotor"), FlightOptions()
    certificate = certificate_of(scenario, options, check_shield=False)
    report: dict[str, Any] = {
        "machine": {**machine(), "load_before": load()},
        "versions": versions(),
        "scenario": scenario_to_dict(scenario),
        "budget": errors_of(options),
        "certificate": {
            "guaranteed": certificate.guaranteed,
            "guaranteed_clearance": certificate.guaranteed_clearance,
            "capture_distance": certificate.situation.capture_distance,
        },
        "flights": [],
    }
    with tempfile.TemporaryDirectory() as folder:
        run = arguments.run
        if run is None:
            run = Path(folder) / "run"
            training = run_training(scenario, shield="joint", pursuer="chauffeur", out=run)
            names = ("episodes", "safe_episodes", "reached", "converged_episode", "env_steps")
            report["training"] = {name: training.summary[name] for name in names}
            print(report["training"])
        policies = {"goal-seeking": sidestep.goal_seeking, "trained": load_policy(run)}
    for shield in arguments.shields:
        for name, policy in policies.items():
            pilot = Pilot(scenario, policy, shield, options)
            for pursuer in arguments.pursuers:
                row = {"shield": shield, "policy": name, "pursuer": pursuer}
                row |= flights(pilot, pursuer, arguments.seeds, certificate)
                report["flights"].append(row)
                words = {key: value for key, value in row.items() if key in KEPT}
                print(shield, name, pursuer, words, flush=True)
                if arguments.json is not None:
                    write_json(arguments.json, report)


if __name__ == "__main__":
    main()
