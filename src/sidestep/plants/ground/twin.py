"""The twin as a plant: the scenario's robots and sensors in MuJoCo."""

from __future__ import annotations

import math
from typing import Any, final

import numpy as np
from jaxtyping import Float

from sidestep.plants.bodies import Bodies, Look
from sidestep.plants.contacts import Contacts
from sidestep.plants.ground.actuation import DelayLine, omniwheel_speeds, yaw_rate
from sidestep.plants.ground.options import TwinOptions
from sidestep.plants.ground.robots import WHEEL_RADIUS, scene_xml
from sidestep.plants.library import TwinError
from sidestep.plants.sensors import Measurement
from sidestep.world import Scenario, World

_SETTLE = 0.3
_COLOURS = ("#0072B2", "#D55E00", "#595959")


class _Places:
    """Indices of each robot in MuJoCo's state."""

    def __init__(self, model: Any, base: str, pursuers: int, obstacles: int):
        def motors(*names: str) -> list[int]:
            return [int(model.actuator(name).id) for name in names]

        def position(name: str) -> int:
            return int(model.joint(name).qposadr[0])

        def velocity(name: str) -> int:
            return int(model.joint(name).dofadr[0])

        self.floating = base != "servo"
        self.evader = position("evader" if self.floating else "evader_x")
        self.evader_velocity = velocity("evader" if self.floating else "evader_x")
        names = [f"wheel{index}" for index in range(3)] if self.floating else ["x", "y", "yaw"]
        self.evader_motors = motors(*(f"evader_{name}" for name in names))
        self.pursuers = [position(f"pursuer{i}") for i in range(pursuers)]
        sides = [[f"pursuer{i}_left", f"pursuer{i}_right"] for i in range(pursuers)]
        self.wheels = [[velocity(name) for name in pair] for pair in sides]
        self.wheel_motors = [motors(*pair) for pair in sides]
        self.obstacles = [position(f"obstacle{i}_x") for i in range(obstacles)]
        self.obstacle_velocities = [velocity(f"obstacle{i}_x") for i in range(obstacles)]
        self.obstacle_motors = [motors(f"obstacle{i}_x", f"obstacle{i}_y") for i in range(obstacles)]


def _heading(quaternions: Float[np.ndarray, "n 4"]) -> Float[np.ndarray, "n"]:
    """Headings (rad) of unit quaternions w, x, y, z."""
    w, x, y, z = quaternions.T
    return np.arctan2(2.0 * (w * z + x * y), 1.0 - 2.0 * (y * y + z * z))


