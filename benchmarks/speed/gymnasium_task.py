"""The peer's task as a Gymnasium environment, as a user of Stable-Baselines3 would write it."""

from __future__ import annotations

from typing import Any

import numpy as np

from speed.peer_task import PeerTask
from speed.peers import peer

REWARD_SCALE = 0.01
"""What the learner sees of the reward, as in ours."""


def make_environment(hold: int = 1) -> Any:
    """A `gymnasium.Env` of the scenario `paper` with the pursuer `turn-then-drive`.

    **Raises** `MissingPeer` without Gymnasium.
    """
    gymnasium = peer("gymnasium")
    from sidestep.world import load_scenario, scenario_to_dict

    class Pursued(gymnasium.Env):
        def __init__(self):
            self.task = PeerTask(scenario_to_dict(load_scenario("paper")), hold)
            size = self.task.observation_size
            self.observation_space = gymnasium.spaces.Box(-np.inf, np.inf, (size,), np.float32)
            self.action_space = gymnasium.spaces.Box(-1.0, 1.0, (2,), np.float32)

        def reset(self, *, seed: int | None = None, options: Any = None) -> Any:
            super().reset(seed=seed)
            return self.task.reset(), {}

        def step(self, action: Any) -> Any:
            observation, reward, terminated, truncated = self.task.act(action)
            return observation, REWARD_SCALE * reward, terminated, truncated, {}

    return Pursued()
