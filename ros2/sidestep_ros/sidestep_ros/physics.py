"""What moves in the twin: the plain simulation, or bodies in MuJoCo?"""

import abc
import math
from dataclasses import dataclass
from typing import Any, NamedTuple, final

import numpy as np

from sidestep_ros.parameters import ConfigurationError


class Seen(NamedTuple):
    """A measured pose: whose, when (s since the reset) it was true, and x, y (m), heading (rad)."""

    robot: str
    index: int
    stamp: float
    pose: tuple[float, float, float]


@dataclass(frozen=True)
class Contacts:
    """What happened in a stretch of time, and the least clearance (m) to pursuers and obstacles in it."""

    captured: bool
    collided: bool
    reached: bool
    clearance: float


class Physics(abc.ABC):
    """Robots that move as they were last told, for as long as one lets them; `pose_rate` in Hz."""

    pose_rate: float

    @abc.abstractmethod
    def reset(self, world: Any, seed: int) -> None:
        """Everything where `world` has it, at time 0."""

    @property
    @abc.abstractmethod
    def world(self) -> Any:
        """Where everything truly is."""

    @abc.abstractmethod
    def command(self, velocity: Any, turn_rate: float, wheel_speeds: Any) -> None:
        """What evader (m/s in world axes, rad/s) and pursuers (rim speeds, m/s) are told from now on."""

    @abc.abstractmethod
    def advance(self, duration: float) -> Contacts:
        """Let `duration` (s) pass."""

    @abc.abstractmethod
    def measurements(self) -> list[Seen]:
        """What has been measured and arrived since the last call."""


@final
class PlainPhysics(Physics):
    """`Scenario.step`, for any stretch of time; exact poses of this instant, and an evader that may turn."""

    def __init__(self, scenario: Any, heading: float):
        import equinox as eqx
        import jax.numpy as jnp

        self._scenario = scenario

        @eqx.filter_jit
        def step(scenario: Any, world: Any, velocity: Any, wheels: Any, duration: Any) -> Any:
            held = eqx.tree_at(lambda scenario: scenario.control_period, scenario, duration)
            moved, events = held.step(world, velocity, wheels)
            # Steps are of any length here, so that time is not a number of periods.
            moved = eqx.tree_at(lambda moved: moved.time, moved, world.time + duration)
            clearance = jnp.minimum(events.pursuer_clearance, events.obstacle_clearance)
            return moved, events, clearance

        self._step = step
        self.pose_rate = 1.0 / float(scenario.control_period)
        self._first_heading = heading

    def reset(self, world: Any, seed: int) -> None:
        self._world = world
        self._heading = self._first_heading
        self.command(np.zeros(2), 0.0, np.zeros((len(world.pursuers), 2)))
        # Compiled now, not on the way.
        self._step(self._scenario, world, self._velocity, self._wheels, np.float32(0.0))

    @property
    def world(self) -> Any:
        return self._world

    def command(self, velocity: Any, turn_rate: float, wheel_speeds: Any) -> None:
        self._velocity = np.asarray(velocity, np.float32)
        self._turn_rate = turn_rate
        self._wheels = np.asarray(wheel_speeds, np.float32)

    def advance(self, duration: float) -> Contacts:
        self._world, events, clearance = self._step(
            self._scenario, self._world, self._velocity, self._wheels, np.float32(duration)
        )
        self._heading = math.remainder(self._heading + self._turn_rate * duration, 2.0 * math.pi)
        return Contacts(bool(events.captured), bool(events.collided), bool(events.reached), float(clearance))

    def measurements(self) -> list[Seen]:
        world, now = self._world, float(self._world.time)
        x, y = map(float, world.evader)
        seen = [Seen("evader", 0, now, (x, y, self._heading))]
        for index, (x, y, heading) in enumerate(np.asarray(world.pursuers, float).tolist()):
            seen.append(Seen("pursuer", index, now, (x, y, heading)))
        for index, (x, y, _, _) in enumerate(np.asarray(world.obstacles, float).tolist()):
            seen.append(Seen("obstacle", index, now, (x, y, 0.0)))
        return seen


@final
class MujocoPhysics(Physics):
    """`sidestep.plants.ground`: bodies with motors and friction, and sensors with noise and delay.

    Its evader's base keeps its own heading: it does not heed a turn rate.
    """

    def __init__(self, scenario: Any, sensors: str, base: str, seed: int):
        from sidestep.plants.ground import Twin, TwinError, TwinOptions, make_sensors

        self._scenario = scenario
        try:
            options = TwinOptions(base=base, sensors=make_sensors(sensors))
            self._twin = Twin(scenario, options, seed)
        except TwinError as error:
            raise ConfigurationError([str(error)]) from error
        self.pose_rate = options.sensors.rate

    def reset(self, world: Any, seed: int) -> None:
        self._twin.reset(world, seed)
        self.command(np.zeros(2), 0.0, np.zeros((len(world.pursuers), 2)))

    @property
    def world(self) -> Any:
        return self._twin.world

    def command(self, velocity: Any, turn_rate: float, wheel_speeds: Any) -> None:
        self._twin.command(np.asarray(velocity, float), np.asarray(wheel_speeds, float))

    def advance(self, duration: float) -> Contacts:
        found = self._twin.advance(duration)
        clearance = min(
            found.pursuer_distance - float(self._scenario.capture_distance),
            found.obstacle_distance - float(self._scenario.collision_distance),
        )
        return Contacts(found.captured, found.collided, found.reached, clearance)

    def measurements(self) -> list[Seen]:
        return [Seen(one.robot, one.index, one.stamp, one.pose) for one in self._twin.measurements()]