@final
class Twin(Bodies):
    """The scenario's robots as bodies with motors, wheels and friction, in MuJoCo.

    `tracking_error` (m/s) is |mean velocity since the last command - command| of the evader. The evader holds
    its heading and ignores turn rates.

    **Attributes:** those of `Bodies`; each frame holds MuJoCo's positions `(nq,)`.

    **Raises** `TwinError` when MuJoCo is missing, `ValueError` for custom robots.
    """

    options: TwinOptions
    look = Look()

    def __init__(self, scenario: Scenario, options: TwinOptions | None = None, seed: int = 0):
        scenario.check_built_in("the twin", "`sidestep fly` flies a quadrotor, sidestep.plants.air")
        options, counts = options or TwinOptions(), (scenario.pursuer_count, scenario.obstacle_count)
        xml = scene_xml(
            options.base,
            float(scenario.pursuer_half_axle),
            *counts,
            physics_step=options.physics_step,
            lag=options.lag,
            pursuer_lag=options.pursuer_lag,
            acceleration=options.acceleration,
            colours=_COLOURS,
        )
        super().__init__(scenario, options, seed, xml)
        self._places = _Places(self.model, options.base, *counts)
        self._top = float(scenario.pursuer_speed)

    def _begin(self, world: World, root: np.random.Generator) -> None:
        places, data = self._places, self.data
        self._place(world)
        # Let the wheels settle by about 0.1 mm into the floor before the episode starts.
        for _ in range(round(_SETTLE / self.options.physics_step)):
            self._mujoco.mj_step(self.model, data)
        data.qvel[:] = 0.0
        self._place(world)
        data.time = 0.0
        for index, velocity in enumerate(np.asarray(world.obstacles, float)[:, 2:]):
            first = places.obstacle_velocities[index]
            data.qvel[first : first + 2] = velocity
            data.ctrl[places.obstacle_motors[index]] = velocity
        self._velocity = DelayLine(self.options.actuation_delay, np.zeros(2))
        self._known_heading = 0.0
        self.command(np.zeros(2), np.zeros((self.counts[0], 2)))
        poses = self.poses_of(data.qpos[None])[0]
        moving = np.zeros((len(poses), 2))
        moving[1 + self.counts[0] :] = self._drifts()
        self._sensors.watch_the_start(poses, moving)

    def _drifts(self) -> Float[np.ndarray, "k 2"]:
        """Velocities (m/s) of the obstacles."""
        drifts = [self.data.qvel[first : first + 2] for first in self._places.obstacle_velocities]
        return np.array(drifts, float).reshape(-1, 2)

    def _place(self, world: World) -> None:
        """Set x, y and heading of all robots; heights do not change."""
        qpos, places = self.data.qpos, self._places
        qpos[places.evader : places.evader + 2] = np.asarray(world.evader, float)
        if places.floating:
            qpos[places.evader + 3 : places.evader + 7] = (1.0, 0.0, 0.0, 0.0)
        for start, (x, y, heading) in zip(places.pursuers, np.asarray(world.pursuers, float), strict=True):
            qpos[start : start + 2] = (x, y)
            qpos[start + 3 : start + 7] = (math.cos(heading / 2.0), 0.0, 0.0, math.sin(heading / 2.0))
        for start, obstacle in zip(places.obstacles, np.asarray(world.obstacles, float), strict=True):
            qpos[start : start + 2] = obstacle[:2]

    def command(
        self, velocity: Float[np.ndarray, "2"], wheel_speeds: Float[np.ndarray, "m 2"], turn_rate: float = 0.0
    ) -> None:
        """As `Plant.command`; the evader's command takes effect after the actuation delay."""
        self._velocity.give(self.time, self._limited(velocity))
        self._wheels = np.clip(np.nan_to_num(np.asarray(wheel_speeds, float)), -self._top, self._top)
        self._since, self._from, self._wanted = self.time, self._evader(), np.asarray(velocity)

    def _evader(self) -> Float[np.ndarray, "2"]:
        """The evader's position (m) in the precision of a `World`."""
        first = self._places.evader
        return self.data.qpos[first : first + 2].astype(np.float32)

    @property
    def tracking_error(self) -> float:
        elapsed = self.time - self._since
        if not elapsed:
            return 0.0
        return float(np.hypot(*((self._evader() - self._from) / elapsed - self._wanted)))

    def advance(self, duration: float) -> Contacts:
        """Simulate `duration` (s) in whole physics steps; returns the evader's least distances."""
        count = self._steps_in(duration)
        data, model, mj_step, places = self.data, self.model, self._mujoco.mj_step, self._places
        trace = np.empty((count, model.nq))
        for motors, speed in zip(places.wheel_motors, self._wheels / WHEEL_RADIUS, strict=True):
            data.ctrl[motors] = speed
        in_effect = None
        for index in range(count):
            velocity = self._velocity.at(self.time)
            if velocity is not in_effect:
                in_effect = velocity
                self._drive(velocity)
            self._record()
            mj_step(model, data)
            self._steps += 1
            trace[index] = data.qpos
        if not np.all(np.isfinite(trace)):
            raise TwinError(f"the physics became unstable at {self.time:.3f} s; use a smaller physics_step")
        poses = self.poses_of(trace)
        self._sensors.watch(self._steps - count + 1, poses)
        return self._watch.see(poses)

    def _drive(self, velocity: Float[np.ndarray, "2"]) -> None:
        """Set the evader's motors for a velocity (m/s, world axes)."""
        heading = self._known_heading
        if self._places.floating:
            speeds = omniwheel_speeds(velocity, heading)
        else:
            speeds = np.array([*velocity, yaw_rate(heading)])
        self.data.ctrl[self._places.evader_motors] = speeds

    def poses_of(self, trace: Float[np.ndarray, "n nq"]) -> Float[np.ndarray, "n robots 3"]:
        """x, y and heading of all robots along a trace; order: evader, pursuers, obstacles."""
        places = self._places
        count = 1 + len(places.pursuers) + len(places.obstacles)
        poses = np.zeros((len(trace), count, 3))
        for robot, start in enumerate([places.evader, *places.pursuers, *places.obstacles]):
            poses[:, robot, :2] = trace[:, start : start + 2]
        if places.floating:
            poses[:, 0, 2] = _heading(trace[:, places.evader + 3 : places.evader + 7])
        else:
            poses[:, 0, 2] = trace[:, places.evader + 2]
        for robot, start in enumerate(places.pursuers, 1):
            poses[:, robot, 2] = _heading(trace[:, start + 3 : start + 7])
        return poses

    def _frame(self) -> Float[np.ndarray, "nq"]:
        return self.data.qpos.copy()

    def show(self, frame: Float[np.ndarray, "nq"]) -> None:
        self.data.qpos[:] = frame

    def places_of(self, frames: Any) -> Float[np.ndarray, "n robots 2"]:
        return self.poses_of(np.asarray(frames))[..., :2]

    def measurements(self) -> list[Measurement]:
        arrived = self._sensors.arrived(self.time)
        for one in arrived:
            if one.robot == "evader":
                self._known_heading = one.pose[2]
        return arrived

    @property
    def world(self) -> World:
        data, places = self.data, self._places
        poses = self.poses_of(data.qpos[None])[0]
        m = len(places.pursuers)
        rims = [[data.qvel[dof] * WHEEL_RADIUS for dof in pair] for pair in places.wheels]
        return World(
            evader=poses[0, :2],
            pursuers=poses[1 : 1 + m],
            obstacles=np.concatenate([poses[1 + m :, :2], self._drifts()], axis=1),
            target=self._target,
            time=self.time,
            evader_velocity=data.qvel[places.evader_velocity : places.evader_velocity + 2],
            wheel_speeds=np.array(rims, float).reshape(m, 2),
        )
