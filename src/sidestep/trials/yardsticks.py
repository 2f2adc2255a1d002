"""How fast is a policy beside others from the same starts?"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from jaxtyping import Float

from sidestep.loop.policies import GOAL_SEEKING, PLANNER
from sidestep.store.files import json_safe
from sidestep.trials.evaluation import Evaluation
from sidestep.trials.monte_carlo import Hook, evaluate, quiet
from sidestep.trials.statistics import Interval, stratified_bootstrap
from sidestep.world import Scenario

_FIGURES = (
    "captured", "collided", "reached", "timed_out", "time_mean", "reached_by", "intervention_rate",
)  # fmt: skip


@dataclass(frozen=True)
class Yardsticks:
    """The `evaluation` of a policy, and those of `others` by name from the same starts: `goal-seeking`, which
    learned nothing, and maybe `planner`, which knows the pursuer's strategy.

    Times are `times_to_target`: an episode that did not reach the target counts as the time limit. Intervals
    are 95 % bootstrap intervals over starts.
    """

    evaluation: Evaluation
    others: Mapping[str, Evaluation] = field(default_factory=dict)

    def difference(self, name: str) -> Interval:
        """Mean over the starts of this policy's time less that of the other one (s): negative if faster."""
        return stratified_bootstrap([self._gained(name, self.evaluation)], np.mean)

    def ratio(self, name: str) -> float:
        """Mean time over that of the other policy."""
        return float(np.mean(self.evaluation.times_to_target) / np.mean(self.others[name].times_to_target))

    @property
    def share_of_planner(self) -> Interval | None:
        """Share of the way from goal-seeking to the planner: (t_g - t)/(t_g - t_p) for the mean times t.

        0 is as fast as goal-seeking, 1 as fast as the planner; above 1 is faster than the planner. None
        without both, and where the planner is not faster than goal-seeking beyond doubt.
        """
        if not {GOAL_SEEKING, PLANNER} <= set(self.others):
            return None
        most = self._gained(GOAL_SEEKING, self.others[PLANNER])
        gained = self._gained(GOAL_SEEKING, self.evaluation)
        if stratified_bootstrap([most], np.mean).high >= 0.0:
            return None

        def share(starts: Float[np.ndarray, "n"]) -> float:
            drawn = starts.astype(int)
            return float(np.sum(gained[drawn]) / np.sum(most[drawn]))

        return stratified_bootstrap([np.arange(len(most))], share)

    def _gained(self, name: str, evaluation: Evaluation) -> Float[np.ndarray, "episodes"]:
        return evaluation.times_to_target - self.others[name].times_to_target

    def to_dict(self) -> dict[str, Any]:
        """JSON values: by name the figures of each other policy with `difference` (`estimate`, `low`, `high`)
        and `ratio`, and `share_of_planner`."""
        report: dict[str, Any] = {}
        for name, other in self.others.items():
            difference = self.difference(name)._asdict()
            report[name] = {**time_figures(other), "difference": difference, "ratio": self.ratio(name)}
        share = self.share_of_planner
        return json_safe({**report, "share_of_planner": None if share is None else share._asdict()})


def time_figures(evaluation: Evaluation) -> dict[str, Any]:
    """Those of `Evaluation.to_dict` by which policies are compared: outcomes, times, interventions."""
    every = evaluation.to_dict()
    return {name: every[name] for name in _FIGURES}


def take_yardsticks(
    scenario: Scenario,
    policy: Any,
    shield: Any,
    pursuer: Any,
    episodes: int,
    key: Any,
    *,
    planner: bool = False,
    batch: int = 256,
    count_progress: Hook = quiet,
) -> Yardsticks:
    """Evaluate a policy, and from the same starts `goal-seeking` and with `planner` the `planner`.

    A policy given by one of these names is not measured twice. `count_progress` opens a display for each
    evaluation. Other arguments, and what is raised, are those of `evaluate`.
    """

    def measured(policy: Any, name: str) -> Evaluation:
        with count_progress(name) as show:
            return evaluate(scenario, policy, shield, pursuer, episodes, key, batch=batch, progress=show)

    own = policy if isinstance(policy, str) else "policy"
    names = [name for name in (GOAL_SEEKING, *([PLANNER] if planner else [])) if name != own]
    evaluation = measured(policy, own)
    return Yardsticks(evaluation, {name: measured(name, name) for name in names})
