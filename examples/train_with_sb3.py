"""Stable-Baselines3 learns to reach the target behind our shield: TD3 or SAC, then episodes without noise.

    python -m pip install torch==2.13.0 && python -m pip install stable-baselines3 -e '.[gym]'  # in the clone
    python examples/train_with_sb3.py --algorithm sac

A quarter of an hour on two cores, most of it in PyTorch.
"""

import argparse
from collections import Counter

import gymnasium
import numpy as np
from stable_baselines3 import SAC, TD3
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.noise import NormalActionNoise

OUTCOMES = ("captured", "collided", "reached", "timed_out")


class Watched(gymnasium.Wrapper):
    """Counts how episodes end."""

    def __init__(self, env):
        super().__init__(env)
        self.outcomes = Counter()

    def step(self, action):
        observation, reward, terminated, truncated, info = self.env.step(action)
        self.outcomes.update(name for name in OUTCOMES if info[name])
        return observation, reward, terminated, truncated, info


def main():
    """Train, then count how episodes end."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--algorithm", choices=("td3", "sac"), default="td3")
    parser.add_argument("--shield", default="joint")
    parser.add_argument("--steps", type=int, default=20_000, help="decisions, of half a second each")
    parser.add_argument("--episodes", type=int, default=200, help="to evaluate, without exploration")
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args()

    # An action is held for ten control periods, and the reward for reaching becomes 10: what our learner has.
    task = {"shield": options.shield, "decision_steps": 10, "reward_scale": 0.01}
    env = Watched(gymnasium.make("sidestep.bridges.gym:sidestep/Pursued-v0", **task))
    begin = min(500, options.steps // 2)
    common = {"batch_size": 256, "learning_starts": begin, "seed": options.seed, "device": "cpu"}
    if options.algorithm == "td3":
        noise = NormalActionNoise(np.zeros(2), np.full(2, 0.1))
        layers = {"net_arch": [256, 256]}
        model = TD3("MlpPolicy", Monitor(env), action_noise=noise, policy_kwargs=layers, **common)
    else:
        # Entropy at its usual price of 1 outweighs the target: it would pay to wander until the time is up.
        model = SAC("MlpPolicy", Monitor(env), ent_coef="auto_0.01", **common)
    model.learn(options.steps)
    print(f"training, {options.steps} decisions: {dict(env.outcomes)}", flush=True)

    trial = Watched(gymnasium.make("sidestep/Pursued-v0", **task))
    observation, _ = trial.reset(seed=1_000_000 + options.seed)
    while sum(trial.outcomes.values()) < options.episodes:
        action, _ = model.predict(observation, deterministic=True)
        observation, _, terminated, truncated, _ = trial.step(action)
        if terminated or truncated:
            observation, _ = trial.reset()
    print(f"evaluation, {options.episodes} episodes: {dict(trial.outcomes)}")


if __name__ == "__main__":
    main()
