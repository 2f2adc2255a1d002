"""Options of a flight: the quadrotor, its sensors and disturbances."""

from __future__ import annotations

import math
from dataclasses import dataclass, field

from sidestep._bounds import DISTANCE, WIND, bounded, check
from sidestep.plants.air.airframe import Airframe
from sidestep.plants.air.autopilot import Gains
from sidestep.plants.library import TwinError
from sidestep.plants.options import PHYSICS_STEP, SEEN
from sidestep.plants.sensors import Sensors
from sidestep.safety import Budget
from sidestep.world import Scenario
from sidestep.world.flyers import GRAVITY, Quadrotor

ROOM_SENSORS = Sensors(rate=100.0, position_noise=0.001, heading_noise=math.radians(0.25), delay=0.01)
"""Motion capture in a lab for small drones."""


@dataclass(frozen=True)
class FlightOptions:
    """The parameters of a flight beyond the scenario.

    - `airframe`, `gains`; `sensors` of all poses, including the quadrotor's
    - `tracking_error` m: bound on the quadrotor's distance from its reference motion. The shield's budget
      contains it, and an episode reports when it is exceeded
    - `acceleration_noise` m/s^2 per root hertz, of the accelerometer; `tilt_bias` rad, of the attitude
    - `wind (2,)` m/s
    - `pursuer_lag` s: time constant of the aircraft's speed and turn rate; `pursuer_sees`, see `PURSUER_SEES`
    - `height` m of all robots
    - `physics_step` and `autopilot_period`, s, the second a multiple of the first
    """

    airframe: Airframe = field(default_factory=Airframe)
    gains: Gains = field(default_factory=Gains)
    sensors: Sensors = ROOM_SENSORS
    tracking_error: float = bounded(0.04, DISTANCE)
    acceleration_noise: float = bounded(0.02, least=0.0, unit="m/s^2 per root hertz")
    tilt_bias: float = bounded(math.radians(0.3), least=0.0, unit="rad")
    wind: tuple[float, float] = bounded((0.0, 0.0), WIND)
    pursuer_lag: float = bounded(0.1, above=0.0, unit="s")
    pursuer_sees: str = bounded("truth", SEEN)
    height: float = bounded(0.8, above=0.0, unit="m")
    physics_step: float = bounded(0.001, PHYSICS_STEP)
    autopilot_period: float = bounded(0.002, above=0.0, most=0.01, unit="s")

    def __post_init__(self):
        check(self, error=TwinError)
        ticks = self.autopilot_period / self.physics_step
        if abs(ticks - round(ticks)) >= 1e-6 or ticks <= 0.5:
            raise TwinError(
                f"autopilot_period = {self.autopilot_period!r}: it must be a multiple of physics_step = "
                f"{self.physics_step!r}"
            )


def errors_of(options: FlightOptions) -> dict[str, float]:
    """Bounds of the shield's errors, as arguments of `Budget` and `certify`.

    Position: the sensors' error of the other robot plus the quadrotor's tracking error, because the shield
    uses its reference motion. Heading and delay: those of the sensors.
    """
    bounds = options.sensors.bounds()
    # The sensors' bound counts both robots as measured; the evader's position error is `tracking_error`.
    position = 0.5 * bounds["position_error"] + options.tracking_error
    return {**bounds, "position_error": position}


def budget_of(options: FlightOptions) -> Budget:
    """The shield's budget for `errors_of`."""
    errors = errors_of(options)
    return Budget(errors["position_error"], errors["heading_error"], errors["delay"])


def check_scenario(scenario: Scenario, options: FlightOptions) -> None:
    """**Raises** `TwinError` for a scenario whose evader is not a `Quadrotor`, or would tilt too far."""
    model = scenario.evader_model
    if not isinstance(model, Quadrotor):
        raise TwinError(
            f"the scenario '{scenario.name}' has no quadrotor: use the preset 'quadrotor' or "
            "'quadrotor-test', or set "
            'evader_model = "quadrotor" and pursuer_model = "aircraft"'
        )
    if scenario.pursuer_model is None:
        raise TwinError(
            f"the scenario '{scenario.name}' has a differential drive pursue a quadrotor: set "
            'pursuer_model = "aircraft", or a custom model'
        )
    tilt, most = float(model.largest_tilt(scenario)), options.gains.largest_tilt
    frame = options.airframe
    lift = 4.0 * frame.largest_thrust * math.cos(tilt) / (GRAVITY * frame.mass)
    if tilt >= most or lift <= 1.0:
        why = (
            f"tilts {math.degrees(tilt):.0f} degrees, more than largest_tilt = {math.degrees(most):.0f}"
            if tilt >= most
            else f"tilts {math.degrees(tilt):.0f} degrees, where its rotors cannot hold its height"
        )
        raise TwinError(
            f"commanded up to {float(scenario.evader_speed):g} m/s, this quadrotor {why}: give its "
            "model a longer time_constant, or a lower evader_speed"
        )
