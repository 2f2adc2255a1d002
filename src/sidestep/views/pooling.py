"""Pool the stored evaluations of several runs."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from sidestep.store.runs import OUTCOMES
from sidestep.trials import wilson_interval

_LEAST = ("min_pursuer_clearance", "min_obstacle_clearance")
_SHARES = ("intervention_rate", "infeasible_rate", "invalid_rate", "mean_correction")


def pooled_evaluation(reports: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """The entries of `Evaluation.to_dict` that tables and the outcome figure show, pooled.

    Counts are added and get new bounds. Shares of control periods are weighted by the numbers of periods (by
    episodes if unknown). The median is None, because it cannot be pooled. A single evaluation is returned
    unchanged.
    """
    if len(reports) == 1:
        return dict(reports[0])
    episodes = sum(report["episodes"] for report in reports)
    pooled: dict[str, Any] = {"episodes": episodes, "reach_time_median": None}
    for name in (*OUTCOMES, "safe"):
        count = sum(report[name] for report in reports)
        low, high = wilson_interval(count, episodes)
        pooled |= {
            name: count, f"{name}_rate": count / episodes, f"{name}_rate_low": low, f"{name}_rate_high": high,
        }  # fmt: skip
    for name in _LEAST:
        pooled[name] = min((report[name] for report in reports if report[name] is not None), default=None)
    counted = "env_steps" if all("env_steps" in report for report in reports) else "episodes"
    weight = sum(report[counted] for report in reports)
    for name in _SHARES:
        if any(name not in report for report in reports):
            continue
        pooled[name] = sum(report[name] * report[counted] for report in reports) / weight
    unanswered = [report.get("pursuer_invalid") for report in reports]
    pooled["pursuer_invalid"] = sum(count or 0 for count in unanswered)
    return pooled
