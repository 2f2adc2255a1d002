"""What would have to change for a guarantee to hold: the nearest value of each single parameter."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace

from sidestep.safety.sampled_design import delay_cost, largest_true, spare
from sidestep.safety.sampled_game import SampledGame
from sidestep.safety.situation import Situation

_TOLERANCE = 2e-5
"""Of a change, as a share of the largest one tried."""

PARAMETERS: dict[str, str] = {
    "evader_speed": "m/s",
    "pursuer_speed": "m/s",
    "pursuer_half_axle": "m",
    "capture_distance": "m",
    "control_period": "s",
    "position_error": "m",
    "heading_error": "rad",
    "delay": "s",
    "tracking_error": "m/s",
}
"""What may be changed to make a guarantee hold, and its unit."""


@dataclass(frozen=True)
class Change:
    """The nearest value of one parameter, the others as they are, with which the guarantee holds.

    `needed` is None where no value does.
    """

    parameter: str
    now: float
    needed: float | None
    unit: str


def nearest_changes(situation: Situation, clearance: float) -> tuple[Change, ...]:
    """For each single parameter the nearest value with which the guarantee holds.

    On the safe side by the coarser grid that the search uses: the value named does hold.
    """
    game, wanted = situation.game, situation.capture_distance
    hopeless = situation.walls or situation.pursuer_count > 1

    def change(parameter: str, now: float, needed: float | None) -> Change:
        return Change(parameter, now, None if hopeless else needed, PARAMETERS[parameter])

    def search(name: str, extreme: float) -> float | None:
        now = getattr(game, name)
        if hopeless or now == extreme:
            return None
        return _nearest(lambda value: _spare(replace(game, **{name: value}), wanted), now, extreme)

    fastest = 2.0 * max(game.pursuer_speed, game.evader_speed) / math.cos(game.heading_error)
    widest = 100.0 * max(game.half_axle, wanted)
    undelayed = replace(game, delay=0.0)
    return (
        change("evader_speed", game.evader_speed, search("evader_speed", fastest)),
        change("pursuer_speed", game.pursuer_speed, search("pursuer_speed", 1e-3 * game.evader_speed)),
        change("pursuer_half_axle", game.half_axle, search("half_axle", widest)),
        change("capture_distance", wanted, clearance if clearance > 0.0 else None),
        change("control_period", game.control_period, search("control_period", 0.0)),
        change("position_error", game.position_error, search("position_error", 0.0)),
        change("heading_error", game.heading_error, search("heading_error", 0.0)),
        change("delay", game.delay, search("delay", 0.0) if _spare(undelayed, wanted) >= 0.0 else None),
        change("tracking_error", game.tracking_error, search("tracking_error", 0.0)),
    )


def _spare(game: SampledGame, wanted: float) -> float:
    return spare(game, wanted + delay_cost(game))


def _nearest(value: Callable[[float], float], now: float, extreme: float) -> float | None:
    """The point nearest to `now`, toward `extreme`, where a rising function is 0; None if it stays below."""
    if value(extreme) < 0.0:
        return None
    far = largest_true(lambda share: value(extreme + share * (now - extreme)), 0.0, 1.0, _TOLERANCE)
    return extreme + far * (now - extreme)
