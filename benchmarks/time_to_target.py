"""Does learning help? Time to the target of a policy beside driving straight there, behind the same shield.

    python benchmarks/time_to_target.py pretrained --episodes 300 --out benchmarks/results/time_to_target.json
    python benchmarks/time_to_target.py runs/mine --shield game --pursuers nash interceptor --out mine.json

Both policies get the same starts, targets and pursuers. An episode that did not reach the target, for
whatever reason, counts as the time limit. `straight` is the time straight there at full speed, which nobody
can beat. The difference is that of each start, with a 95 % bootstrap interval. No training meets the
`chauffeur` and the falsifier's `herder` and `sideswiper`. An interrupted study goes on where it stopped.
"""

import argparse
import dataclasses
import time
from pathlib import Path
from typing import Any

import jax.numpy as jnp
import numpy as np

import study_blocks
from machine import machine, versions
from sidestep.commands.common import policy_and_scenario
from sidestep.pursuit import PURSUERS, make_pursuer
from sidestep.store.files import write_json
from sidestep.trials import Evaluation, evaluate
from sidestep.trials.falsification.attackers import herder, sideswiper
from sidestep.trials.statistics import stratified_bootstrap

HELD_OUT = ("chauffeur", "herder", "sideswiper")
LIMIT = 120.0


def pursuer_named(name: str) -> Any:
    """A built-in pursuer, or one of the falsifier's."""
    if name == "herder":
        return herder((jnp.asarray(True), jnp.asarray(0.6)))
    if name == "sideswiper":
        return sideswiper((jnp.asarray(0.6), jnp.asarray(0.3)))
    return make_pursuer(name)


def figures(evaluation: Evaluation) -> dict[str, Any]:
    """What is told of one policy."""
    every = evaluation.to_dict()
    names = ("captured", "collided", "reached", "timed_out", "time_mean", "reached_by", "intervention_rate")
    return {name: every[name] for name in names}


def main() -> int:
    """Run the study; returns the exit status."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("run", help="run folder, policy.npz, or pretrained")
    parser.add_argument("--shield", default="joint")
    parser.add_argument("--pursuers", nargs="*", default=[*PURSUERS, *HELD_OUT], metavar="NAME")
    parser.add_argument("--episodes", type=int, default=300)
    parser.add_argument("--seed", type=int, default=1_000_000)
    parser.add_argument("--set", nargs="*", default=[], metavar="NAME=VALUE", help="scenario fields")
    parser.add_argument("--out", type=Path, required=True)
    arguments = parser.parse_args()
    policy, scenario, _ = policy_and_scenario(arguments.run, None, tuple(arguments.set))
    steps = round(LIMIT / float(scenario.control_period))
    scenario = dataclasses.replace(scenario, episode_steps=steps)
    settings = {
        "run": arguments.run, "shield": arguments.shield, "episodes": arguments.episodes,
        "seed": arguments.seed, "set": arguments.set, "time_limit": LIMIT,
    }  # fmt: skip
    study = study_blocks.earlier(arguments.out, settings) or {"settings": settings, "pursuers": {}}
    for name in arguments.pursuers:
        if name in study["pursuers"]:
            continue
        begun = time.perf_counter()
        found = {
            label: evaluate(
                scenario, driver, arguments.shield, pursuer_named(name), arguments.episodes, arguments.seed
            )
            for label, driver in (("policy", policy), ("goal-seeking", "goal-seeking"))
        }
        one, other = found["policy"].times_to_target, found["goal-seeking"].times_to_target
        straight = found["policy"].straight_times
        assert straight is not None
        study["pursuers"][name] = {
            **{label: figures(evaluation) for label, evaluation in found.items()},
            "difference": stratified_bootstrap([one - other], np.mean)._asdict(),
            "ratio": float(np.mean(one) / np.mean(other)),
            "straight": float(np.mean(straight)),
            "seconds": time.perf_counter() - begun,
        }
        study |= {"machine": machine(), "versions": versions()}
        write_json(arguments.out, study)
        line = study["pursuers"][name]
        print(
            f"{name:20s} policy {line['policy']['time_mean']:6.1f} s ({line['policy']['reached']} reached, "
            f"{line['policy']['intervention_rate']:.0%} corrected), goal-seeking "
            f"{line['goal-seeking']['time_mean']:6.1f} s ({line['goal-seeking']['reached']}, "
            f"{line['goal-seeking']['intervention_rate']:.0%}), difference "
            f"{line['difference']['low']:+.1f} to {line['difference']['high']:+.1f} s",
            flush=True,
        )
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
