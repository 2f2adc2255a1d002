"""Level sets of the barriers, as exact outlines."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise
from typing import final

import numpy as np
from jaxtyping import Float
from matplotlib.axes import Axes

from sidestep.views import scene
from sidestep.views.motion import relative
from sidestep.views.style import INK
from sidestep.world import Scenario, World

_POINTS = 121


def pursuer_heights(
    scenario: Scenario,
    points: Float[np.ndarray, "... 2"],
    pose: Float[np.ndarray, "... 3"],
    *,
    pursuit: bool,
) -> Float[np.ndarray, "..."]:
    """h (m) of evader positions towards pursuers: the game's barrier with `pursuit`, else |p_e - p_d| - l.

    The game's barrier is the signed distance from the capture set K: |x| cos S + |y| sin S - l within the
    usable angle of the pursuer's axis, and |z| - l elsewhere.
    """
    scenario = scene.guarded(scenario)
    usable = float(scenario.usable_angle) if pursuit else None
    return _heights(points, pose, float(scenario.capture_distance), usable)


def _heights(points: np.ndarray, pose: np.ndarray, capture: float, usable: float | None) -> np.ndarray:
    ahead, aside = np.moveaxis(np.abs(relative(points, pose)), -1, 0)
    apart = np.hypot(ahead, aside)
    if usable is not None:
        slanted = ahead * np.cos(usable) + aside * np.sin(usable)
        apart = np.where(aside * np.cos(usable) < ahead * np.sin(usable), slanted, apart)
    return apart - capture


@final
class LevelOutlines:
    """Level sets of the least barrier over all robots, as a function of the evader's position.

    The level c > 0 of one robot's barrier is its level 0 enlarged by c. Parts where another barrier is lower
    are left out. `pursuit` as for `pursuer_heights`.
    """

    def __init__(self, scenario: Scenario, *, pursuit: bool):
        scenario = scene.guarded(scenario)
        self._usable = float(scenario.usable_angle) if pursuit else None
        self._capture, self._collision = float(scenario.capture_distance), float(scenario.collision_distance)
        angles = np.linspace(0.0, 2.0 * np.pi, _POINTS)
        self._circle = np.stack([np.cos(angles), np.sin(angles)], axis=-1)
        self._shape = self._circle
        if pursuit:
            self._shape = _dense(scene.capture_set_outline(scenario, _POINTS)) / self._capture

    def at(
        self, poses: Float[np.ndarray, "m 3"], obstacles: Float[np.ndarray, "k 2"], level: float
    ) -> Float[np.ndarray, "n 2"]:
        """Outlines of this level (m): closed, with NaN between them and where they are cut."""
        outlines = [scene.to_world((self._capture + level) * self._shape, pose) for pose in poses]
        outlines += [centre + (self._collision + level) * self._circle for centre in obstacles]
        for one, outline in enumerate(outlines):
            outside = np.ones(len(outline), bool)
            for other, pose in enumerate(poses):
                if other != one:
                    outside &= _heights(outline, pose, self._capture, self._usable) >= level
            for other, centre in enumerate(obstacles, start=len(poses)):
                if other != one:
                    outside &= np.hypot(*(outline - centre).T) - self._collision >= level
            outline[~outside] = np.nan
        gap = np.full((1, 2), np.nan)
        return np.concatenate([part for outline in outlines for part in (outline, gap)])


def draw_barrier_levels(
    axes: Axes, scenario: Scenario, world: World, *, pursuit: bool, levels: Sequence[float] = scene.LEVELS
) -> None:
    """Draw level sets of h = min_i h_i over evader positions, with all other robots fixed."""
    outlines = LevelOutlines(scenario, pursuit=pursuit)
    poses, obstacles = np.asarray(world.pursuers), np.asarray(world.obstacles)[:, :2]
    for level in levels:
        axes.plot(
            *outlines.at(poses, obstacles, level).T, color=scene.LEVEL_COLOUR, linewidth=0.6, zorder=0.5
        )
    axes.plot(*outlines.at(poses, obstacles, 0.0).T, color=INK, linewidth=1.0, zorder=2.5)


def _dense(outline: Float[np.ndarray, "n 2"]) -> Float[np.ndarray, "m 2"]:
    """The outline with more points on its straight parts, so that it can be cut there."""
    longest = 2.0 * np.median(np.hypot(*np.diff(outline, axis=0).T))
    parts = []
    for start, end in pairwise(outline):
        count = max(1, int(np.ceil(np.hypot(*(end - start)) / longest)))
        parts.append(start + np.arange(count)[:, None] / count * (end - start))
    return np.concatenate([*parts, outline[-1:]])
