"""The capture game and the pursuer strategies."""

from sidestep.pursuit.catalogue import CHAUFFEURS, PURSUERS, make_pursuer
from sidestep.pursuit.foreign import as_pursuer
from sidestep.pursuit.game import CaptureGame
from sidestep.pursuit.pursuers import Pursuer, pursue, without_answer

__all__ = [
    "CHAUFFEURS",
    "PURSUERS",
    "CaptureGame",
    "Pursuer",
    "as_pursuer",
    "make_pursuer",
    "pursue",
    "without_answer",
]
