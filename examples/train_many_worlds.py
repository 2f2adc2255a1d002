"""PPO of Stable-Baselines3 learns in 256 worlds at once behind `game`, and is then run behind `joint`.

python -m pip install torch==2.13.0 && python -m pip install stable-baselines3 -e '.[gym]'  # in the clone
python examples/train_many_worlds.py
"""

import argparse
from collections import Counter

import numpy as np
from stable_baselines3 import PPO
from stable_baselines3.common.vec_env import VecMonitor

from sidestep.bridges.gym.stable_baselines import PursuedVecEnv

parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
parser.add_argument("--shield", default="game", help="to learn behind")
parser.add_argument("--trial-shield", default="joint")
parser.add_argument("--worlds", type=int, default=256)
parser.add_argument("--steps", type=int, default=400_000, help="decisions, of half a second each")
parser.add_argument("--episodes", type=int, default=200, help="to evaluate, without exploration")
parser.add_argument("--seed", type=int, default=0)
options = parser.parse_args()

task = {"pursuer": "nash", "decision_steps": 10, "reward_scale": 0.01}
env = VecMonitor(PursuedVecEnv(options.worlds, shield=options.shield, **task))
settings = {"n_steps": 64, "batch_size": 2048, "learning_rate": 1e-3, "seed": options.seed, "device": "cpu"}
model = PPO("MlpPolicy", env, **settings)
model.learn(options.steps)

# As many episodes in each world: the first to end anywhere would be the short ones.
worlds = min(20, options.episodes)
trial = PursuedVecEnv(worlds, shield=options.trial_shield, **task)
trial.seed(1_000_000 + options.seed)
observation, outcomes = trial.reset(), [Counter() for _ in range(worlds)]
while min(outcome.total() for outcome in outcomes) < options.episodes // worlds:
    action, _ = model.predict(observation, deterministic=True)
    observation, _, ended, infos = trial.step(action)
    for world in np.flatnonzero(ended):
        if outcomes[world].total() < options.episodes // worlds:
            outcomes[world].update(
                name for name in ("captured", "collided", "reached", "timed_out") if infos[world][name]
            )
print(f"after {model.num_timesteps} decisions: {dict(sum(outcomes, Counter()))}")
