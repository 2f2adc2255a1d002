"""Which learner? The paper's TD3, many worlds, and PPO and SAC of Stable-Baselines3 and SAC of SBX.

    .venv-bench/bin/python benchmarks/learners.py --out learners.json --minutes 8 --seeds 10
    .venv-bench/bin/python benchmarks/learners.py --out learners.json --learners goal-seeking sb3-ppo

Ten seeds of all five take 7 hours to train on two cores, and as long to measure with 300 episodes.

Every learner has the same task, shield, pursuer, observation and minutes, compile time included. What it has
learned then drives behind `--trial-shield` against every pursuer, those too that no training meets; an
episode that does not arrive counts as 120 s. Printed for each learner: the interquartile mean of the mean
times with its stratified bootstrap interval, and for each pair the probability that one does better (Agarwal
et al., NeurIPS 2021). The environment is `make .venv-bench/.ready`. An interrupted study goes on where it
stopped; `goal-seeking`, which learns nothing, is measured beside them.
"""

from __future__ import annotations

import argparse
import dataclasses
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

import study_blocks
from machine import machine, versions
from sidestep import evaluate, load_scenario
from sidestep.learning import make_options, train
from sidestep.pursuit import PURSUERS
from sidestep.store.files import write_json
from sidestep.trials.campaign import compare
from sidestep.trials.yardsticks import time_figures
from speed.peers import peer
from time_to_target import HELD_OUT, LIMIT, pursuer

MANY = {
    "worlds": 64, "batch_size": 512, "updates_per_decision": 8, "hindsight": 0.2, "replay_capacity": 500_000,
    "actor_learning_rate": 1e-3, "critic_learning_rate": 1e-3, "exploration_noise": 0.3,
}  # fmt: skip
ENDLESS = 10_000_000
"""Episodes: the minutes end before."""


def ours(arguments: Any, scenario: Any, seed: int, **options: Any) -> Callable[..., Any]:
    """The policy of our learner after so many minutes."""
    end = time.perf_counter() + 60.0 * arguments.minutes

    def stop(_: Any) -> None:
        if time.perf_counter() > end:
            raise KeyboardInterrupt

    options = {"replay_capacity": 200_000, **options}
    training = train(
        scenario, shield=arguments.shield, pursuer=arguments.pursuer, seed=seed, episodes=ENDLESS,
        options=make_options(**options), progress=stop,
    )  # fmt: skip
    return training.policy


class Asked:
    """The answers of a model of Stable-Baselines3 or SBX, without exploration."""

    decision_steps = 10

    def __init__(self, model: Any):
        self.model = model

    def __call__(self, observation: np.ndarray) -> np.ndarray:
        """The action (2,) for one observation."""
        return np.asarray(
            self.model.predict(np.asarray(observation, np.float32), deterministic=True)[0], float
        )


def theirs(arguments: Any, scenario: Any, seed: int, kind: str) -> Callable[..., Any]:
    """The policy of a peer's learner after so many minutes."""
    from sidestep.bridges.gym.stable_baselines import PursuedVecEnv

    end = time.perf_counter() + 60.0 * arguments.minutes

    class Stop(peer("stable_baselines3.common.callbacks").BaseCallback):
        def _on_step(self) -> bool:
            return time.perf_counter() < end

    worlds = 256 if kind == "sb3-ppo" else 64
    env = peer("stable_baselines3.common.vec_env").VecMonitor(
        PursuedVecEnv(
            worlds, scenario=scenario, shield=arguments.shield, pursuer=arguments.pursuer, decision_steps=10,
            reward_scale=0.01,
        )
    )  # fmt: skip
    # What its authors' default is, but for batches as large as ours, two layers of 256, and an entropy that
    # does not outweigh the target.
    common = {"seed": seed, "gamma": 0.99}
    device = {} if kind == "sbx-sac" else {"device": "cpu"}
    if kind == "sb3-ppo":
        network = {"net_arch": [256, 256]}
        model = peer("stable_baselines3").PPO(
            "MlpPolicy", env, n_steps=64, batch_size=2048, learning_rate=1e-3, policy_kwargs=network,
            **device, **common,
        )  # fmt: skip
    else:
        off_policy = {
            "batch_size": 512, "learning_rate": 1e-3, "buffer_size": 500_000, "learning_starts": 256,
            "train_freq": 1, "gradient_steps": 8, "ent_coef": "auto_0.01",
        }  # fmt: skip
        package = peer("sbx" if kind == "sbx-sac" else "stable_baselines3")
        model = package.SAC("MlpPolicy", env, **device, **off_policy, **common)
    model.learn(10**9, callback=Stop())
    return Asked(model)


