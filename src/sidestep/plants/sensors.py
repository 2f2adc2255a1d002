"""Pose sensors: rate, noise, delay and drop-outs."""

from __future__ import annotations

import dataclasses
import math
from collections import deque
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, NamedTuple, final

import numpy as np
from jaxtyping import Float

from sidestep._bounds import DISTANCE, bounded, check, did_you_mean
from sidestep.plants.library import TwinError

_CUT = 3.0
"""Noise is truncated at this many standard deviations, so that every error is bounded."""


@dataclass(frozen=True)
class Sensors:
    """How poses are measured. The parameters hold for every robot; the errors are independent.

    - `rate` Hz; `synchronised`: samples coincide with the control instants, otherwise the phase is random
    - `position_noise` m and `heading_noise` rad: standard deviations, per axis, of independent errors,
      truncated at three standard deviations (for positions the length of the error)
    - `position_bias` m and `heading_bias` rad: size of a constant error of random direction
    - `position_drift` m/sqrt(s) and `heading_drift` rad/sqrt(s): unbounded random walk, per axis
    - `delay` s from a sample to its arrival; `dropout`, the share of samples that never arrive
    """

    rate: float = bounded(100.0, least=0.1, most=1e4, unit="Hz")
    position_noise: float = bounded(0.0, DISTANCE)
    heading_noise: float = bounded(0.0, least=0.0, unit="rad")
    position_bias: float = bounded(0.0, DISTANCE)
    heading_bias: float = bounded(0.0, least=0.0, unit="rad")
    position_drift: float = bounded(0.0, least=0.0, unit="m/sqrt(s)")
    heading_drift: float = bounded(0.0, least=0.0, unit="rad/sqrt(s)")
    delay: float = bounded(0.0, least=0.0, most=60.0, unit="s")
    dropout: float = bounded(0.0, least=0.0, below=1.0)
    synchronised: bool = False

    def __post_init__(self):
        check(self, title="sensors: ", error=TwinError)

    def numbers(self) -> dict[str, float]:
        """All numbers by name."""
        return {name: value for name, value in dataclasses.asdict(self).items() if name != "synchronised"}

    def bounds(self) -> dict[str, float]:
        """Error bounds as arguments of `sidestep.safety.certify`, without drift and drop-outs.

        `position_error` m of the pursuer relative to the evader, the sum of both robots' errors;
        `heading_error` rad of the pursuer; `delay` s, the largest age of the newest sample.
        """
        wait = 0.0 if self.synchronised else 1.0 / self.rate
        return {
            "position_error": 2.0 * (self.position_bias + _CUT * self.position_noise),
            "heading_error": self.heading_bias + _CUT * self.heading_noise,
            "delay": self.delay + wait,
        }


SENSORS: dict[str, Sensors] = {
    "perfect": Sensors(rate=200.0, synchronised=True),
    "motion-capture": Sensors(rate=100.0, position_noise=0.002, heading_noise=math.radians(0.5), delay=0.01),
    "odometry": Sensors(
        rate=50.0,
        position_noise=0.001,
        heading_noise=math.radians(0.2),
        position_drift=0.003,
        heading_drift=math.radians(0.3),
        delay=0.02,
    ),
}
"""Presets by name."""


def make_sensors(name: str, overrides: Mapping[str, Any] | None = None) -> Sensors:
    """The preset `name` with some fields changed.

    **Raises** `TwinError` naming the known presets or fields.
    """
    if name not in SENSORS:
        raise TwinError(f"no sensors {name!r}; use one of {', '.join(SENSORS)}")
    return changed_sensors(SENSORS[name], dict(overrides or {}))


def changed_sensors(sensors: Sensors, changes: Mapping[str, Any]) -> Sensors:
    """`sensors` with some fields changed. **Raises** `TwinError` naming the known fields."""
    known = [field.name for field in dataclasses.fields(Sensors)]
    for field in changes:
        if field not in known:
            hint = did_you_mean(field, known)
            raise TwinError(f"unknown sensor field '{field}'{hint} Known: {', '.join(known)}")
    check(Sensors, changes, title="sensors: ", error=TwinError)
    return dataclasses.replace(sensors, **changes)


_SEEN_BEFORE = 0.5


class Measurement(NamedTuple):
    """A measured pose (x, y in m, heading in rad) with the time stamp (s) of its sample; `robot` is
    `evader`, `pursuer` or `obstacle`."""

    robot: str
    index: int
    stamp: float
    pose: tuple[float, float, float]


