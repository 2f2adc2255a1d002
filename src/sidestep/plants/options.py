"""Options shared by the plants in MuJoCo."""

from __future__ import annotations

from sidestep._bounds import Bound, one_of

PURSUER_SEES = ("truth", "measurements")
"""What the pursuer decides from: the true world, or the world estimated from the evader's measurements."""
SEEN = one_of(*PURSUER_SEES)
PHYSICS_STEP = Bound(above=0.0, most=0.002, unit="s")
"""Longer steps are not stable."""
