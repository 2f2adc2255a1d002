"""Gymnasium spaces of observations and actions."""

from __future__ import annotations

from typing import Any

import numpy as np
from gymnasium import spaces

from sidestep.world import Scenario, observation_names

_ROUNDING = 1e-5


def observation_space(scenario: Scenario) -> spaces.Box:
    """The space of `sidestep.observe`. All entries are within [-1, 1] (to rounding), except an obstacle's
    velocity over the evader's speed, which may be larger."""
    drift = float(np.hypot(*np.asarray(scenario.obstacle_velocity)) / np.asarray(scenario.evader_speed))
    widest = [
        max(1.0, drift) if name.endswith(("_vx", "_vy")) else 1.0 for name in observation_names(scenario)
    ]
    high = np.array(widest, np.float32) * np.float32(1.0 + _ROUNDING)
    return spaces.Box(-high, high, dtype=np.float32)


def action_space() -> spaces.Box:
    """[-1, 1]^2: the nominal velocity over the evader's speed, in the axes of the scenario's `frame`; its
    norm is clipped to 1."""
    return spaces.Box(-1.0, 1.0, (2,), np.float32)


def checked_action(action: Any, shape: tuple[int, ...]) -> np.ndarray:
    """The action as an array. **Raises** `ValueError` for a wrong shape."""
    array = np.asarray(action, np.float32)
    if array.shape != shape:
        raise ValueError(f"an action here has shape {shape}, not {array.shape}")
    return array
