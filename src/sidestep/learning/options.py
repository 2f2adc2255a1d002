"""What a training can be told, with the paper's printed values as defaults where it prints them."""

from __future__ import annotations

import dataclasses
from typing import Any

import equinox as eqx
import jax

from sidestep._arrays import Scalar, real, static_field
from sidestep._bounds import Bound, allowed, did_you_mean, one_of, taken, within
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
    - `bound_values`: cut target values at the reward for reaching, since no return can exceed it.
    - `replay_action`: `"proposed"` (the policy's) or `"executed"` (the shield's answer; the target
      action then passes through the shield too).
    - `filter_gradients`: pass the actor's action through the shield as well before the critic judges it, so
      that the actor climbs along the derivative of the executed action with respect to the proposed one.
      For executed actions only: a critic of proposed ones has the shield inside it already, and would be
      asked about an action filtered twice.
    - `correction_penalty`: reward taken off per decision in which the shield corrected by v_e throughout, in
      the units of the paper's reward. It is a price on what was proposed; a critic of executed actions
      sees it only as a price on the actions that corrections end in.
    - `replay_capacity`: transitions kept; never more than the training can produce.
    """

    algorithm: TD3 = eqx.field(default_factory=TD3)
    exploration_noise: Scalar = eqx.field(converter=real, default=0.1, metadata=within(least=0.0))
    hindsight: Scalar = eqx.field(converter=real, default=0.8, metadata=within(least=0.0, most=1.0))
    reward_scale: Scalar = eqx.field(converter=real, default=0.01, metadata=within(least=0.0))
    correction_penalty: Scalar = eqx.field(converter=real, default=0.0, metadata=within(least=0.0))
    mirror: Scalar = eqx.field(converter=real, default=0.5, metadata=within(least=0.0, most=1.0))
    bound_values: bool = eqx.field(static=True, default=True)
    replay_action: str = static_field("proposed", one_of("proposed", "executed"))
    filter_gradients: bool = eqx.field(static=True, default=False)
    decision_steps: int = static_field(10, least=1)
    batch_size: int = static_field(256, least=1)
    updates_per_decision: int = static_field(2, least=1)
    warmup_decisions: int = static_field(256, least=1)
    replay_capacity: int = static_field(1_000_000, least=1)

    def __check_init__(self) -> None:
        if self.filter_gradients and self.replay_action != "executed":
            raise ValueError(
                f"training option 'filter_gradients' = True: it needs replay_action='executed', not "
                f"{self.replay_action!r}, whose critic has the shield inside it already"
            )


def make_options(**values: Any) -> TrainingOptions:
    """Validated options from plain values, `TrainingOptions`' and `TD3`'s fields side by side.

    `make_options(discount=0.98, updates_per_decision=3)`; what is not given keeps its default.

    **Raises** `ValueError` naming the option, its value and what is allowed.
    """
    rules: dict[str, Any] = {**allowed(TD3), **allowed(TrainingOptions)}
    del rules["algorithm"]
    used = {}
    for name, value in values.items():
        if name not in rules:
            raise ValueError(f"unknown training option '{name}'{did_you_mean(name, rules)}")
        rule = rules[name]
        # JSON from elsewhere writes 10 as 10.0.
        whole = isinstance(rule, Bound) and rule.whole and isinstance(value, float) and value.is_integer()
        used[name] = taken(f"training option '{name}'", int(value) if whole else value, rule)
    if "hidden" in used:
        used["hidden"] = tuple(used["hidden"].tolist())
    algorithm = TD3(**{name: used.pop(name) for name in allowed(TD3) if name in used})
    return TrainingOptions(algorithm=algorithm, **used)


def options_to_dict(options: TrainingOptions) -> dict[str, Any]:
    """All options as plain JSON values; `make_options` rebuilds them."""
    values: dict[str, Any] = {}
    for owner in (options.algorithm, options):
        for field in dataclasses.fields(owner):
            value = getattr(owner, field.name)
            if field.name != "algorithm":
                values[field.name] = float(str(value)) if isinstance(value, jax.Array) else value
    return values
