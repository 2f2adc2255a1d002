"""Who chases, and how well can it: the capture game and the pursuer strategies."""

from sidestep.pursuit.foreign import as_pursuer
from sidestep.pursuit.game import CaptureGame
from sidestep.pursuit.pursuers import PURSUERS, Pursuer, make_pursuer, pursue

__all__ = ["PURSUERS", "CaptureGame", "Pursuer", "as_pursuer", "make_pursuer", "pursue"]
