"""The decision core of a robot, without a transport: estimates, watchdog, shield, policy."""

from sidestep.robot.core import Onboard
from sidestep.robot.decision import LEVELS, Decision
from sidestep.robot.readings import Reading
from sidestep.robot.settings import OnboardSettings
from sidestep.robot.tracks import EvaderTrack, ObstacleTrack, PursuerTrack, Track

__all__ = [
    "LEVELS",
    "Decision",
    "EvaderTrack",
    "ObstacleTrack",
    "Onboard",
    "OnboardSettings",
    "PursuerTrack",
    "Reading",
    "Track",
]
