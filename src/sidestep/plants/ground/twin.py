"""Where is every robot at every millisecond, and what has been measured of it?"""

from __future__ import annotations

import math
from typing import Any, final

import numpy as np
from jaxtyping import Float

from sidestep.plants.contacts import Contacts, Watch
from sidestep.plants.ground.actuation import DelayLine, omniwheel_speeds, yaw_rate
from sidestep.plants.ground.options import TwinOptions
from sidestep.plants.ground.robots import WHEEL_RADIUS, scene_xml
from sidestep.plants.library import TwinError, check_robots, load_mujoco
from sidestep.plants.sensors import Measurement, PoseSensors
from sidestep.world import Scenario, World

_SETTLE = 0.3
_COLOURS = ("#0072B2", "#D55E00", "#595959")
_FRAME_RATE = 100.0
_LIMITS = ("evader_speed", "pursuer_speed")


class _Places:
    """Where in MuJoCo's state each robot is found."""

    def __init__(self, mujoco: Any, model: Any, base: str, pursuers: int, obstacles: int):
        def joint(name: str) -> int:
            return mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_JOINT, name)

        def motor(name: str) -> int:
            return mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_ACTUATOR, name)

        def position(name: str) -> int:
            return int(model.jnt_qposadr[joint(name)])

        def velocity(name: str) -> int:
            return int(model.jnt_dofadr[joint(name)])

        self.floating = base != "servo"
        self.evader = position("evader" if self.floating else "evader_x")
        self.evader_velocity = velocity("evader" if self.floating else "evader_x")
        names = [f"wheel{index}" for index in range(3)] if self.floating else ["x", "y", "yaw"]
        self.evader_motors = [motor(f"evader_{name}") for name in names]
        self.pursuers = [position(f"pursuer{i}") for i in range(pursuers)]
        self.pursuer_velocities = [velocity(f"pursuer{i}") for i in range(pursuers)]
        sides = [[f"pursuer{i}_left", f"pursuer{i}_right"] for i in range(pursuers)]
        self.wheels = [[velocity(name) for name in pair] for pair in sides]
        self.wheel_motors = [[motor(name) for name in pair] for pair in sides]
        self.obstacles = [position(f"obstacle{i}_x") for i in range(obstacles)]
        self.obstacle_velocities = [velocity(f"obstacle{i}_x") for i in range(obstacles)]
        self.obstacle_motors = [[motor(f"obstacle{i}_{axis}") for axis in "xy"] for i in range(obstacles)]


def _heading(quaternions: Float[np.ndarray, "n 4"]) -> Float[np.ndarray, "n"]:
    """Turn about the vertical (rad) of unit quaternions w, x, y, z."""
    w, x, y, z = quaternions.T
    return np.arctan2(2.0 * (w * z + x * y), 1.0 - 2.0 * (y * y + z * z))


