"""Everything that a certificate's answer depends on."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from sidestep.safety.sampled.sampled_game import SampledGame
from sidestep.safety.shields.adapted import covered, of_control_point
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
    stands_for: str = ""
    """The custom robots that these stand for, in words; empty for the built-in ones."""


def plain(value: Any) -> float:
    """A traced constant as the decimal that was written: 0.1574, not 0.15739999711513519."""
    return float(str(np.asarray(value)))


def situation_of(
    scenario: Scenario, half_axle: float | None, control_period: float | None, walls: bool
) -> Situation:
    """A scenario's situation with exact measurements; `half_axle` and `control_period` replace its own.

    For custom robots it is that of the evader's control point and of the drive that covers the pursuer.
    **Raises** `ValueError` where the pursuer's model names no such drive, or for a `half_axle` together with
    a pursuer's model.
    """
    stands_for = _stands_for(scenario)
    if half_axle is not None and scenario.pursuer_model is not None:
        name = type(scenario.pursuer_model).__name__
        raise ValueError(
            f"half_axle = {half_axle!r}: the pursuer is of the model {name}, which says which "
            "differential drive covers it"
        )
    scenario = covered(of_control_point(scenario))
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
        stands_for=stands_for,
    )


def _stands_for(scenario: Scenario) -> str:
    evader, pursuer, words = scenario.evader_model, scenario.pursuer_model, []
    if evader is not None:
        words.append(
            f"the control point of a {type(evader).__name__} in the evader's place, which is never more than "
            f"{plain(evader.offset(scenario)):.4g} m from it and so keeps as much more"
        )
    if pursuer is not None:
        drive = covered(scenario)
        words.append(
            f"a differential drive (V = {plain(drive.pursuer_speed):.4g} m/s, b = "
            f"{plain(drive.pursuer_half_axle):.4g} m) in the pursuer's, which can do all that this "
            f"{type(pursuer).__name__} can"
        )
    return ", and ".join(words)
