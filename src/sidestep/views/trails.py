"""The trails of all robots up to any time of an episode."""

from __future__ import annotations

from typing import Any, final

import numpy as np
from jaxtyping import Float

from sidestep.loop import Trajectory
from sidestep.views.motion import Instant, Motion, nearest_pursuers, relative
from sidestep.views.scene import correction_colours
from sidestep.views.style import OBSTACLE, PURSUER
from sidestep.views.trajectory_figures import correction_norm
from sidestep.world import Scenario

_RECENT_SECONDS = 5.0
_FINEST = 0.025
"""Largest time step (s) of a trail."""


@final
class Trails:
    """Trails up to any time, in the world and in every pursuer's frame."""

    def __init__(self, scenario: Scenario, trajectory: Trajectory, motion: Motion):
        self._parts = max(1, int(np.ceil(motion.period / _FINEST)))
        self._period = motion.period
        self.times = np.arange(motion.length * self._parts + 1) * (motion.period / self._parts)
        self._evader, self._poses = motion.evader(self.times), motion.poses(self.times)
        self._obstacles = motion.obstacles(self.times)
        self._seen = relative(self._evader[:, None], self._poses)
        self._viewers = nearest_pursuers(self._evader, self._poses)
        correction = np.repeat(np.asarray(trajectory.intervention, float), self._parts)
        self._corrected = np.flatnonzero(correction > 1e-6)
        norm = correction_norm(scenario)
        self._colours = correction_colours()(norm(correction[self._corrected]))

    @property
    def distances(self) -> Float[np.ndarray, "n"]:
        """Distances (m) of the evader from the pursuer whose frame is shown."""
        seen = self._seen[np.arange(len(self._viewers)), self._viewers]
        return np.hypot(seen[:, 0], seen[:, 1])

    def _passed(self, time: float) -> int:
        """Number of `times` up to `time`."""
        return int(np.searchsorted(self.times, time + 1e-9, side="right"))

    def viewer(self, time: float) -> int:
        """The pursuer whose frame is shown."""
        return int(self._viewers[self._passed(time) - 1])

    def in_world(self, now: Instant) -> tuple[Any, ...]:
        """Arguments of `MovingPanel.show_trails` in the world's frame."""
        count = self._passed(now.time)
        upto = lambda path, place: np.concatenate([path[:count], place[None]])  # noqa: E731
        others = [
            (upto(self._poses[:, index, :2], pose[:2]), PURSUER) for index, pose in enumerate(now.poses)
        ]
        others += [
            (upto(self._obstacles[:, index], place), OBSTACLE) for index, place in enumerate(now.obstacles)
        ]
        evader = upto(self._evader, now.evader)
        return evader, np.zeros((0, 2)), others, *self._pieces(self._evader, 0, count)

    def seen_by(self, pursuer: int, now: Instant) -> tuple[Any, ...]:
        """Arguments of `MovingPanel.show_trails` in this pursuer's frame; the older part is faint."""
        count = self._passed(now.time)
        recent = max(0, count - round(_RECENT_SECONDS / self._period) * self._parts)
        path = self._seen[:, pursuer]
        return (
            np.concatenate([path[recent:count], now.evader[None]]),
            path[: recent + 1],
            [],
            *self._pieces(path, recent, count),
        )

    def _pieces(self, path: np.ndarray, first: int, count: int) -> tuple[np.ndarray, np.ndarray]:
        """The pieces between two times with an intervention, and their colours."""
        begin, end = np.searchsorted(self._corrected, [first, count - 1])
        pieces = self._corrected[begin:end]
        return np.stack([path[pieces], path[pieces + 1]], axis=1), self._colours[begin:end]