@final
class PoseSensor:
    """Measures one robot. Samples fall on multiples of `step` (s), the physics step.

    Random numbers come from `generator` in the order of the samples, so they do not depend on how the time is
    split into calls.
    """

    def __init__(
        self,
        sensors: Sensors,
        robot: str,
        index: int,
        step: float,
        generator: np.random.Generator,
    ):
        self._sensors, self._robot, self._index, self._step = sensors, robot, index, step
        self._noise, self._drops, self._walk_steps = generator.spawn(3)
        phase, direction, side = generator.random(3)
        self._phase = 0.0 if sensors.synchronised else phase / sensors.rate
        angle = 2.0 * math.pi * direction
        self._bias = np.array(
            [
                sensors.position_bias * math.cos(angle),
                sensors.position_bias * math.sin(angle),
                math.copysign(sensors.heading_bias, side - 0.5),
            ]
        )
        self._walk = np.zeros(3)
        self._taken: int | None = None
        self._under_way: deque[tuple[float, Measurement]] = deque()

    def _step_of(self, sample: int) -> int:
        """The physics step at whose end a sample is taken."""
        # Rounded up, with a tolerance for floating-point error.
        return math.ceil((self._phase + sample / self._sensors.rate) / self._step - 1e-6)

    def watch(self, first: int, poses: Float[np.ndarray, "n 3"]) -> None:
        """Take the samples that fall on the physics steps `first`, `first` + 1, ..., with these true poses.

        Each call continues at the step after the previous call's last.
        """
        if self._taken is None:
            self._taken = math.floor(first * self._step * self._sensors.rate) - 1
        while (step := self._step_of(self._taken)) < first + len(poses):
            self._taken += 1
            if step >= first:
                self._sample(step * self._step, poses[step - first])

    def _sample(self, stamp: float, pose: Float[np.ndarray, "3"]) -> None:
        sensors = self._sensors
        error = self._noise.standard_normal(3)
        reach = math.hypot(error[0], error[1])
        error[:2] *= sensors.position_noise * min(1.0, _CUT / max(reach, 1e-12))
        error[2] = sensors.heading_noise * min(max(error[2], -_CUT), _CUT)
        spread = math.sqrt(1.0 / sensors.rate)
        drift = (sensors.position_drift, sensors.position_drift, sensors.heading_drift)
        self._walk += self._walk_steps.standard_normal(3) * drift * spread
        if self._drops.random() < sensors.dropout:
            return
        x, y, heading = pose + self._bias + self._walk + error
        seen = (float(x), float(y), math.remainder(float(heading), 2.0 * math.pi))
        arrival = stamp + sensors.delay
        self._under_way.append((arrival, Measurement(self._robot, self._index, stamp, seen)))

    def arrived(self, now: float) -> list[Measurement]:
        """Measurements that have arrived by `now` (s) and were not returned before, oldest first."""
        handed_out = []
        while self._under_way and self._under_way[0][0] <= now + 1e-9:
            handed_out.append(self._under_way.popleft()[1])
        return handed_out


@final
class PoseSensors:
    """A sensor for every robot; order: evader, pursuers, obstacles.

    Each has a random generator spawned from `root`, so the sensors are independent. `counts` are the numbers
    of pursuers and obstacles.
    """

    def __init__(self, sensors: Sensors, counts: tuple[int, int], step: float, root: np.random.Generator):
        self._settings, self._step = sensors, step
        names = [("evader", 0), *(("pursuer", i) for i in range(counts[0]))]
        names += [("obstacle", i) for i in range(counts[1])]
        self._each = [
            PoseSensor(sensors, robot, index, step, generator)
            for (robot, index), generator in zip(names, root.spawn(len(names)), strict=True)
        ]

    def watch_the_start(
        self, poses: Float[np.ndarray, "robots 3"], velocities: Float[np.ndarray, "robots 2"]
    ) -> None:
        """Sample the time before the episode, in which robots moved to these poses at constant velocities
        (m/s)."""
        settings = self._settings
        before = math.ceil((_SEEN_BEFORE + settings.delay + 1.0 / settings.rate) / self._step)
        ages = self._step * np.arange(-before, 1)
        seen = np.repeat(poses[None], before + 1, axis=0)
        seen[:, :, :2] += ages[:, None, None] * velocities
        self.watch(-before, seen)

    def watch(self, first: int, poses: Float[np.ndarray, "n robots 3"]) -> None:
        """`PoseSensor.watch` of every robot."""
        for robot, sensor in enumerate(self._each):
            sensor.watch(first, poses[:, robot])

    def arrived(self, now: float) -> list[Measurement]:
        """Measurements that have arrived by `now` (s) and were not returned before; per robot, oldest
        first."""
        return [one for sensor in self._each for one in sensor.arrived(now)]

    def evaders(self, now: float) -> list[Measurement]:
        """`arrived` of the evader."""
        return self._each[0].arrived(now)

    def others(self, now: float) -> list[Measurement]:
        """`arrived` of all robots except the evader."""
        return [one for sensor in self._each[1:] for one in sensor.arrived(now)]
