"""Robots, world state, scenario, observation, reward and events."""

from sidestep.world.events import Events
from sidestep.world.field_names import ALIASES, ScenarioError, without_aliases
from sidestep.world.flyers import Aircraft, Quadrotor
from sidestep.world.known_robots import KnownRobot, known_robots, robot_fields
from sidestep.world.loading import PRESETS, load_scenario, scenario_to_dict
from sidestep.world.model_probe import EvaderProbe, ModelWarning, probe_evader
from sidestep.world.models import EvaderModel, EvaderState, PursuerModel
from sidestep.world.observation import (
    goal_seeking,
    goal_seeking_world,
    observation_names,
    observation_size,
    observe,
    to_action,
    to_velocity,
)
from sidestep.world.scenario import Scenario
from sidestep.world.state import World

__all__ = [
    "ALIASES",
    "PRESETS",
    "Aircraft",
    "EvaderModel",
    "EvaderProbe",
    "EvaderState",
    "Events",
    "KnownRobot",
    "ModelWarning",
    "PursuerModel",
    "Quadrotor",
    "Scenario",
    "ScenarioError",
    "World",
    "goal_seeking",
    "goal_seeking_world",
    "known_robots",
    "load_scenario",
    "observation_names",
    "observation_size",
    "observe",
    "probe_evader",
    "robot_fields",
    "scenario_to_dict",
    "to_action",
    "to_velocity",
    "without_aliases",
]
