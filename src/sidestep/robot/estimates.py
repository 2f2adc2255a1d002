"""The estimated world, from the poses of all robots."""

from __future__ import annotations

import math
import operator
from collections.abc import Iterator
from typing import Any, final

import numpy as np

from sidestep.robot.answering import Estimate, Numbers
from sidestep.robot.readings import Gate
from sidestep.robot.settings import OnboardSettings
from sidestep.robot.tracks import EvaderTrack, ObstacleTrack, PursuerTrack
from sidestep.world import Scenario


@final
class Estimates:
    """A track for every robot of a scenario, behind a gate."""

    def __init__(self, scenario: Scenario, settings: OnboardSettings):
        noise = settings.position_noise, settings.heading_noise
        speed, rim = float(scenario.evader_speed), float(scenario.pursuer_speed)
        axle = float(scenario.pursuer_half_axle)
        drift = float(np.hypot(*np.asarray(scenario.obstacle_velocity, float)))
        tracking = max(float(settings.budget.tracking_error), 0.05 * speed)
        motors = settings.actuation_delay, settings.motor_lag, settings.motor_acceleration
        self.evader = EvaderTrack(*noise, tracking, *motors)
        self._pursuers = [PursuerTrack(*noise, rim, axle) for _ in range(scenario.pursuer_count)]
        self._obstacles = [
            ObstacleTrack(noise[0], drift, settings.obstacle_acceleration)
            for _ in range(scenario.obstacle_count)
        ]
        self._predict = settings.predict_pursuer
        known = settings, settings.forgotten_after(float(scenario.control_period))
        self._gates = {
            "evader": [Gate("evader", self.evader, speed, math.inf, *known)],
            "pursuer": [
                Gate(f"pursuer {index}", track, rim, rim / axle, *known)
                for index, track in enumerate(self._pursuers)
            ],
            "obstacle": [
                Gate(f"obstacle {index}", track, max(drift, rim), 0.0, *known)
                for index, track in enumerate(self._obstacles)
            ],
        }

    def __iter__(self) -> Iterator[tuple[str, Gate]]:
        """All gates, with the kinds of their robots."""
        return ((robot, gate) for robot, gates in self._gates.items() for gate in gates)

    def gate(self, robot: Any, index: Any) -> Gate | None:
        """The gate of a robot; None for a robot that the scenario does not have."""
        gates = self._gates.get(robot, []) if isinstance(robot, str) else []
        try:
            number = operator.index(index)
        except Exception:  # A caller's object may raise anything; it is not a valid index.
            return None
        return gates[number] if 0 <= number < len(gates) else None

    def unseen(self) -> list[str]:
        """Names of the robots without a pose."""
        return [gate.name for _, gate in self if gate.track.stamp is None]

    def newest(self) -> float:
        """The stamp (s) of the newest pose."""
        stamps = [gate.track.stamp for _, gate in self if gate.track.stamp is not None]
        return max(stamps, default=-math.inf)

    def forget(self, beyond: float = -math.inf) -> list[str]:
        """Forget all robots whose last stamp is later than `beyond` (s); returns their names."""
        late = [gate for _, gate in self if gate.track.stamp is not None and gate.track.stamp > beyond]
        for gate in late:
            gate.forget()
        return [gate.name for gate in late]

    def at(self, acts: float, target: Numbers, time: float) -> Estimate:
        """The estimate at time `acts` (s); pursuers at their last poses unless predicted. `target` (m) and
        `time` (s) are passed on."""
        pursuers = [track.at(acts if self._predict else -math.inf) for track in self._pursuers]
        obstacles = [np.concatenate([track.at(acts), track.velocity]) for track in self._obstacles]
        wheels = [track.wheel_speeds() for track in self._pursuers]
        return Estimate(
            evader=self.evader.at(acts)[:2],
            pursuers=np.array(pursuers).reshape(-1, 3),
            obstacles=np.array(obstacles).reshape(-1, 4),
            target=target,
            velocity=self.evader.velocity_at(acts),
            wheel_speeds=np.array(wheels).reshape(-1, 2),
            time=time,
        )
