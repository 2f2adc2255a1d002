"""What happens in one episode on the twin, with the very decision core that a robot runs?"""

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
    """One episode of T control periods on the twin; `tracking_errors` are in m/s, how far the mean velocity
    of a period was from the command. `frames` are MuJoCo's positions at 100 Hz."""

    frames: Float[np.ndarray, "n nq"]
    options: TwinOptions

    def plant(self) -> Twin:
        """The twin that it was played on, built anew."""
        return Twin(self.scenario, self.options, self.seed)


def settings_for(options: TwinOptions) -> OnboardSettings:
    """What the decision core is told of the twin's sensors and motors.

    Filters average the noise, and predict the pursuer to when a command acts: a standard deviation is allowed
    for in place, a quarter of one in heading, and the delay of the poses without that of the motors, which is
    modelled. That is what the paper's numbers leave some use of, not what bounds the errors (`bounded_errors`
    does): an evader that keeps more is led round in circles and does not arrive, one that keeps less is
    caught.
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
    """One episode, as `twin_episode` with a decision core of its own; for many, compile one and use that.

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

    Sensors have been on for half a second when the clock starts.

    **Arguments:** `onboard` the decision core, with a policy; it is reset. The rest as for `play`.

    **Raises** as `play`, and `TwinError` when MuJoCo is missing.
    """
    twin = Twin(onboard.scenario, options, seed)
    sees = twin.options.pursuer_sees
    played = play(twin, onboard, pursuer, seed, steps, world=world, pursuer_sees=sees)
    return TwinEpisode(**{**vars(played), "frames": np.array(played.frames)}, options=twin.options)
