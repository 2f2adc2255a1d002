"""How does an episode run? One control step, policies, random keys, recorded trajectories."""

from sidestep.loop.keys import episode_key
from sidestep.loop.policies import as_policy
from sidestep.loop.rollout import (
    Episode,
    Trajectory,
    load_episode,
    load_trajectory,
    rollout,
    save_trajectory,
)

__all__ = [
    "Episode",
    "Trajectory",
    "as_policy",
    "episode_key",
    "load_episode",
    "load_trajectory",
    "rollout",
    "save_trajectory",
]
