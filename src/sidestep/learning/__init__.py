"""What the evader learns: TD3, replay, the training loop, checkpoints, the policy it leaves."""

from sidestep.learning.divergence import Diverged
from sidestep.learning.options import TrainingOptions, make_options, options_to_dict
from sidestep.learning.policy import LearnedPolicy, load_policy
from sidestep.learning.td3 import TD3
from sidestep.learning.train import Progress, Training, resume_settings, train

__all__ = [
    "TD3",
    "Diverged",
    "LearnedPolicy",
    "Progress",
    "Training",
    "TrainingOptions",
    "load_policy",
    "make_options",
    "options_to_dict",
    "resume_settings",
    "train",
]
