"""What a training can be told, with the paper's printed values as defaults where it prints them."""

from __future__ import annotations

import dataclasses
import difflib
import math
from collections.abc import Mapping
from typing import Any

import equinox as eqx

from sidestep._arrays import Scalar, real
from sidestep.learning.td3 import TD3


class TrainingOptions(eqx.Module):
    """Options of the training loop around `TD3`.

    - `algorithm`: TD3's own hyper-parameters; its discount applies per decision.
    - `decision_steps`: control periods between two decisions; the shield runs at each period.
    - `batch_size`, `updates_per_decision`, `warmup_decisions` (uniformly random before any update).
    - `exploration_noise`: standard deviation, in units of the action range.
    - `hindsight`: share of each batch read with a place reached later as its target.
    - `mirror`: share of each batch reflected left to right, which is the same problem seen in a mirror.
    - `reward_scale`: multiplies rewards inside the learner only; reported returns are the paper's.
    - `replay_action`: `"proposed"` (the policy's) or `"executed"` (the shield's answer; the target
      action then passes through the shield too).
    - `correction_penalty`: reward taken off per decision in which the shield corrected by v_e throughout.
    - `replay_capacity`: transitions kept; never more than the training can produce.
    """

    algorithm: TD3 = eqx.field(default_factory=TD3)
    exploration_noise: Scalar = eqx.field(converter=real, default=0.1)
    hindsight: Scalar = eqx.field(converter=real, default=0.8)
    reward_scale: Scalar = eqx.field(converter=real, default=0.01)
    correction_penalty: Scalar = eqx.field(converter=real, default=0.0)
    mirror: Scalar = eqx.field(converter=real, default=0.5)
    replay_action: str = eqx.field(static=True, default="proposed")
    decision_steps: int = eqx.field(static=True, default=10)
    batch_size: int = eqx.field(static=True, default=256)
    updates_per_decision: int = eqx.field(static=True, default=1)
    warmup_decisions: int = eqx.field(static=True, default=256)
    replay_capacity: int = eqx.field(static=True, default=1_000_000)
