"""Everything that a certificate's answer depends on."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from sidestep.safety.sampled_game import SampledGame
from sidestep.world.scenario import Scenario


@dataclass(frozen=True)
class Situation:
    """Everything the answer depends on, in SI units; obstacles and walls only decide what can be claimed."""

    game: SampledGame
    capture_distance: float
    pursuer_count: int = 1
    obstacle_count: int = 0
    obstacle_speed: float = 0.0
    obstacle_gain: float = 0.0
    walls: bool = False


def plain(value: Any) -> float:
    """A traced constant as the decimal that was written: 0.1574, not 0.15739999711513519."""
    return float(str(np.asarray(value)))


def situation_of(
    scenario: Scenario, half_axle: float | None, control_period: float | None, walls: bool
) -> Situation:
    """A scenario's situation with exact measurements; `half_axle` and `control_period` replace its own."""
    game = SampledGame(
        evader_speed=plain(scenario.evader_speed),
        pursuer_speed=plain(scenario.pursuer_speed),
        half_axle=plain(scenario.pursuer_half_axle) if half_axle is None else float(half_axle),
        control_period=plain(scenario.control_period) if control_period is None else float(control_period),
    )
    drifts = np.asarray(scenario.obstacle_velocity, float)
    return Situation(
        game=game,
        capture_distance=plain(scenario.capture_distance),
        pursuer_count=scenario.pursuer_count,
        obstacle_count=scenario.obstacle_count,
        obstacle_speed=float(np.hypot(*drifts)),
        obstacle_gain=plain(scenario.obstacle_gain),
        walls=walls,
    )
