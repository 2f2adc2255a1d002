"""sidestep: safe reinforcement learning for a robot that is being pursued.

All public names are importable from here and are loaded when first used, so that `import sidestep` is fast.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

from sidestep._version import __version__ as __version__

_PUBLIC = {
    "CaptureGame": "pursuit",
    "Pursuer": "pursuit",
    "make_pursuer": "pursuit",
    "Shield": "safety",
    "ShieldResult": "safety",
    "make_shield": "safety",
    "LearnedPolicy": "learning",
    "load_policy": "learning",
    "load_pursuer": "learning",
    "train": "learning",
    "Evaluation": "trials",
    "Trajectory": "loop",
    "evaluate": "trials",
    "rollout": "loop",
    "Events": "world",
    "Scenario": "world",
    "ScenarioError": "world",
    "World": "world",
    "goal_seeking": "world",
    "load_scenario": "world",
    "observe": "world",
    "robot_fields": "world",
}
_ROOMS = ("world", "pursuit", "safety", "loop", "learning", "trials", "views")

__all__ = ["__version__", *_PUBLIC]

if TYPE_CHECKING:
    from sidestep.learning import LearnedPolicy as LearnedPolicy
    from sidestep.learning import load_policy as load_policy
    from sidestep.learning import load_pursuer as load_pursuer
    from sidestep.learning import train as train
    from sidestep.loop import Trajectory as Trajectory
    from sidestep.loop import rollout as rollout
    from sidestep.pursuit import CaptureGame as CaptureGame
    from sidestep.pursuit import Pursuer as Pursuer
    from sidestep.pursuit import make_pursuer as make_pursuer
    from sidestep.safety import Shield as Shield
    from sidestep.safety import ShieldResult as ShieldResult
    from sidestep.safety import make_shield as make_shield
    from sidestep.trials import Evaluation as Evaluation
    from sidestep.trials import evaluate as evaluate
    from sidestep.world import Events as Events
    from sidestep.world import Scenario as Scenario
    from sidestep.world import ScenarioError as ScenarioError
    from sidestep.world import World as World
    from sidestep.world import goal_seeking as goal_seeking
    from sidestep.world import load_scenario as load_scenario
    from sidestep.world import observe as observe
    from sidestep.world import robot_fields as robot_fields


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
