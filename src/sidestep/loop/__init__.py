"""Run episodes: control step, episode, policies, random keys, recordings."""

from sidestep.loop.episode import Episode, Period, Tally, Task, advance, ask, begin, hold
from sidestep.loop.keys import episode_key
from sidestep.loop.policies import as_policy
from sidestep.loop.rollout import (
    Recording,
    Trajectory,
    load_episode,
    load_trajectory,
    rollout,
    save_trajectory,
)

__all__ = [
    "Episode",
    "Period",
    "Recording",
    "Tally",
    "Task",
    "Trajectory",
    "advance",
    "as_policy",
    "ask",
    "begin",
    "episode_key",
    "hold",
    "load_episode",
    "load_trajectory",
    "rollout",
    "save_trajectory",
]
