"""The page's constant data."""

from __future__ import annotations

from dataclasses import asdict
from typing import Any

from sidestep.safety.certificate.situation import plain
from sidestep.safety.shields.catalogue import SHIELDS
from sidestep.views.play.control import STRATEGIES
from sidestep.views.play.sliders import PACES, YOU, numbers_of, sliders_for
from sidestep.world import Scenario


def greeting(scenario: Scenario, policy: object, *, token: str = "", formats: list[str]) -> dict[str, Any]:
    """The first message to a page: JSON values. `formats` of episodes, which it gets under its `token`."""
    return {
        "type": "hello",
        "token": token,
        "formats": formats,
        "shields": list(SHIELDS),
        "pursuers": [YOU, *STRATEGIES],
        "sliders": [asdict(slider) for slider in sliders_for(scenario).values()],
        "defaults": numbers_of(scenario),
        "paces": list(PACES),
        "period": plain(scenario.control_period),
        "arena": float(scenario.arena_side),
        "reach": float(scenario.reach_distance),
        "counts": [scenario.pursuer_count, scenario.obstacle_count],
        "policy": policy if isinstance(policy, str) else "learned",
    }
