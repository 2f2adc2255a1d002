"""Learning: TD3, replay, the training loop, checkpoints, the trained policy."""

from sidestep.learning.divergence import Diverged
from sidestep.learning.networks import Actor
from sidestep.learning.options import TrainingOptions, make_options, options_to_dict
from sidestep.learning.players import LearnedPursuer
from sidestep.learning.policy import (
    HUNTER,
    PRETRAINED,
    PRETRAINED_SCENARIO,
    LearnedPolicy,
    load_policy,
    load_pursuer,
    policy_file,
    write_policy,
)
from sidestep.learning.run import Progress, Training, resume_settings, train
from sidestep.learning.td3 import TD3, Batch, Learner, update
from sidestep.learning.training import decide_and_learn, run_chunk, start

__all__ = [
    "HUNTER",
    "PRETRAINED",
    "PRETRAINED_SCENARIO",
    "TD3",
    "Actor",
    "Batch",
    "Diverged",
    "LearnedPolicy",
    "LearnedPursuer",
    "Learner",
    "Progress",
    "Training",
    "TrainingOptions",
    "decide_and_learn",
    "load_policy",
    "load_pursuer",
    "make_options",
    "options_to_dict",
    "policy_file",
    "resume_settings",
    "run_chunk",
    "start",
    "train",
    "update",
    "write_policy",
]
