"""The flight as a plant: quadrotor, autopilot, aircraft, columns and sensors in MuJoCo."""

from __future__ import annotations

import math
from typing import Any, final

import numpy as np
from jaxtyping import Float

from sidestep.plants.air.airframe import ROTORS, scene_xml
from sidestep.plants.air.autopilot import Attitude, Autopilot, Setpoint
from sidestep.plants.air.estimate import OwnMotion
from sidestep.plants.air.options import FlightOptions, check_scenario
from sidestep.plants.bodies import Bodies, Look
from sidestep.plants.contacts import Contacts
from sidestep.plants.library import TwinError
from sidestep.plants.sensors import Measurement
from sidestep.views.style import EVADER, OBSTACLE, PURSUER
from sidestep.world import Scenario, World
from sidestep.world.flyers import GRAVITY, Quadrotor
from sidestep.world.robots import body_velocity

_TRAIL, _TILT, _NEAR = 0.006, math.radians(-42.0), 2.0
_COLUMN = 0.6
"""Radius of a column as a share of the collision distance; the rest is the quadrotor's radius."""


def _transition(model: Quadrotor, time: float) -> Float[np.ndarray, "4 4"]:
    """Transition matrix over `time` (s) of position, velocity, acceleration and commanded velocity, per
    axis."""
    tau, lag = float(model.time_constant), float(model.attitude_lag)
    rate = time * np.array(
        [[0, 1, 0, 0], [0, 0, 1, 0], [0, -1 / (tau * lag), -1 / lag, 1 / (tau * lag)], [0, 0, 0, 0]]
    )
    whole, term = np.eye(4), np.eye(4)
    for order in range(1, 20):
        term = term @ rate / order
        whole = whole + term
    return whole


class _Aircraft:
    """Exact motion along the heading; speed and turn rate follow the command with a first-order lag."""

    def __init__(self, pose: Float[np.ndarray, "3"], speed: float):
        self.pose = np.array(pose, float)
        self.motion = np.array([speed, 0.0])
        self.command = self.motion.copy()

    def step(self, time: float, share: float) -> None:
        self.motion += share * (self.command - self.motion)
        speed, turn_rate = self.motion
        half = 0.5 * turn_rate * time
        chord = speed * time * (math.sin(half) / half if half else 1.0)
        self.pose[0] += chord * math.cos(self.pose[2] + half)
        self.pose[1] += chord * math.sin(self.pose[2] + half)
        self.pose[2] = math.remainder(self.pose[2] + 2.0 * half, 2.0 * math.pi)


