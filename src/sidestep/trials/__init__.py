"""What was measured? Batch evaluation, statistics, recorded episodes."""

from sidestep.trials.evaluation import Evaluation
from sidestep.trials.keys import episode_key
from sidestep.trials.monte_carlo import evaluate
from sidestep.trials.policies import as_policy
from sidestep.trials.rollout import Trajectory, load_trajectory, rollout, save_trajectory
from sidestep.trials.statistics import (
    interquartile_mean,
    stratified_bootstrap,
    wilson_interval,
    zero_event_bound,
)

__all__ = [
    "Evaluation",
    "Trajectory",
    "as_policy",
    "episode_key",
    "evaluate",
    "interquartile_mean",
    "load_trajectory",
    "rollout",
    "save_trajectory",
    "stratified_bootstrap",
    "wilson_interval",
    "zero_event_bound",
]
