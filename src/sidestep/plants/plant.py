"""What does the loop ask of a plant, whatever moves in it?"""

from __future__ import annotations

import abc
from collections.abc import Sequence
from typing import Any

import numpy as np
from jaxtyping import Float

from sidestep.plants.contacts import Contacts
from sidestep.plants.sensors import Measurement
from sidestep.world import Scenario, World


class Plant(abc.ABC):
    """A world that moves as it is commanded and is known by measurements.

    `reset` it, then `command`, `advance` and read `measurements`, in the rhythm of whoever decides; `play`
    does so once per control period. The same seed and the same commands give the same episode.

    **Attributes:** `scenario`; `pose_rate` Hz, sets of measurements per second; `tracking_error` how far the
    evader is from its command, in a unit that the plant says; `frames` to be drawn, and `frame_times` (s).
    """

    scenario: Scenario
    pose_rate: float
    tracking_error: float = 0.0
    frames: Sequence[Any] = ()
    frame_times: Sequence[float] = ()

    @abc.abstractmethod
    def reset(self, world: World, seed: int | None = None) -> None:
        """Put everything where `world` has it, at time 0; `seed` of the noise, as before if not given.

        **Raises** `TwinError` for a world with other numbers of robots than the scenario's.
        """

    @abc.abstractmethod
    def command(
        self, velocity: Float[np.ndarray, "2"], wheel_speeds: Float[np.ndarray, "m 2"], turn_rate: float = 0.0
    ) -> None:
        """Command the evader (m/s, world axes) and the pursuers (rim speeds, m/s) until the next command.

        What is beyond a limit is cut to it; what is not finite counts as a stop. `turn_rate` (rad/s) is for
        an evader that may turn.
        """

    @abc.abstractmethod
    def advance(self, duration: float) -> Contacts:
        """Let `duration` (s) pass; returns how near the evader came to what."""

    @abc.abstractmethod
    def measurements(self) -> list[Measurement]:
        """The poses that have arrived since the last call; of each robot the oldest first."""

    @property
    @abc.abstractmethod
    def time(self) -> float:
        """Seconds since the reset."""

    @property
    @abc.abstractmethod
    def world(self) -> World:
        """The true state now."""
