"""Files and metadata of an export."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import sidestep
from sidestep.safety import Shield
from sidestep.store.files import write_bytes
from sidestep.world import Scenario
from sidestep.world.loading import scenario_to_dict

UNITS = "positions m, velocities m/s, headings rad counter-clockwise; world axes, x forward, y left"
WHAT = ("policy+filter", "policy", "filter")
"""What can be exported."""
ALONE = "export the policy alone (what='policy', --what policy)"
"""Advice where a filter cannot be exported."""
STATUS_WORDS = "0 ok, 1 corrected, 2 infeasible, 3 invalid"


def check_what(scenario: Scenario, what: str, policy: object | None) -> None:
    """**Raises** `ValueError` for an unknown `what`, a missing policy, or a scenario without a filter."""
    if what not in WHAT:
        raise ValueError(f"cannot export {what!r}; use one of {', '.join(map(repr, WHAT))}")
    if policy is None and what != "filter":
        raise ValueError(f"exporting {what!r} needs a policy")
    if what != "policy":
        scenario.check_built_in("an exported filter", ALONE)


def check_looks_ahead(shield: Shield, name: str, format: str) -> None:
    """**Raises** `ValueError` for a shield that looks ahead, which `format` does not hold."""
    if shield.looks_ahead:
        named = f"the shield {name!r}" if name else "this shield"
        raise ValueError(
            f"{named} looks ahead here, thousands of simulated steps per decision: that is not exported as "
            f"{format}. Take 'joint:table', which goes by the clearance table alone, or 'game' (--shield)"
        )


def write_new(path: str | Path, content: bytes, *, overwrite: bool) -> Path:
    """Write a file whole or not at all. **Raises** `ValueError` if it exists and `overwrite` is not set."""
    path = Path(path)
    if path.exists() and not overwrite:
        raise ValueError(f"{path} exists already; give another file, or --overwrite to replace it")
    write_bytes(path, content)
    return path


def facts(scenario: Scenario, what: str, shield: str | None, **more: Any) -> dict[str, Any]:
    """Metadata of an exported file, as plain JSON values."""
    about = {
        "sidestep": sidestep.__version__,
        "what": what,
        "units": UNITS,
        "scenario": scenario_to_dict(scenario),
        "control_period": float(scenario_to_dict(scenario)["control_period"]),
    }
    if shield is not None:
        about |= {"shield": shield, "status": STATUS_WORDS}
    return about | more


def as_text(about: Mapping[str, Any]) -> dict[str, str]:
    """Metadata as text by name; values that are not text become JSON."""
    return {
        name: value if isinstance(value, str) else json.dumps(value, sort_keys=True)
        for name, value in sorted(about.items())
    }