LEARNERS: dict[str, Callable[..., Any]] = {
    "goal-seeking": lambda arguments, scenario, seed: "goal-seeking",
    "paper": ours,
    "many-worlds": lambda arguments, scenario, seed: ours(arguments, scenario, seed, **MANY),
    "sb3-ppo": lambda arguments, scenario, seed: theirs(arguments, scenario, seed, "sb3-ppo"),
    "sb3-sac": lambda arguments, scenario, seed: theirs(arguments, scenario, seed, "sb3-sac"),
    "sbx-sac": lambda arguments, scenario, seed: theirs(arguments, scenario, seed, "sbx-sac"),
}


def main() -> int:
    """Run the study; returns the exit status."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument(
        "--learners", nargs="*", choices=list(LEARNERS), default=list(LEARNERS), metavar="NAME"
    )
    parser.add_argument("--minutes", type=float, default=8.0, help="of each training")
    parser.add_argument("--seeds", type=int, default=10)
    parser.add_argument("--shield", default="joint:table", help="to learn behind")
    parser.add_argument("--trial-shield", default="joint")
    parser.add_argument("--pursuer", default="mixed", help="to learn against")
    parser.add_argument("--pursuers", nargs="*", default=[*PURSUERS, *HELD_OUT], metavar="NAME")
    parser.add_argument("--episodes", type=int, default=300, help="to measure, against each pursuer")
    arguments = parser.parse_args()
    settings = {
        name: value for name, value in vars(arguments).items() if name not in ("out", "learners", "seeds")
    }
    study = study_blocks.earlier(arguments.out, settings) or {"settings": settings, "rows": []}
    scenario = load_scenario("paper", observation="motion")
    steps = round(LIMIT / float(scenario.control_period))
    scenario = dataclasses.replace(scenario, episode_steps=steps)
    for seed in range(arguments.seeds):
        for name in arguments.learners:
            done = {row["pursuer"] for row in study["rows"] if (row["learner"], row["seed"]) == (name, seed)}
            left = [other for other in arguments.pursuers if other not in done]
            if not left:
                continue
            policy = LEARNERS[name](arguments, scenario, seed)
            for other in left:
                figures = evaluate(
                    scenario, policy, arguments.trial_shield, pursuer(other), arguments.episodes, 1_000_000
                )
                row = {"learner": name, "seed": seed, "pursuer": other, **time_figures(figures)}
                study["rows"].append(row)
                print(f"{name:12s} seed {seed} {other:20s} {row['time_mean']:6.1f} s", flush=True)
                write_json(arguments.out, {**study, "machine": machine(), "versions": versions()})
    found = compare(study["rows"], ["learner"], "time_mean", lower_is_better=True)
    for group in found.groups:
        mean = group.interquartile_mean
        print(f"{group.labels['learner']:12s} {mean.estimate:6.1f} s ({mean.low:.1f} to {mean.high:.1f})")
    for pair in found.pairs:
        first, second, chance = pair.first["learner"], pair.second["learner"], pair.probability
        print(f"{first} better than {second}: {chance.estimate:.0%} ({chance.low:.0%} to {chance.high:.0%})")
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
