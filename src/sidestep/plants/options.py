"""Which options do the plants in MuJoCo share?"""

from __future__ import annotations

from sidestep._bounds import Bound, one_of

PURSUER_SEES = ("truth", "measurements")
"""What the pursuer decides from: where everything truly is, or what the evader measures too."""
SEEN = one_of(*PURSUER_SEES)
PHYSICS_STEP = Bound(above=0.0, most=0.002, unit="s")
"""Longer steps are not stable."""
