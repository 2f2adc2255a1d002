"""Where is everything, as far as the poses tell?"""

from __future__ import annotations

import math
import operator
from collections.abc import Iterator
from typing import Any, final

import numpy as np

from sidestep.robot.answering import Numbers, Seen
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
        """Every gate, with the kind of its robot."""
        return ((robot, gate) for robot, gates in self._gates.items() for gate in gates)

    def gate(self, robot: Any, index: Any) -> Gate | None:
        """That of a robot; None for anything that the scenario does not have."""
        gates = self._gates.get(robot, []) if isinstance(robot, str) else []
        try:
            number = operator.index(index)
        except Exception:  # Whatever an object of somebody's raises: it is no number of a robot.
            return None
        return gates[number] if 0 <= number < len(gates) else None

    def unseen(self) -> list[str]:
        """The robots of which nothing is known."""
        return [gate.name for _, gate in self if gate.track.stamp is None]

    def newest(self) -> float:
        """When the newest pose was true, s."""
        stamps = [gate.track.stamp for _, gate in self if gate.track.stamp is not None]
        return max(stamps, default=-math.inf)

    def forget(self, beyond: float = -math.inf) -> list[str]:
        """Forget all robots seen later than `beyond` (s), as if they had never been; returns their names."""
        late = [gate for _, gate in self if gate.track.stamp is not None and gate.track.stamp > beyond]
        for gate in late:
            gate.forget()
        return [gate.name for gate in late]

    def at(self, acts: float, target: Numbers, time: float) -> Seen:
        """Everything as it should be when the command acts; pursuers as last seen unless predicted. `target`
        and `time` are passed on."""
        pursuers = [track.at(acts if self._predict else -math.inf) for track in self._pursuers]
        obstacles = [np.concatenate([track.at(acts), track.velocity]) for track in self._obstacles]
        wheels = [track.wheel_speeds() for track in self._pursuers]
        return Seen(
            evader=self.evader.at(acts)[:2],
            pursuers=np.array(pursuers).reshape(-1, 3),
            obstacles=np.array(obstacles).reshape(-1, 4),
            target=target,
            velocity=self.evader.velocity_at(acts),
            wheel_speeds=np.array(wheels).reshape(-1, 2),
            time=time,
        )
