"""Resume a search: its stored settings, and the rest of its time."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

from sidestep.store.runs import NOT_BEGUN, RunError, open_run
from sidestep.trials.falsification.tallies import Plan
from sidestep.world import load_scenario

_DEFAULT_MINUTES = 3.0


def search_settings(folder: str | Path) -> dict[str, Any]:
    """The arguments with which `falsify` resumes the search in `folder`: scenario, policy, shield and plan.

    A policy or shield without a name is stored as `custom`, and must be given again.

    **Raises** `RunError` when the folder holds no search.
    """
    config = open_run(folder, "falsification", otherwise=NOT_BEGUN)
    return {
        "scenario": load_scenario("paper", **config["scenario"]),
        "policy": config["policy"]["name"],
        "shield": config["shield"],
        "plan": plan_for(config, None),
    }


def plan_for(config: Mapping[str, Any], plan: Plan | None) -> Plan:
    """The stored plan of a search, or the given one with the stored certificate's clearance."""
    if plan is not None:
        if plan.guaranteed_clearance is not None:
            return plan
        return replace(plan, guaranteed_clearance=config["guaranteed_clearance"])
    values = {name: config[name] for name in Plan.__dataclass_fields__}
    return Plan(**{**values, "attacks": tuple(values["attacks"])})


def check_policy(folder: Path, stored: Mapping[str, Any], policy: Mapping[str, Any]) -> None:
    """**Raises** `RunError` unless both descriptions are of the same policy, weights included."""
    if stored.get("digest") != policy.get("digest"):
        raise RunError(
            f"{folder} was begun with other settings: policy = {stored['name']!r}, not {policy['name']!r} or "
            "other weights of it; start another search with another --out"
        )


def budget_for(
    folder: Path, stored: Mapping[str, Any], before: float, minutes: float | None, episodes: int | None
) -> dict[str, Any]:
    """The total budget of a search over all calls: `minutes` (None: no limit) and `episodes` per attack.

    **Arguments:** `stored` the budget it began with, empty for a new search; `before` the seconds used;
    `minutes`, in addition to those, and `episodes` requested now.

    **Raises** `RunError` when fewer episodes are requested than before.
    """
    if minutes is None and episodes is None:
        if stored:
            return dict(stored)
        minutes = _DEFAULT_MINUTES
    begun_for = stored.get("episodes") or 0
    if episodes is not None and episodes < begun_for:
        raise RunError(
            f"{folder} was begun for {begun_for} episodes of each attack; it cannot be resumed for fewer "
            f"({episodes})"
        )
    return {"minutes": None if minutes is None else before / 60.0 + minutes, "episodes": episodes}
