"""The interface of a plant."""

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
    """A world that executes commands and returns measurements.

    Call `reset`, then repeatedly `command`, `advance` and `measurements`; `play` does so once per control
    period. The same seed and commands give the same episode.

    **Attributes:** `scenario`; `pose_rate` Hz, measurements of each robot per second; `tracking_error`, the
    evader's deviation from its command, in the plant's unit; `frames` to draw, and `frame_times` (s).
    """

    scenario: Scenario
    pose_rate: float
    tracking_error: float = 0.0
    frames: Sequence[Any] = ()
    frame_times: Sequence[float] = ()

    @abc.abstractmethod
    def reset(self, world: World, seed: int | None = None) -> None:
        """Start in `world` at time 0. `seed` is that of the noise; by default the previous one.

        **Raises** `TwinError` if the world's numbers of robots differ from the scenario's.
        """

    @abc.abstractmethod
    def command(
        self, velocity: Float[np.ndarray, "2"], wheel_speeds: Float[np.ndarray, "m 2"], turn_rate: float = 0.0
    ) -> None:
        """Command the evader (m/s, world axes) and the pursuers (rim speeds, m/s) until the next command.

        Commands are limited; one that is not finite counts as a stop. `turn_rate` (rad/s) is for an evader
        that can turn.
        """

    @abc.abstractmethod
    def advance(self, duration: float) -> Contacts:
        """Simulate `duration` (s); returns the evader's least distances."""

    @abc.abstractmethod
    def measurements(self) -> list[Measurement]:
        """The poses that have arrived since the last call; per robot, oldest first."""

    @property
    @abc.abstractmethod
    def time(self) -> float:
        """Seconds since the reset."""

    @property
    @abc.abstractmethod
    def world(self) -> World:
        """The true state now."""
