"""The capture game and the pursuer strategies."""

from sidestep.pursuit.catalogue import CHAUFFEURS, MIXTURES, PURSUERS, make_pursuer
from sidestep.pursuit.foreign import as_pursuer
from sidestep.pursuit.game import CaptureGame
from sidestep.pursuit.mixed import Mixed
from sidestep.pursuit.pursuers import Pursuer, pursue, without_answer

__all__ = [
    "CHAUFFEURS",
    "MIXTURES",
    "PURSUERS",
    "CaptureGame",
    "Mixed",
    "Pursuer",
    "as_pursuer",
    "make_pursuer",
    "pursue",
    "without_answer",
]
