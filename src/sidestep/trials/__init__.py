"""What was measured? Batch evaluation, statistics, recorded episodes."""

from sidestep.trials.captures import Capture, count_causes, examine_captures, explain_capture
from sidestep.trials.evaluation import Evaluation
from sidestep.trials.intervention_map import InterventionMap
from sidestep.trials.keys import episode_key
from sidestep.trials.monte_carlo import evaluate
from sidestep.trials.policies import as_policy
from sidestep.trials.rollout import (
    Episode,
    Trajectory,
    load_episode,
    load_trajectory,
    rollout,
    save_trajectory,
)
from sidestep.trials.statistics import (
    interquartile_mean,
    probability_of_improvement,
    stratified_bootstrap,
    wilson_interval,
    zero_event_bound,
)
from sidestep.trials.survey import Survey, WorstEpisode, load_survey, save_survey, survey_run, take_survey

__all__ = [
    "Capture",
    "Episode",
    "Evaluation",
    "InterventionMap",
    "Survey",
    "Trajectory",
    "WorstEpisode",
    "as_policy",
    "count_causes",
    "episode_key",
    "evaluate",
    "examine_captures",
    "explain_capture",
    "interquartile_mean",
    "load_episode",
    "load_survey",
    "load_trajectory",
    "probability_of_improvement",
    "rollout",
    "save_survey",
    "save_trajectory",
    "stratified_bootstrap",
    "survey_run",
    "take_survey",
    "wilson_interval",
    "zero_event_bound",
]
