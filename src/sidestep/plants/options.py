"""Which options do the plants in MuJoCo share, and are they right?"""

from __future__ import annotations

import math
from typing import Any

from sidestep.plants.library import TwinError

PURSUER_SEES = ("truth", "measurements")
"""What the pursuer decides from: where everything truly is, or what the evader measures too."""


def check_pursuer_sees(value: str) -> None:
    """**Raises** `TwinError` unless it is one of `PURSUER_SEES`."""
    if value not in PURSUER_SEES:
        raise TwinError(f"pursuer_sees = {value!r}: it must be one of {', '.join(PURSUER_SEES)}")


def check_options(options: Any, *, not_negative: tuple[str, ...], positive: tuple[str, ...]) -> None:
    """**Raises** `TwinError` for `pursuer_sees`, `physics_step` or a number of these names that cannot be."""
    check_pursuer_sees(options.pursuer_sees)
    for name in (*not_negative, *positive):
        value = getattr(options, name)
        if name in positive and not (math.isfinite(value) and value > 0.0):
            raise TwinError(f"{name} = {value!r}: it must be finite and greater than 0")
        if not (math.isfinite(value) and value >= 0.0):
            raise TwinError(f"{name} = {value!r}: it must be finite, 0 or more")
    if not 0.0 < options.physics_step <= 0.002:
        raise TwinError(f"physics_step = {options.physics_step!r}: it must be at most 0.002 s, for stability")
