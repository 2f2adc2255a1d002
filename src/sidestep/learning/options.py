"""What a training can be told, with the paper's printed values as defaults where it prints them."""

from __future__ import annotations

import dataclasses
import difflib
import math
from typing import Any, NoReturn

import equinox as eqx
import jax
import numpy as np

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
    exploration_noise: Scalar = eqx.field(converter=real, default=0.1)
    hindsight: Scalar = eqx.field(converter=real, default=0.8)
    reward_scale: Scalar = eqx.field(converter=real, default=0.01)
    correction_penalty: Scalar = eqx.field(converter=real, default=0.0)
    mirror: Scalar = eqx.field(converter=real, default=0.5)
    bound_values: bool = eqx.field(static=True, default=True)
    replay_action: str = eqx.field(static=True, default="proposed")
    filter_gradients: bool = eqx.field(static=True, default=False)
    decision_steps: int = eqx.field(static=True, default=10)
    batch_size: int = eqx.field(static=True, default=256)
    updates_per_decision: int = eqx.field(static=True, default=2)
    warmup_decisions: int = eqx.field(static=True, default=256)
    replay_capacity: int = eqx.field(static=True, default=1_000_000)

    def __check_init__(self) -> None:
        if self.filter_gradients and self.replay_action != "executed":
            raise ValueError(
                f"training option 'filter_gradients' = True: it needs replay_action='executed', not "
                f"{self.replay_action!r}, whose critic has the shield inside it already"
            )


_FLOATS = {
    "exploration_noise": (0.0, math.inf), "hindsight": (0.0, 1.0), "mirror": (0.0, 1.0),
    "reward_scale": (0.0, math.inf), "correction_penalty": (0.0, math.inf),
    "actor_learning_rate": (0.0, math.inf), "critic_learning_rate": (0.0, math.inf),
    "discount": (0.0, 1.0), "target_rate": (0.0, 1.0), "target_noise": (0.0, math.inf),
    "target_noise_clip": (0.0, math.inf), "last_layer_scale": (0.0, math.inf),
}  # fmt: skip
_WHOLE = {
    "decision_steps": 1, "batch_size": 1, "updates_per_decision": 1, "warmup_decisions": 1,
    "replay_capacity": 1, "policy_delay": 1,
}  # fmt: skip
_REPLAY_ACTIONS = ("proposed", "executed")


def make_options(**values: Any) -> TrainingOptions:
    """Validated options from plain values, `TrainingOptions`' and `TD3`'s fields side by side.

    `make_options(discount=0.98, updates_per_decision=3)`; what is not given keeps its default.

    **Raises** `ValueError` naming the option, its value and what is allowed.
    """
    algorithm_fields = [field.name for field in dataclasses.fields(TD3)]
    loop_fields = [field.name for field in dataclasses.fields(TrainingOptions) if field.name != "algorithm"]
    for name in values:
        if name not in algorithm_fields + loop_fields:
            near = difflib.get_close_matches(name, algorithm_fields + loop_fields, n=1)
            raise ValueError(
                f"unknown training option '{name}'" + (f"; did you mean '{near[0]}'?" if near else "")
            )
    values = {name: _checked(name, value) for name, value in values.items()}
    algorithm = TD3(**{name: value for name, value in values.items() if name in algorithm_fields})
    return TrainingOptions(
        algorithm=algorithm, **{name: value for name, value in values.items() if name in loop_fields}
    )


def _checked(name: str, value: Any) -> Any:
    """The value in the type its field needs."""

    def fail(allowed: str) -> NoReturn:
        raise ValueError(f"training option '{name}' = {value!r}: {allowed}")

    if name in _FLOATS:
        least, most = _FLOATS[name]
        # Finite in the precision that will be used: 1e60 is infinite in float32.
        with np.errstate(over="ignore"):
            finite = _is_number(value) and bool(np.isfinite(np.asarray(value, dtype=real(0.0).dtype)))
        if not finite or not least <= value <= most:
            fail(
                "it must be a finite number, " + (f"{least:g} or more" if most == math.inf else "from 0 to 1")
            )
        return float(value)
    if name in _WHOLE:
        if not _is_number(value) or not math.isfinite(value) or value != int(value) or value < _WHOLE[name]:
            fail(f"it must be a whole number of at least {_WHOLE[name]}")
        return int(value)
    if name in ("bound_values", "filter_gradients"):
        if not isinstance(value, bool):
            fail("it must be true or false")
    elif name == "replay_action":
        if value not in _REPLAY_ACTIONS:
            fail(f"it must be one of {', '.join(map(repr, _REPLAY_ACTIONS))}")
    elif name == "hidden":
        widths = value if isinstance(value, (list, tuple)) else ()
        if not widths or not all(
            _is_number(n) and isinstance(n, (int, np.integer)) and n > 0 for n in widths
        ):
            fail("it must be layer widths, such as [256, 256]")
        return tuple(int(n) for n in widths)
    return value


def _is_number(value: Any) -> bool:
    return isinstance(value, (int, float, np.integer, np.floating)) and not isinstance(value, bool)


def options_to_dict(options: TrainingOptions) -> dict[str, Any]:
    """All options as plain JSON values; `make_options` rebuilds them."""
    values: dict[str, Any] = {}
    for owner in (options.algorithm, options):
        for field in dataclasses.fields(owner):
            value = getattr(owner, field.name)
            if field.name != "algorithm":
                values[field.name] = float(str(value)) if isinstance(value, jax.Array) else value
    return values
