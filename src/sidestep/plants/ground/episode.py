"""One episode on the twin, with the decision core that a robot runs."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float

from sidestep.plants.ground.options import TwinOptions
from sidestep.plants.ground.twin import Twin
from sidestep.plants.play import play
from sidestep.plants.record import PlantEpisode
from sidestep.robot import Onboard, OnboardSettings
from sidestep.safety import Budget, Shield
from sidestep.world import Scenario, World


@dataclass(frozen=True)
class TwinEpisode(PlantEpisode):
    """One episode of T control periods on the twin. `tracking_errors` (m/s) are |mean velocity - command| of
    each period. `frames` are MuJoCo's positions at 100 Hz."""

    frames: Float[np.ndarray, "n nq"]
    options: TwinOptions

    def plant(self) -> Twin:
        """A new twin like the one used."""
        return Twin(self.scenario, self.options, self.seed)


def settings_for(options: TwinOptions) -> OnboardSettings:
    """Settings of the decision core for the twin's sensors and motors.

    The budget contains one standard deviation of the position noise, a quarter of one of the heading noise,
    the delay of the poses and the actuation delay; the motors' lag is modelled. The filters average noise and
    extrapolate the pursuer to actuation time. This is a compromise for the paper's numbers and does not bound
    the errors (`bounded_errors` does): with a larger budget the evader circles and does not arrive, with a
    smaller one it is captured.
    """
    sensors = options.sensors
    return OnboardSettings(
        budget=Budget(
            position_error=sensors.position_noise,
            heading_error=0.25 * sensors.heading_noise,
            delay=sensors.bounds()["delay"] + options.actuation_delay,
        ),
        position_noise=sensors.position_noise,
        heading_noise=sensors.heading_noise,
        actuation_delay=options.actuation_delay,
        motor_lag=options.lag,
        motor_acceleration=options.acceleration,
        predict_pursuer=True,
    )


def run_twin(
    scenario: Scenario,
    policy: str | Callable[..., Any],
    shield: str | Shield,
    pursuer: str | Callable[..., Any],
    seed: int = 0,
    options: TwinOptions | None = None,
    steps: int | None = None,
    *,
    settings: OnboardSettings | None = None,
    world: World | None = None,
) -> TwinEpisode:
    """`twin_episode` with a new decision core. For many episodes compile one core and use `twin_episode`.

    **Arguments:** `policy` and `shield` as for `evaluate`; `settings` of the decision core, see
    `settings_for`; the rest as for `twin_episode`.
    """
    options = options or TwinOptions()
    onboard = Onboard(scenario, shield, policy, settings or settings_for(options))
    return twin_episode(onboard, pursuer, seed, options, steps, world=world)


def twin_episode(
    onboard: Onboard,
    pursuer: str | Callable[..., Any],
    seed: int = 0,
    options: TwinOptions | None = None,
    steps: int | None = None,
    *,
    world: World | None = None,
) -> TwinEpisode:
    """One episode on the twin, see `sidestep.plants.play`.

    The sensors have run for 0.5 s when the episode starts.

    **Arguments:** `onboard` the decision core, with a policy; it is reset. The rest as for `play`.

    **Raises** as `play`, and `TwinError` when MuJoCo is missing.
    """
    twin = Twin(onboard.scenario, options, seed)
    sees = twin.options.pursuer_sees
    played = play(twin, onboard, pursuer, seed, steps, world=world, pursuer_sees=sees)
    return TwinEpisode(**{**vars(played), "frames": np.array(played.frames)}, options=twin.options)
