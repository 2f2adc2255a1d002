"""What does a robot run? A decision core without a transport: estimates, watchdog, shield, policy."""

from sidestep.bridges.onboard.core import Onboard
from sidestep.bridges.onboard.decision import LEVELS, Decision
from sidestep.bridges.onboard.readings import Reading
from sidestep.bridges.onboard.settings import OnboardSettings
from sidestep.bridges.onboard.tracks import EvaderTrack, ObstacleTrack, PursuerTrack, Track

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
