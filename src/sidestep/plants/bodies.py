"""What the plants in MuJoCo share: time steps, sensors, least distances, frames."""

from __future__ import annotations

import abc
import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float

from sidestep.plants.contacts import Watch
from sidestep.plants.library import check_robots, load_mujoco
from sidestep.plants.plant import Plant
from sidestep.plants.sensors import PoseSensors
from sidestep.world import Scenario, World

_FRAME_RATE = 100.0


@dataclass(frozen=True)
class Look:
    """How a video shows a plant.

    `height` (m) at which the robots fly, 0 on the ground; `post`, height (m) of the target's post; `trail`,
    height and width (m) of trails; `tall`, height (m) of the obstacles; `tilt` (rad) of the camera; pursuers
    farther than `near` (m) from the evader may be out of the picture.
    """

    height: float = 0.0
    post: float = 0.16
    trail: tuple[float, float] = (0.004, 0.0055)
    tall: float = 0.15
    tilt: float = math.radians(-52.0)
    near: float = math.inf


class Bodies(Plant):
    """Bodies in MuJoCo. A concrete plant places them in `_begin` and moves them in `advance`.

    **Attributes:** `model` and `data` of MuJoCo; `counts` of pursuers and obstacles; `options`; `look` for
    videos; `frames` at 100 Hz since the reset, and `frame_times` in s.

    **Raises** `TwinError` when MuJoCo is missing.
    """

    look: Look

    def __init__(self, scenario: Scenario, options: Any, seed: int, xml: str):
        self.scenario, self.options, self._seed = scenario, options, seed
        self._mujoco = load_mujoco()
        self.model: Any = self._mujoco.MjModel.from_xml_string(xml)
        self.data: Any = self._mujoco.MjData(self.model)
        self.counts = (scenario.pursuer_count, scenario.obstacle_count)
        self.pose_rate = options.sensors.rate
        self._speed = float(scenario.evader_speed)
        self._every = max(round(1.0 / (_FRAME_RATE * options.physics_step)), 1)

    def reset(self, world: World, seed: int | None = None) -> None:
        check_robots(world, *self.counts)
        self._seed = self._seed if seed is None else seed
        self._target, self._steps = np.asarray(world.target, float), 0
        self.frames: list[Any] = []
        self.frame_times: list[float] = []
        self._watch = Watch(self.scenario, self._target)
        root = np.random.default_rng(self._seed)
        self._sensors = PoseSensors(self.options.sensors, self.counts, self.options.physics_step, root)
        self._mujoco.mj_resetData(self.model, self.data)
        self._begin(world, root)

    @abc.abstractmethod
    def _begin(self, world: World, root: np.random.Generator) -> None:
        """Place all bodies, and let the sensors sample the start."""

    @property
    def time(self) -> float:
        return self._steps * self.options.physics_step

    @property
    def least_distances(self) -> tuple[float, float]:
        """Least true distances (m) to a pursuer and to an obstacle since the reset; infinite without one."""
        return self._watch.least

    def _limited(self, velocity: Float[np.ndarray, "2"]) -> Float[np.ndarray, "2"]:
        """A commanded velocity (m/s) limited to the evader's speed; zero if it is not finite."""
        command = np.asarray(velocity, float)
        command = command if np.all(np.isfinite(command)) else np.zeros(2)
        speed = math.hypot(*command)
        return command * (self._speed / speed) if speed > self._speed else command

    def _steps_in(self, duration: float) -> int:
        """Whole physics steps until `duration` (s) from now."""
        return round((self.time + duration) / self.options.physics_step) - self._steps

    def _record(self) -> None:
        """Store a frame if one is due at this step."""
        if self._steps % self._every == 0:
            self.frames.append(self._frame())
            self.frame_times.append(self.time)

    @abc.abstractmethod
    def _frame(self) -> Any:
        """The current state of the bodies, for `show`."""

    @abc.abstractmethod
    def show(self, frame: Any) -> None:
        """Set the bodies' state to one of the frames, to draw it."""

    @abc.abstractmethod
    def places_of(self, frames: Any) -> Float[np.ndarray, "n robots 2"]:
        """x and y (m) of every robot in these frames: evader, pursuers, obstacles."""
