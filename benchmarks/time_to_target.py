"""Does learning help? Time to the target of a policy beside driving straight there, behind the same shield.

    python benchmarks/time_to_target.py pretrained --episodes 300 --out benchmarks/results/time_to_target.json
    python benchmarks/time_to_target.py runs/mine --shield game --pursuers nash interceptor --out mine.json

What is compared, and how, is what `sidestep evaluate RUN` prints (`sidestep.trials.yardsticks`), here for
many pursuers; trained ones go by their run folders. `straight` is the time straight there at full speed,
which nobody can beat. The training of `pretrained` meets none of the last four: the `chauffeur`, the
falsifier's `herder` and `sideswiper`, and the `hunter`, which has learned against it. An interrupted study
goes on where it stopped.
"""

import argparse
import dataclasses
import time
from pathlib import Path
from typing import Any

import jax.numpy as jnp

import study_blocks
from attack_pursuers import pursuer_named
from machine import machine, versions
from sidestep.commands.common import policy_and_scenario
from sidestep.pursuit import PURSUERS
from sidestep.store.files import write_json
from sidestep.trials import take_yardsticks
from sidestep.trials.falsification.attackers import herder
from sidestep.trials.yardsticks import time_figures

HELD_OUT = ("chauffeur", "herder", "sideswiper", "hunter")
LIMIT = 120.0


def pursuer(name: str) -> Any:
    """A built-in pursuer, or an attacking one; the herder herds towards the target."""
    return herder((jnp.asarray(True), jnp.asarray(0.6))) if name == "herder" else pursuer_named(name)


def main() -> int:
    """Run the study; returns the exit status."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("run", help="run folder, policy.npz, or pretrained")
    parser.add_argument("--shield", default="joint")
    parser.add_argument("--pursuers", nargs="*", default=[*PURSUERS, *HELD_OUT], metavar="NAME")
    parser.add_argument("--episodes", type=int, default=300)
    parser.add_argument("--seed", type=int, default=1_000_000)
    parser.add_argument("--planner", action="store_true", help="also measure the planner")
    parser.add_argument("--set", nargs="*", default=[], metavar="NAME=VALUE", help="scenario fields")
    parser.add_argument("--out", type=Path, required=True)
    arguments = parser.parse_args()
    policy, scenario, _ = policy_and_scenario(arguments.run, None, tuple(arguments.set))
    steps = round(LIMIT / float(scenario.control_period))
    scenario = dataclasses.replace(scenario, episode_steps=steps)
    settings = {
        "run": arguments.run, "shield": arguments.shield, "episodes": arguments.episodes,
        "seed": arguments.seed, "set": arguments.set, "planner": arguments.planner, "time_limit": LIMIT,
    }  # fmt: skip
    study = study_blocks.earlier(arguments.out, settings) or {"settings": settings, "pursuers": {}}
    for name in arguments.pursuers:
        if name in study["pursuers"]:
            continue
        begun = time.perf_counter()
        yardsticks = take_yardsticks(
            scenario, policy, arguments.shield, pursuer(name), arguments.episodes, arguments.seed,
            planner=arguments.planner,
        )  # fmt: skip
        study["pursuers"][name] = {
            "policy": time_figures(yardsticks.evaluation),
            **yardsticks.to_dict(),
            "straight": yardsticks.evaluation.to_dict()["straight_time_mean"],
            "seconds": time.perf_counter() - begun,
        }
        study |= {"machine": machine(), "versions": versions()}
        write_json(arguments.out, study)
        line = study["pursuers"][name]
        words = [
            f"{label} {line[label]['time_mean']:.1f} s ({line[label]['reached']} reached, "
            f"{line[label]['intervention_rate']:.0%} corrected)"
            for label in ("policy", "goal-seeking", "planner")
            if label in line
        ]
        less = line["goal-seeking"]["difference"]
        words.append(f"difference to goal-seeking {less['low']:+.1f} to {less['high']:+.1f} s")
        if line["share_of_planner"] is not None:
            words.append(f"{line['share_of_planner']['estimate']:.0%} of the way to the planner")
        print(f"{name:20s} {', '.join(words)}", flush=True)
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
