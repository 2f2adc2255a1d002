"""sidestep: safe reinforcement learning for a robot that is being pursued.

Everything public is importable from here and loaded when first used, so that `import sidestep` is cheap.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

__version__ = "0.1.0"

_PUBLIC = {
    "CaptureGame": "pursuit",
    "Pursuer": "pursuit",
    "make_pursuer": "pursuit",
    "Shield": "safety",
    "ShieldResult": "safety",
    "make_shield": "safety",
    "LearnedPolicy": "learning",
    "load_policy": "learning",
    "train": "learning",
    "Evaluation": "trials",
    "Trajectory": "trials",
    "evaluate": "trials",
    "rollout": "trials",
    "Events": "world",
    "Scenario": "world",
    "ScenarioError": "world",
    "World": "world",
    "goal_seeking": "world",
    "load_scenario": "world",
    "observe": "world",
}
_ROOMS = ("world", "pursuit", "safety", "learning", "trials", "views")

__all__ = ["__version__", *_PUBLIC]  # noqa: PLE0604

if TYPE_CHECKING:
    from sidestep.learning import LearnedPolicy, load_policy, train
    from sidestep.pursuit import CaptureGame, Pursuer, make_pursuer
    from sidestep.safety import Shield, ShieldResult, make_shield
    from sidestep.trials import Evaluation, Trajectory, evaluate, rollout
    from sidestep.world import Events, Scenario, ScenarioError, World, goal_seeking, load_scenario, observe


def __getattr__(name: str) -> Any:
    if name in _PUBLIC:
        value = getattr(importlib.import_module(f"sidestep.{_PUBLIC[name]}"), name)
        globals()[name] = value
        return value
    if name in _ROOMS:
        return importlib.import_module(f"sidestep.{name}")
    raise AttributeError(f"module 'sidestep' has no attribute '{name}'")


def __dir__() -> list[str]:
    return sorted([*__all__, *_ROOMS])