@final
class Twin:
    """The scenario's robots as bodies with motors, wheels and friction, in MuJoCo.

    `reset` it to a world; then `command`, `advance` and read `measurements`, in the rhythm of whoever
    decides. The same seed and the same commands give the same motion and the same measurements.

    **Attributes:** `model` and `data` of MuJoCo; `frames` the positions (n, nq) at 100 Hz since the reset
    and `frame_times (n,)` in s, to be drawn.

    **Raises** `TwinError` when MuJoCo is missing, `ValueError` for robots of one's own.
    """

    def __init__(self, scenario: Scenario, options: TwinOptions | None = None, seed: int = 0):
        scenario.check_built_in("the twin", "`sidestep fly` flies a quadrotor, sidestep.plants.air")
        self._mujoco = mujoco = load_mujoco()
        self.scenario, self.options = scenario, options or TwinOptions()
        self._seed = seed
        pursuers, obstacles = scenario.pursuer_count, scenario.obstacle_count
        xml = scene_xml(
            self.options.base,
            float(scenario.pursuer_half_axle),
            pursuers,
            obstacles,
            physics_step=self.options.physics_step,
            lag=self.options.lag,
            pursuer_lag=self.options.pursuer_lag,
            acceleration=self.options.acceleration,
            colours=_COLOURS,
        )
        self.model: Any = mujoco.MjModel.from_xml_string(xml)
        self.data: Any = mujoco.MjData(self.model)
        self._places = _Places(mujoco, self.model, self.options.base, pursuers, obstacles)
        self._limits = {name: float(getattr(scenario, name)) for name in _LIMITS}

    def reset(self, world: World, seed: int | None = None) -> None:
        """Everything where `world` has it, at rest but for the obstacles, at time 0; `seed` replaces its own.

        **Raises** `TwinError` for a world with other numbers of robots than the scenario's.
        """
        scenario, places, data = self.scenario, self._places, self.data
        counts = scenario.pursuer_count, scenario.obstacle_count
        check_robots(world, *counts)
        self._seed = self._seed if seed is None else seed
        self._target = np.asarray(world.target, float)
        self._steps = 0
        self._mujoco.mj_resetData(self.model, data)
        self._place(world)
        # Wheels sink a tenth of a millimetre into the floor; let them before the clock starts.
        for _ in range(round(_SETTLE / self.options.physics_step)):
            self._mujoco.mj_step(self.model, data)
        data.qvel[:] = 0.0
        self._place(world)
        data.time = 0.0
        for index, velocity in enumerate(np.asarray(world.obstacles, float)[:, 2:]):
            first = places.obstacle_velocities[index]
            data.qvel[first : first + 2] = velocity
            data.ctrl[places.obstacle_motors[index]] = velocity
        still = np.zeros(2)
        self._velocity = DelayLine(self.options.actuation_delay, still)
        self._known_heading = 0.0
        self._commanded = np.zeros((counts[0], 2))
        self.frames: list[Float[np.ndarray, "nq"]] = []
        self.frame_times: list[float] = []
        self._contacts = Watch(scenario, self._target)
        poses = self.poses_of(data.qpos[None])[0]
        moving = np.zeros((len(poses), 2))
        for robot, first in enumerate(places.obstacle_velocities, 1 + counts[0]):
            moving[robot] = data.qvel[first : first + 2]
        root, step = np.random.default_rng(self._seed), self.options.physics_step
        self._sensors = PoseSensors(self.options.sensors, counts, step, root)
        self._sensors.watch_the_start(poses, moving)

    def _place(self, world: World) -> None:
        """Set x, y and heading of everything; heights stay."""
        qpos, places = self.data.qpos, self._places
        qpos[places.evader : places.evader + 2] = np.asarray(world.evader, float)
        if places.floating:
            qpos[places.evader + 3 : places.evader + 7] = (1.0, 0.0, 0.0, 0.0)
        for start, (x, y, heading) in zip(places.pursuers, np.asarray(world.pursuers, float), strict=True):
            qpos[start : start + 2] = (x, y)
            qpos[start + 3 : start + 7] = (math.cos(heading / 2.0), 0.0, 0.0, math.sin(heading / 2.0))
        for start, obstacle in zip(places.obstacles, np.asarray(world.obstacles, float), strict=True):
            qpos[start : start + 2] = obstacle[:2]

    @property
    def time(self) -> float:
        """Seconds since the reset."""
        return self._steps * self.options.physics_step

    @property
    def least_distances(self) -> tuple[float, float]:
        """Least true distances (m) to a pursuer and to an obstacle since the reset; infinite without one."""
        return self._contacts.least

    def command(self, velocity: Float[np.ndarray, "2"], wheel_speeds: Float[np.ndarray, "m 2"]) -> None:
        """What evader (m/s, world axes) and pursuers (rim speeds, m/s) are told now, cut to their limits.

        It holds until the next; the evader's takes effect after the actuation delay.
        """
        wanted = np.asarray(velocity, float)
        wanted = wanted if np.all(np.isfinite(wanted)) else np.zeros(2)
        speed, limit = math.hypot(*wanted), self._limits["evader_speed"]
        self._velocity.give(self.time, wanted * (limit / speed) if speed > limit else wanted)
        top = self._limits["pursuer_speed"]
        self._commanded = np.clip(np.nan_to_num(np.asarray(wheel_speeds, float)), -top, top)

    def advance(self, duration: float) -> Contacts:
        """Let `duration` (s) pass, in whole physics steps, and say how near the evader came to what."""
        step = self.options.physics_step
        count = round((self.time + duration) / step) - self._steps
        data, model, mj_step, places = self.data, self.model, self._mujoco.mj_step, self._places
        trace = np.empty((count, model.nq))
        speeds = np.empty((0, 2)) if not len(self._commanded) else self._commanded / WHEEL_RADIUS
        for motors, speed in zip(places.wheel_motors, speeds, strict=True):
            data.ctrl[motors] = speed
        every = max(round(1.0 / (_FRAME_RATE * step)), 1)
        in_effect = None
        for index in range(count):
            velocity = self._velocity.at(self.time)
            if velocity is not in_effect:
                in_effect = velocity
                self._drive(velocity)
            if self._steps % every == 0:
                self.frames.append(data.qpos.copy())
                self.frame_times.append(self.time)
            mj_step(model, data)
            self._steps += 1
            trace[index] = data.qpos
        if not np.all(np.isfinite(trace)):
            raise TwinError(f"the physics became unstable at {self.time:.3f} s; use a smaller physics_step")
        poses = self.poses_of(trace)
        self._sensors.watch(self._steps - count + 1, poses)
        return self._contacts.see(poses)

    def _drive(self, velocity: Float[np.ndarray, "2"]) -> None:
        """Set the evader's motors for a velocity (m/s, world axes)."""
        heading = self._known_heading
        if self._places.floating:
            speeds = omniwheel_speeds(velocity, heading)
        else:
            speeds = np.array([*velocity, yaw_rate(heading)])
        self.data.ctrl[self._places.evader_motors] = speeds

    def poses_of(self, trace: Float[np.ndarray, "n nq"]) -> Float[np.ndarray, "n robots 3"]:
        """x, y and heading of every robot, evader first, then pursuers, then obstacles, along a trace."""
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

    def measurements(self) -> list[Measurement]:
        """What has arrived by now and was not handed out before; per robot, oldest first."""
        arrived = self._sensors.arrived(self.time)
        for one in arrived:
            if one.robot == "evader":
                self._known_heading = one.pose[2]
        return arrived

    @property
    def world(self) -> World:
        """The truth now: positions, headings and velocities of the bodies."""
        data, places = self.data, self._places
        poses = self.poses_of(data.qpos[None])[0]
        m = len(places.pursuers)
        drift = [data.qvel[first : first + 2] for first in places.obstacle_velocities]
        moving = np.array(drift, float).reshape(-1, 2)
        rims = [[data.qvel[dof] * WHEEL_RADIUS for dof in pair] for pair in places.wheels]
        return World(
            evader=poses[0, :2],
            pursuers=poses[1 : 1 + m],
            obstacles=np.concatenate([poses[1 + m :, :2], moving], axis=1),
            target=self._target,
            time=self.time,
            evader_velocity=data.qvel[places.evader_velocity : places.evader_velocity + 2],
            wheel_speeds=np.array(rims, float).reshape(m, 2),
        )
