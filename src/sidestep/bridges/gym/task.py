"""A learning problem: scenario, shield, pursuer, and for how long an action is held."""

from __future__ import annotations

from typing import Any

import equinox as eqx
import jax
import numpy as np

from sidestep._arrays import Scalar, real, whole_number
from sidestep.pursuit import as_pursuer
from sidestep.safety import as_shield
from sidestep.world import Scenario, load_scenario


class Task(eqx.Module):
    """One learning problem. Its numbers are traced: tasks that differ only in numbers share compiled
    programs.

    **Attributes:** `scenario`; `shield`; `pursuer`; `reward_scale`, the factor on the scenario's reward;
    `decision_steps`, the number of control periods for which an action is held.
    """

    scenario: Scenario
    shield: Any
    pursuer: Any
    reward_scale: Scalar
    decision_steps: int = eqx.field(static=True)

    @property
    def pictures_per_second(self) -> int:
        """The frame rate at which one picture per decision plays in real time; at least 1."""
        return max(1, round(1.0 / (float(self.scenario.control_period) * self.decision_steps)))


def make_task(
    scenario: Any = "paper",
    shield: Any = "joint",
    pursuer: Any = "nash",
    decision_steps: int = 10,
    reward_scale: float = 1.0,
    **fields: Any,
) -> Task:
    """A task from the arguments of the environments.

    **Arguments:** `scenario` a preset, a file or a `Scenario`; `shield` a name or a `Shield`; `pursuer` a
    name, a `Pursuer` or a callable `(scenario, world, key) -> wheel speeds`; `fields` of the scenario by
    name, unless it is a `Scenario` already.

    **Raises** `ValueError` (`ScenarioError` for fields) naming what is wrong and what is allowed.
    """
    if isinstance(scenario, Scenario):
        if fields:
            names = ", ".join(sorted(fields))
            raise ValueError(f"fields ({names}) go with a scenario's name or file, not with a Scenario")
    else:
        scenario = load_scenario(scenario, **fields)
    decision_steps = whole_number("decision_steps", decision_steps)
    if not np.isfinite(reward_scale):
        raise ValueError(f"reward_scale = {reward_scale!r}: it must be a finite number")
    task = Task(
        scenario=scenario,
        shield=as_shield(shield, scenario),
        pursuer=as_pursuer(pursuer),
        reward_scale=real(reward_scale),
        decision_steps=decision_steps,
    )
    # A custom model may hold Python numbers.
    return jax.tree.map(lambda leaf: real(leaf) if isinstance(leaf, (int, float)) else leaf, task)
