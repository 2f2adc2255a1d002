"""What does a search that is resumed go on with? Its own settings, and what is left of its time."""

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
    """What `falsify` needs to go on with the search in `folder`: scenario, policy, shield and plan.

    A policy or a shield without a name is `custom` there, and must be given again.

    **Raises** `RunError` when there is none.
    """
    config = open_run(folder, "falsification", otherwise=NOT_BEGUN)
    return {
        "scenario": load_scenario("paper", **config["scenario"]),
        "policy": config["policy"]["name"],
        "shield": config["shield"],
        "plan": plan_for(config, None),
    }


def plan_for(config: Mapping[str, Any], plan: Plan | None) -> Plan:
    """The plan of a search begun before, or the one given, with the certificate's clearance from there."""
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
    """What a search may take, all calls together: `minutes` (None: no limit) and `episodes` of each attack.

    **Arguments:** `stored` what it was begun for, empty for a new one; `before` the seconds it has had;
    `minutes`, on top of those, and `episodes` as asked for now.

    **Raises** `RunError` when fewer episodes are asked for than before.
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