@final
class Flight(Bodies):
    """The scenario's quadrotor in MuJoCo, flown by its autopilot, with an aircraft and columns.

    The shield takes the quadrotor's state from `reference`: the motion of the model `Quadrotor` under the
    commanded velocities, which the autopilot follows. `tracking_error` (m) is the largest distance from it so
    far. The quadrotor holds its heading and ignores turn rates; `measurements` are of the other robots only.

    **Attributes:** those of `Bodies`; each frame holds MuJoCo's positions `(nq,)`, and positions and
    quaternions of the mocap bodies. `saturated` s, time with tilt or rotors at their limits.

    **Raises** `TwinError` when MuJoCo is missing, or for a scenario without a quadrotor.
    """

    options: FlightOptions

    def __init__(self, scenario: Scenario, options: FlightOptions | None = None, seed: int = 0):
        options, counts = options or FlightOptions(), (scenario.pursuer_count, scenario.obstacle_count)
        check_scenario(scenario, options)
        xml = scene_xml(
            options.airframe,
            *counts,
            physics_step=options.physics_step,
            column_radius=_COLUMN * float(scenario.collision_distance),
            column_height=2.0 * options.height,
            colours=(EVADER, PURSUER, OBSTACLE),
        )
        super().__init__(scenario, options, seed, xml)
        height = options.height
        self.look = Look(height, height, (height, _TRAIL), 1.5 * height, _TILT, _NEAR)
        self._body = int(self.model.body("quadrotor").id)
        self._motors = [int(self.model.actuator(name).id) for name in ROTORS]
        names = [f"pursuer{i}" for i in range(counts[0])] + [f"obstacle{i}" for i in range(counts[1])]
        self._mocap = [int(self.model.body(name).mocapid[0]) for name in names]
        self._ticks = round(options.autopilot_period / options.physics_step)
        model = scenario.evader_model
        assert isinstance(model, Quadrotor)
        self._transition = _transition(model, options.autopilot_period)
        self._lags = float(model.time_constant), float(model.attitude_lag)
        self._autopilot = Autopilot(options.airframe, options.gains)

    def _begin(self, world: World, root: np.random.Generator) -> None:
        """Start with the quadrotor hovering and the aircraft flying straight."""
        options, data, pursuers = self.options, self.data, self.counts[0]
        place = np.array([*np.asarray(world.evader, float), options.height])
        data.qpos[:3], data.qpos[3:7] = place, (1.0, 0.0, 0.0, 0.0)
        hover = options.airframe.mass * GRAVITY / 4.0
        data.act[:], data.ctrl[self._motors] = hover, hover
        self._plan = np.zeros((4, 2))
        self._plan[0] = place[:2]
        slowest = float(self._drivable(np.zeros((pursuers, 2)))[0, 0]) if pursuers else 0.0
        self._aircraft = [_Aircraft(pose, slowest) for pose in np.asarray(world.pursuers, float)]
        self._columns = np.asarray(world.obstacles, float).copy()
        self._autopilot.reset()
        self.tracking_error = 0.0
        self.saturated = 0.0
        (self._noise,) = root.spawn(1)
        self._own = OwnMotion(
            options.acceleration_noise, options.sensors.position_noise, 1.0 / options.sensors.rate
        )
        self._own.start(0.0, place, np.zeros(3))
        axis, lean = self._noise.uniform(-math.pi, math.pi), 0.5 * options.tilt_bias
        self._level = np.zeros(9)
        turned = (math.cos(lean), math.sin(lean) * math.cos(axis), math.sin(lean) * math.sin(axis), 0.0)
        self._mujoco.mju_quat2Mat(self._level, np.array(turned))
        self._level = self._level.reshape(3, 3)
        self._show()
        self._mujoco.mj_forward(self.model, data)
        ahead = [
            craft.motion[0] * np.array([math.cos(craft.pose[2]), math.sin(craft.pose[2])])
            for craft in self._aircraft
        ]
        moving = np.array([np.zeros(2), *ahead, *self._columns[:, 2:]])
        self._sensors.watch_the_start(self._poses(), moving)
        # The quadrotor knows its start.
        self._sensors.evaders(0.0)

    @property
    def reference(self) -> tuple[Float[np.ndarray, "2"], Float[np.ndarray, "2"], Float[np.ndarray, "2"]]:
        """The autopilot's reference now: position (m), velocity (m/s) and acceleration (m/s^2)."""
        return self._plan[0].copy(), self._plan[1].copy(), self._plan[2].copy()

    @property
    def control_point(self) -> Float[np.ndarray, "2"]:
        """The point (m) of `reference` that moves with the commanded velocity, see
        `sidestep.world.Quadrotor`."""
        tau, lag = self._lags
        return self._plan[0] + tau * (self._plan[1] + lag * self._plan[2])

    def command(
        self, velocity: Float[np.ndarray, "2"], wheel_speeds: Float[np.ndarray, "m 2"], turn_rate: float = 0.0
    ) -> None:
        self._plan[3] = self._limited(velocity)
        if len(self._aircraft):
            for aircraft, command in zip(self._aircraft, self._drivable(wheel_speeds), strict=True):
                aircraft.command = command

    def _drivable(self, wheel_speeds: Float[np.ndarray, "m 2"]) -> Float[np.ndarray, "m 2"]:
        """Speeds (m/s) and turn rates (rad/s) of the scenario's pursuer for these rim speeds."""
        scenario = self.scenario
        taken = [scenario.drivable(np.asarray(pair, np.float32)) for pair in np.asarray(wheel_speeds)]
        return np.array(
            [[float(part) for part in body_velocity(p, scenario.pursuer_half_axle)] for p in taken]
        )

    def advance(self, duration: float) -> Contacts:
        """Simulate `duration` (s) in whole physics steps; returns the evader's least distances."""
        options, data, step = self.options, self.data, self.options.physics_step
        count = self._steps_in(duration)
        share = -math.expm1(-step / options.pursuer_lag)
        poses = np.empty((count, 1 + len(self._mocap), 3))
        wind = np.array([*options.wind, 0.0])
        for index in range(count):
            self._record()
            if self._steps % self._ticks == 0:
                self._fly()
            data.xfrc_applied[self._body, :3] = options.airframe.drag * (wind - data.qvel[:3])
            for aircraft in self._aircraft:
                aircraft.step(step, share)
            self._columns[:, :2] += step * self._columns[:, 2:]
            self._show()
            self._mujoco.mj_step(self.model, data)
            self._steps += 1
            if self._steps % self._ticks == 0:
                self._plan[:] = self._transition @ self._plan
            poses[index] = self._poses()
            self._sensors.watch(self._steps, poses[index : index + 1])
        if not np.all(np.isfinite(poses)) or abs(data.qpos[2] - options.height) > 0.5 * options.height:
            raise TwinError(
                f"the quadrotor lost its height at {self.time:.3f} s: its gains or its rotors are too weak "
                "for its commands"
            )
        return self._watch.see(poses)

    def _fly(self) -> None:
        """One period of the autopilot."""
        data, period = self.data, self.options.autopilot_period
        plan = self._plan
        tau, lag = self._lags
        rotation = np.asarray(data.xmat[self._body]).reshape(3, 3)
        felt = np.asarray(data.qacc[:3]) + self._noise.standard_normal(3) * (
            self.options.acceleration_noise / math.sqrt(period)
        )
        # The accelerometer measures in body axes; the biased attitude turns it back, gravity included.
        taken = self._level @ rotation
        weight = np.array([0.0, 0.0, GRAVITY])
        felt = taken @ (rotation.T @ (felt + weight)) - weight
        if self._steps:
            self._own.feel(self.time, felt, period)
        for seen in self._sensors.evaders(self.time):
            # The same cameras measure the height.
            height = self.data.qpos[2] + self._noise.standard_normal() * self.options.sensors.position_noise
            self._own.see(seen.stamp, np.array([*seen.pose[:2], height]))
        jerk = ((plan[3] - plan[1]) / tau - plan[2]) / lag
        level = (np.array([*part, 0.0]) for part in (plan[1], plan[2], jerk))
        setpoint = Setpoint(np.array([*plan[0], self.options.height]), *level)
        attitude = Attitude(taken, np.asarray(data.qvel[3:6]).copy())
        own = self._own
        thrusts = self._autopilot.thrusts(setpoint, own.position, own.velocity, attitude, period)
        data.ctrl[self._motors] = thrusts
        self.tracking_error = max(self.tracking_error, math.dist(data.qpos[:2], plan[0]))
        self.saturated += period * self._autopilot.saturated

    def _show(self) -> None:
        """Set the poses of the mocap bodies."""
        data, height = self.data, self.options.height
        for body, aircraft in zip(self._mocap, self._aircraft, strict=False):
            speed, turn_rate = aircraft.motion
            bank, heading = -0.5 * math.atan(speed * turn_rate / GRAVITY), 0.5 * aircraft.pose[2]
            data.mocap_pos[body] = (*aircraft.pose[:2], height)
            data.mocap_quat[body] = (
                math.cos(heading) * math.cos(bank),
                math.cos(heading) * math.sin(bank),
                math.sin(heading) * math.sin(bank),
                math.sin(heading) * math.cos(bank),
            )
        for body, column in zip(self._mocap[len(self._aircraft) :], self._columns, strict=True):
            data.mocap_pos[body, :2] = column[:2]

    def _poses(self) -> Float[np.ndarray, "robots 3"]:
        """x, y and heading of all robots now: evader, pursuers, columns."""
        w, x, y, z = self.data.qpos[3:7]
        heading = math.atan2(2.0 * (w * z + x * y), 1.0 - 2.0 * (y * y + z * z))
        columns = [[x, y, 0.0] for x, y in self._columns[:, :2]]
        places = [[*self.data.qpos[:2], heading], *(craft.pose for craft in self._aircraft), *columns]
        return np.array(places, float)

    def _frame(self) -> tuple[np.ndarray, ...]:
        return (self.data.qpos.copy(), self.data.mocap_pos.copy(), self.data.mocap_quat.copy())

    def show(self, frame: tuple[np.ndarray, ...]) -> None:
        self.data.qpos[:], self.data.mocap_pos[:], self.data.mocap_quat[:] = frame

    def places_of(self, frames: Any) -> Float[np.ndarray, "n robots 2"]:
        return np.array([[own[:2], *others[:, :2]] for own, others, _ in frames])

    def measurements(self) -> list[Measurement]:
        return self._sensors.others(self.time)

    @property
    def world(self) -> World:
        axle = float(self.scenario.pursuer_half_axle)
        motions = np.array([craft.motion for craft in self._aircraft], float).reshape(-1, 2)
        speed, turn = motions[:, :1], axle * motions[:, 1:]
        return World(
            evader=np.asarray(self.data.qpos[:2]),
            pursuers=np.array([craft.pose for craft in self._aircraft]).reshape(-1, 3),
            obstacles=self._columns.copy(),
            target=self._target,
            time=self.time,
            evader_velocity=np.asarray(self.data.qvel[:2]),
            wheel_speeds=np.concatenate([speed - turn, speed + turn], axis=1),
            evader_state=self._plan[2].copy(),
        )
