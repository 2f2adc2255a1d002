"""Interpolation of an episode between control instants."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import final

import numpy as np
from jaxtyping import Float

from sidestep.loop import Trajectory
from sidestep.world import Scenario

_Angles = np.ndarray | np.floating


def turn_between(before: _Angles, after: _Angles) -> _Angles:
    """The smaller angle (rad) from one heading to another, in [-pi, pi)."""
    return (after - before + np.pi) % (2.0 * np.pi) - np.pi


def relative(points: np.ndarray, poses: np.ndarray) -> np.ndarray:
    """z = R(-theta)(p - p_d): world points (..., 2) in frames (..., 3) given by x, y (m), heading (rad)."""
    return turned_back(points - poses[..., :2], poses[..., 2])


def turned_back(vectors: np.ndarray, headings: _Angles) -> np.ndarray:
    """World vectors (..., 2) in the axes of frames with these headings (rad)."""
    cosine, sine = np.cos(headings), np.sin(headings)
    x, y = vectors[..., 0], vectors[..., 1]
    return np.stack([cosine * x + sine * y, cosine * y - sine * x], axis=-1)


@final
@dataclass(frozen=True)
class Instant:
    """The state at one time, in the frame of the world or of a pursuer; m, m/s and rad.

    **Attributes:** `time` s; `period` the number of its control period; `evader (2,)`, `poses (m, 3)`,
    `obstacles (k, 2)`, `target (2,)`; `nominal (2,)` and `action (2,)` velocities of that period.
    """

    time: float
    period: int
    evader: Float[np.ndarray, "2"]
    poses: Float[np.ndarray, "m 3"]
    obstacles: Float[np.ndarray, "k 2"]
    target: Float[np.ndarray, "2"]
    nominal: Float[np.ndarray, "2"]
    action: Float[np.ndarray, "2"]

    def seen_from(self, pose: Float[np.ndarray, "3"]) -> Instant:
        """The same in the frame of this pose."""
        headings = np.asarray(turn_between(pose[2], self.poses[:, 2]))
        return replace(
            self,
            evader=relative(self.evader, pose),
            poses=np.concatenate([relative(self.poses[:, :2], pose), headings[:, None]], axis=-1),
            obstacles=relative(self.obstacles, pose),
            target=relative(self.target, pose),
            nominal=turned_back(self.nominal, pose[2]),
            action=turned_back(self.action, pose[2]),
        )


@final
class Motion:
    """An episode at any time, interpolated between control instants.

    Evader and obstacles move in straight lines, headings change at a constant rate by the smaller angle, and
    pursuers move on the arc between two poses:

        p(s) = p_0 + R(-(1 - s) D/2) (p_1 - p_0) s sinc(s D/2) / sinc(D/2),   s in [0, 1], D the turn.

    This is exact for the simulation, in which velocities and wheel speeds are constant over a period. For
    other robots it is a smooth interpolation of the recorded poses.
    """

    def __init__(self, scenario: Scenario, trajectory: Trajectory):
        self.period = float(scenario.control_period)
        self.length = trajectory.length
        worlds = trajectory.worlds
        self._evader = np.asarray(worlds.evader, float)
        self._poses = np.asarray(worlds.pursuers, float)
        self._obstacles = np.asarray(worlds.obstacles, float)[..., :2]
        self._target = np.asarray(worlds.target, float)
        self._nominal = np.asarray(trajectory.nominal, float)
        self._action = np.asarray(trajectory.action, float)

    @property
    def duration(self) -> float:
        """Duration of the episode, s."""
        return self.length * self.period

    def _split(self, times: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Control period and the share of it that has passed; the end of the episode belongs to the last
        period."""
        # A time within rounding of a whole number of periods begins that period.
        passed = np.clip(np.asarray(times, float) / self.period + 1e-9, 0.0, self.length)
        index = np.minimum(np.floor(passed).astype(int), self.length - 1)
        return index, np.clip(passed - index, 0.0, 1.0)

    def evader(self, times: Float[np.ndarray, "n"]) -> Float[np.ndarray, "n 2"]:
        """The evader's positions (m) at these times (s)."""
        return _straight(self._evader, *self._split(times))

    def poses(self, times: Float[np.ndarray, "n"]) -> Float[np.ndarray, "n m 3"]:
        """The pursuers' poses (m, rad) at these times (s)."""
        index, share = self._split(times)
        before, after, share = self._poses[index], self._poses[index + 1], share[:, None]
        turn = np.asarray(turn_between(before[..., 2], after[..., 2]))
        reach = share * np.sinc(share * turn / (2.0 * np.pi)) / np.sinc(turn / (2.0 * np.pi))
        way = turned_back(after[..., :2] - before[..., :2], (1.0 - share) * turn / 2.0)
        places = before[..., :2] + reach[..., None] * way
        return np.concatenate([places, (before[..., 2] + share * turn)[..., None]], axis=-1)

    def obstacles(self, times: Float[np.ndarray, "n"]) -> Float[np.ndarray, "n k 2"]:
        """The obstacles' positions (m) at these times (s)."""
        return _straight(self._obstacles, *self._split(times))

    def at(self, time: float) -> Instant:
        """The state at one time (s)."""
        times = np.array([time])
        period = int(self._split(times)[0][0])
        return Instant(
            time,
            period,
            self.evader(times)[0],
            self.poses(times)[0],
            self.obstacles(times)[0],
            self._target[period],
            self._nominal[period],
            self._action[period],
        )


def _straight(path: np.ndarray, index: np.ndarray, share: np.ndarray) -> np.ndarray:
    share = share.reshape(-1, *[1] * (path.ndim - 1))
    return path[index] + share * (path[index + 1] - path[index])


def nearest_pursuers(
    evader: Float[np.ndarray, "n 2"], poses: Float[np.ndarray, "n m 3"], keep: float = 0.85
) -> np.ndarray:
    """The pursuer whose frame is shown, at each of n instants: the nearest one, with hysteresis.

    Another pursuer is chosen when its distance is less than `keep` times that of the present one, so that the
    view does not flicker between two of similar distance.
    """
    distances = np.hypot(*np.moveaxis(poses[..., :2] - evader[:, None], -1, 0))
    chosen = np.empty(len(distances), int)
    now = int(np.argmin(distances[0]))
    for index, row in enumerate(distances):
        nearest = int(np.argmin(row))
        if row[nearest] < keep * row[now]:
            now = nearest
        chosen[index] = now
    return chosen
