"""SBX, the JAX port of Stable-Baselines3, learns behind our shield: SAC in a few minutes, then episodes.

python -m pip install torch==2.13.0 && python -m pip install sbx-rl -e '.[gym]'  # in the clone
python examples/train_with_sbx.py
"""

import argparse

import gymnasium
from sbx import SAC

parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
parser.add_argument("--shield", default="joint")
parser.add_argument("--steps", type=int, default=10_000, help="decisions, of half a second each")
parser.add_argument("--episodes", type=int, default=100, help="to evaluate, without exploration")
parser.add_argument("--seed", type=int, default=0)
options = parser.parse_args()

env = gymnasium.make(
    "sidestep.bridges.gym:sidestep/Pursued-v0", shield=options.shield, decision_steps=10, reward_scale=0.01
)
begin = min(500, options.steps // 2)
# Entropy at its usual price of 1 outweighs the target: it would pay to wander until the time is up.
model = SAC("MlpPolicy", env, batch_size=256, learning_starts=begin, ent_coef="auto_0.01", seed=options.seed)
model.learn(options.steps)

outcomes = dict.fromkeys(("captured", "collided", "reached", "timed_out"), 0)
observation, _ = env.reset(seed=1_000_000 + options.seed)
while sum(outcomes.values()) < options.episodes:
    action, _ = model.predict(observation, deterministic=True)
    observation, _, terminated, truncated, info = env.step(action)
    if terminated or truncated:
        outcomes = {name: count + info[name] for name, count in outcomes.items()}
        observation, _ = env.reset()
print(f"{options.episodes} episodes after {options.steps} decisions: {outcomes}")
