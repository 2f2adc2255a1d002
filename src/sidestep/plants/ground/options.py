"""Options of the twin: motors, delays and sensors."""

from __future__ import annotations

from dataclasses import dataclass

from sidestep._bounds import ACCELERATION, DELAY, bounded, check, one_of
from sidestep.plants.ground.robots import BASES
from sidestep.plants.library import TwinError
from sidestep.plants.options import PHYSICS_STEP, SEEN
from sidestep.plants.sensors import SENSORS, Sensors
from sidestep.world import Scenario


@dataclass(frozen=True)
class TwinOptions:
    """The parameters of the twin beyond the scenario.

    - `base` of the evader, see `BASES`; `acceleration` m/s^2, the limit of its motors; `lag` s, the time
      constant of its velocity servos; `pursuer_lag` s, that of the pursuers' wheels
    - `sensors`; `actuation_delay` s of the evader, from a command to its effect
    - `pursuer_sees`, see `PURSUER_SEES`
    - `physics_step` s
    """

    base: str = bounded("servo", one_of(*BASES))
    sensors: Sensors = SENSORS["motion-capture"]
    actuation_delay: float = bounded(0.0, DELAY)
    acceleration: float = bounded(2.0, ACCELERATION)
    lag: float = bounded(0.02, above=0.0, unit="s")
    pursuer_lag: float = bounded(0.02, above=0.0, unit="s")
    pursuer_sees: str = bounded("truth", SEEN)
    physics_step: float = bounded(0.001, PHYSICS_STEP)

    def __post_init__(self):
        check(self, error=TwinError)


def bounded_errors(scenario: Scenario, options: TwinOptions) -> dict[str, float]:
    """Bounds of the twin's errors, as arguments of `sidestep.safety.certify`.

    They are those of the sensors. `delay` (s) also contains the actuation delay, the servos' time constant,
    and half the time of a full reversal at the largest acceleration.
    """
    bounds = options.sensors.bounds()
    reversal = 2.0 * float(scenario.evader_speed) / options.acceleration
    bounds["delay"] += options.actuation_delay + options.lag + reversal / 2.0
    return bounds
