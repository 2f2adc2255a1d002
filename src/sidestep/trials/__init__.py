"""Measurements: batch evaluation, statistics, reproduction, falsification, campaigns."""

from sidestep._moved import moved_names
from sidestep.trials.captures import Capture, count_causes, examine_captures, explain_capture
from sidestep.trials.evaluation import Evaluation
from sidestep.trials.intervention_map import InterventionMap
from sidestep.trials.monte_carlo import evaluate
from sidestep.trials.statistics import (
    interquartile_mean,
    probability_of_improvement,
    stratified_bootstrap,
    wilson_interval,
    zero_event_bound,
)
from sidestep.trials.survey import Survey, WorstEpisode, load_survey, save_survey, survey_run, take_survey
from sidestep.trials.yardsticks import Yardsticks, take_yardsticks

__all__ = [
    "Capture",
    "Evaluation",
    "InterventionMap",
    "Survey",
    "WorstEpisode",
    "Yardsticks",
    "count_causes",
    "evaluate",
    "examine_captures",
    "explain_capture",
    "interquartile_mean",
    "load_survey",
    "probability_of_improvement",
    "save_survey",
    "stratified_bootstrap",
    "survey_run",
    "take_survey",
    "take_yardsticks",
    "wilson_interval",
    "zero_event_bound",
]

__getattr__ = moved_names(
    __name__,
    dict.fromkeys(
        (
            "Trajectory",
            "as_policy",
            "episode_key",
            "load_episode",
            "load_trajectory",
            "rollout",
            "save_trajectory",
        ),
        "sidestep.loop",
    ),
)
