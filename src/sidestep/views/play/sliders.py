"""The numbers of the scenario that a visitor may change, with their bounds."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from sidestep._arrays import length, real
from sidestep._bounds import allowed
from sidestep.safety.certificate.situation import plain
from sidestep.world import Scenario

PACES = (0.02, 4.0)
"""Least and largest number of simulated seconds per second."""
YOU = "you"
"""The name of a pursuer driven by the visitor."""
_AHEAD = np.array([1.0, 0.0], np.float32)
_TIP_ROOM = 0.3
"""Least distance (m) of a start from the tip of the capture set."""


@dataclass(frozen=True)
class Slider:
    """One number: its name, label, unit, bounds and step."""

    name: str
    label: str
    unit: str
    low: float
    high: float
    step: float


def _slider(name: str, label: str, low: float, high: float, step: float, field: str | None = None) -> Slider:
    return Slider(name, label, allowed(Scenario)[field or name].unit, low, high, step)


SLIDERS = (
    _slider("evader_speed", "Robot's speed", 0.05, 0.4, 0.0002),
    _slider("pursuer_speed", "Pursuer's wheel speed", 0.05, 0.4, 0.001),
    _slider("pursuer_half_axle", "Pursuer's half axle", 0.05, 0.5, 0.005),
    _slider("capture_distance", "Capture distance", 0.05, 0.5, 0.001),
    _slider("collision_distance", "Obstacle's radius", 0.05, 0.5, 0.005),
    _slider("obstacle_speed", "Obstacle's speed", 0.0, 0.1, 0.005, field="obstacle_velocity"),
)
"""The page's sliders. `obstacle_speed` is the magnitude of the scenario's `obstacle_velocity`."""


def sliders_for(scenario: Scenario) -> dict[str, Slider]:
    """The sliders by name, with bounds that contain the scenario's numbers."""
    own = numbers_of(scenario)
    wide = {}
    for slider in SLIDERS:
        low, high = min(slider.low, own[slider.name]), max(slider.high, own[slider.name])
        wide[slider.name] = Slider(**{**asdict(slider), "low": low, "high": high})
    return wide


def numbers_of(scenario: Scenario) -> dict[str, float]:
    """The sliders' values for this scenario, in SI units."""
    fields = {slider.name for slider in SLIDERS} - {"obstacle_speed"}
    numbers = {name: plain(getattr(scenario, name)) for name in fields}
    drift = [plain(component) for component in scenario.obstacle_velocity]
    return {**numbers, "obstacle_speed": round(math.hypot(*drift), 6)}


def with_numbers(scenario: Scenario, numbers: Mapping[str, Any]) -> Scenario:
    """The scenario with these slider values, which may be traced; separations of starts grow with the
    distances."""
    fields = {name: value for name, value in numbers.items() if name != "obstacle_speed"}
    if "obstacle_speed" in numbers:
        fields["obstacle_velocity"] = drifts_at(scenario.obstacle_velocity, numbers["obstacle_speed"])
    changed = _replaced(scenario, fields)
    ratio = jnp.minimum(changed.evader_speed / changed.pursuer_speed, 1.0)
    tip = changed.capture_distance / ratio
    return _replaced(
        changed,
        {
            "initial_separation": jnp.maximum(scenario.initial_separation, tip + _TIP_ROOM),
            "obstacle_separation": jnp.maximum(
                scenario.obstacle_separation, 1.5 * changed.collision_distance
            ),
        },
    )


def _replaced(scenario: Scenario, fields: Mapping[str, Any]) -> Scenario:
    names = list(fields)
    if not names:
        return scenario
    return eqx.tree_at(
        lambda s: [getattr(s, name) for name in names], scenario, [real(fields[name]) for name in names]
    )


def drifts_at(velocities: Any, speed: Any) -> Float[Array, "*n 2"]:
    """Velocities (*n, 2) of obstacles scaled to this speed (m/s); along +x where they were zero."""
    velocities = real(velocities)
    lengths = length(velocities[..., 0], velocities[..., 1])[..., None]
    directions = jnp.where(lengths > 0.0, velocities / jnp.where(lengths > 0.0, lengths, 1.0), _AHEAD)
    return real(speed) * directions
