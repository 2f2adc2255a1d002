"""Options of a training. Defaults are the paper's values where it prints them."""

from __future__ import annotations

import dataclasses
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp

from sidestep._arrays import Count, Scalar, real, static_field
from sidestep._bounds import Bound, allowed, did_you_mean, one_of, taken, within
from sidestep.learning.td3 import TD3


class TrainingOptions(eqx.Module):
    """Options of the training loop around `TD3`.

    - `algorithm`: the hyper-parameters of TD3; its discount applies per decision.
    - `decision_steps`: control periods between two decisions; the shield runs at each period.
    - `worlds`: worlds in which the policy acts at once; their transitions share one replay. The updates
      after a decision are the same in number for any of them.
    - `batch_size`, `updates_per_decision`, `warmup_decisions` (of all worlds, uniformly random before any
      update).
    - `exploration_noise`: standard deviation, in units of the action range.
    - `guided`: share of the worlds that a fixed strategy drives, for the learner to learn from: straight to
      the target, or where a pursuer learns, the training's `pursuer`.
    - `hindsight`: share of each batch whose target is replaced by a position reached later.
    - `mirror`: share of each batch reflected left to right.
    - `reward_scale`: multiplies rewards inside the learner only; reported returns are the paper's.
    - `bound_values`: limit target values to the reward for reaching, since no return can exceed it.
    - `replay_action`: `"proposed"` (the policy's action) or `"executed"` (the shield's; the target action is
      then filtered, too).
    - `filter_gradients`: filter the actor's action with the shield before the critic evaluates it, so that
      the actor's gradient contains the derivative of the executed action with respect to the proposed one.
      Only for executed actions: a critic of proposed actions already models the shield, and the action would
      be filtered twice.
    - `correction_penalty`: subtracted from the reward of a decision whose mean correction is v_e, in
      proportion to the correction, in units of the paper's reward. It penalises the proposed action; a critic
      of executed actions attributes it to the executed one.
    - `time_cost`: subtracted from the reward for each second until the target or the end of the episode, 1/s,
      in units of the paper's reward.
    - `anneal`: share of the episodes, at the end of the training, over which both learning rates fall to a
      twentieth, linearly; a training that is resumed for more episodes raises them again.
    - `replay_capacity`: largest number of transitions kept; never more than the training can produce.
    """

    algorithm: TD3 = eqx.field(default_factory=TD3)
    exploration_noise: Scalar = eqx.field(converter=real, default=0.1, metadata=within(least=0.0))
    hindsight: Scalar = eqx.field(converter=real, default=0.8, metadata=within(least=0.0, most=1.0))
    reward_scale: Scalar = eqx.field(converter=real, default=0.01, metadata=within(least=0.0))
    correction_penalty: Scalar = eqx.field(converter=real, default=0.0, metadata=within(least=0.0))
    time_cost: Scalar = eqx.field(converter=real, default=0.0, metadata=within(least=0.0, unit="1/s"))
    mirror: Scalar = eqx.field(converter=real, default=0.5, metadata=within(least=0.0, most=1.0))
    anneal: Scalar = eqx.field(converter=real, default=0.0, metadata=within(least=0.0, most=1.0))
    guided: float = static_field(0.0, least=0.0, below=1.0)
    bound_values: bool = eqx.field(static=True, default=True)
    replay_action: str = static_field("proposed", one_of("proposed", "executed"))
    filter_gradients: bool = eqx.field(static=True, default=False)
    worlds: int = static_field(1, least=1)
    decision_steps: int = static_field(10, least=1)
    batch_size: int = static_field(256, least=1)
    updates_per_decision: int = static_field(2, least=1)
    warmup_decisions: int = static_field(256, least=1)
    replay_capacity: int = static_field(1_000_000, least=1)

    def after(self, done: Count, episodes: Count) -> TrainingOptions:
        """The options after `done` of `episodes` episodes: with the learning rates of then."""
        left = 1.0 - done.astype(self.anneal.dtype) / episodes.astype(self.anneal.dtype)
        share = jnp.where(left < self.anneal, 0.05 + 0.95 * left / jnp.maximum(self.anneal, 1e-6), 1.0)

        def rates(options: TrainingOptions) -> tuple[Any, Any]:
            return options.algorithm.actor_learning_rate, options.algorithm.critic_learning_rate

        return eqx.tree_at(rates, self, tuple(share * rate for rate in rates(self)))

    def __check_init__(self) -> None:
        if self.guided > 0.0 and round(self.guided * self.worlds) not in range(1, self.worlds):
            raise ValueError(
                f"training option 'guided' = {self.guided:g}: of worlds={self.worlds} it must take at least "
                "one and leave some to the policy; use more worlds"
            )
        if self.filter_gradients and self.replay_action != "executed":
            raise ValueError(
                f"training option 'filter_gradients' = True: it needs replay_action='executed', not "
                f"{self.replay_action!r}, whose critic already models the shield"
            )


def make_options(**values: Any) -> TrainingOptions:
    """Validated options from the fields of `TrainingOptions` and of `TD3` by name.

    Example: `make_options(discount=0.98, updates_per_decision=3)`; other fields keep their defaults.

    **Raises** `ValueError` naming the option, its value and what is allowed.
    """
    rules: dict[str, Any] = {**allowed(TD3), **allowed(TrainingOptions)}
    del rules["algorithm"]
    used = {}
    for name, value in values.items():
        if name not in rules:
            raise ValueError(f"unknown training option '{name}'{did_you_mean(name, rules)}")
        rule = rules[name]
        # Some JSON writers write 10 as 10.0.
        whole = isinstance(rule, Bound) and rule.whole and isinstance(value, float) and value.is_integer()
        used[name] = taken(f"training option '{name}'", int(value) if whole else value, rule)
    if "hidden" in used:
        used["hidden"] = tuple(used["hidden"].tolist())
    algorithm = TD3(**{name: used.pop(name) for name in allowed(TD3) if name in used})
    return TrainingOptions(algorithm=algorithm, **used)


def options_to_dict(options: TrainingOptions) -> dict[str, Any]:
    """All options as JSON values, the arguments of `make_options`."""
    values: dict[str, Any] = {}
    for owner in (options.algorithm, options):
        for field in dataclasses.fields(owner):
            value = getattr(owner, field.name)
            if field.name != "algorithm":
                values[field.name] = float(str(value)) if isinstance(value, jax.Array) else value
    return values
