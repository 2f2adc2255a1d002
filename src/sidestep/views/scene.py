"""Draw robots, paths and barriers in a scene (m, equal aspect)."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from typing import Any

import jax
import jax.numpy as jnp
import matplotlib
import numpy as np
from jaxtyping import Float
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
from matplotlib.colors import Colormap, LinearSegmentedColormap, Normalize
from matplotlib.patches import Circle, Polygon
from matplotlib.patheffects import withStroke

from sidestep.loop import Trajectory
from sidestep.safety import covered, of_control_point
from sidestep.views import style
from sidestep.views.labels import Label
from sidestep.world import Scenario, World

_MOST_MARKS = 8
_LABEL_HALO = [withStroke(linewidth=1.8, foreground="white")]
_RANKS = {style.EVADER: 0, style.PURSUER: 1}
"""Order in which time labels are placed; the first ones have priority."""
CAPTURE_SET_LOOK: dict[str, Any] = {"color": style.PURSUER, "linewidth": 1.4, "linestyle": (0, (2.5, 2))}
"""Look of the outline of the capture set K in all views."""
LEVELS = (0.1, 0.2, 0.3)
"""Levels of the barrier (m) that are drawn besides level 0."""
LEVEL_COLOUR = "#8F8F8F"
_ROBOT = 0.07
"""Length (m) of a drawn robot; it has no meaning in the problem."""


def correction_colours() -> Colormap:
    """Pale for small corrections, dark for large ones; distinct from the path's blue."""
    whole = matplotlib.colormaps["inferno_r"]
    return LinearSegmentedColormap.from_list("correction", whole(np.linspace(0.12, 0.72, 128)))


def guarded(scenario: Scenario) -> Scenario:
    """The scenario whose barriers are drawn. For custom robots it is that of the evader's control point and
    of the differential drive that covers the pursuer."""
    model = scenario.pursuer_model
    if model is not None and model.covering(scenario) is None:
        return of_control_point(dataclasses.replace(scenario, pursuer_model=None))
    return covered(of_control_point(scenario))


def drawn_half_axle(scenario: Scenario) -> float:
    """Half axle (m) of a drawn pursuer. A custom pursuer may have no axle: the scenario's half axle is only
    for its strategies, and it is drawn within its capture circle."""
    own = scenario.pursuer_model is not None
    return 0.6 * float(scenario.capture_distance) if own else float(scenario.pursuer_half_axle)


def capture_set_outline(scenario: Scenario, points: int = 181) -> Float[np.ndarray, "points 2"]:
    """Outline of the capture set K in the pursuer's frame, m, closed.

    The convex hull of the disc of radius l and the points (+-l/rho, 0); the disc if the evader is at least as
    fast as the pursuer.
    """
    scenario = guarded(scenario)
    radius, usable = float(scenario.capture_distance), float(scenario.usable_angle)
    left = np.linspace(usable, np.pi - usable, points // 2)
    arc = radius * np.stack([np.cos(left), np.sin(left)], axis=-1)
    apex = np.array([[radius / np.cos(usable), 0.0]])
    return np.concatenate([apex, arc, -apex, -arc, apex])


def capture_set_words(scenario: Scenario) -> str:
    """The legend's name of `capture_set_outline`."""
    return "capture set K" if scenario.evader_model is None else "capture set K of the control point"


def to_world(points: Float[np.ndarray, "n 2"], pose: Float[np.ndarray, "3"]) -> Float[np.ndarray, "n 2"]:
    """Points of a pursuer's frame in world coordinates."""
    cosine, sine = np.cos(pose[2]), np.sin(pose[2])
    return pose[:2] + points @ np.array([[cosine, sine], [-sine, cosine]])


def mark_periods(duration: float, period: float) -> list[int]:
    """Control periods at which a path gets a time mark: round seconds, at most eight."""
    intervals = (0.5,) if duration <= 2.0 else (1, 2, 5, 10, 20, 30, 60, 120, 300)
    interval = next((step for step in intervals if duration / step <= _MOST_MARKS), intervals[-1])
    times = np.arange(interval, duration + 1e-9, interval)
    return [round(time / period) for time in times]


def world_at(trajectory: Trajectory, period: int) -> World:
    """The world at the beginning of a control period."""
    return jax.tree.map(lambda leaf: jnp.asarray(leaf[period]), trajectory.worlds)


def tightest_period(trajectory: Trajectory) -> int:
    """The control period at whose beginning the sum of the least barriers towards pursuers and towards
    obstacles is smallest; `trajectory.length`, the end, if the evader was lost."""
    if trajectory.outcome in ("captured", "collided"):
        return trajectory.length
    values = np.nan_to_num(np.asarray(trajectory.barriers), neginf=0.0)
    pursuers = trajectory.worlds.pursuers.shape[1]
    groups = [group for group in (values[:, :pursuers], values[:, pursuers:]) if group.shape[1]]
    return int(np.argmin(np.sum([group.min(axis=1) for group in groups], axis=0)))


def _at(point: Float[np.ndarray, "..."]) -> tuple[float, float]:
    return float(point[0]), float(point[1])


def set_limits(axes: Axes, points: Float[np.ndarray, "n 2"], margin: float) -> None:
    """Set equal scales and limits that contain all points with `margin` (m) around them."""
    low, high = points.min(axis=0) - margin, points.max(axis=0) + margin
    axes.set_aspect("equal", adjustable="box")
    axes.set_xlim(low[0], high[0])
    axes.set_ylim(low[1], high[1])


def draw_pursuer(
    axes: Axes, pose: Float[np.ndarray, "3"], *, alpha: float = 1.0, size: float = _ROBOT
) -> None:
    """An arrowhead along the pursuer's heading."""
    shape = size * np.array([[0.75, 0.0], [-0.5, 0.5], [-0.25, 0.0], [-0.5, -0.5]])
    axes.add_patch(
        Polygon(
            to_world(shape, pose),
            facecolor=style.PURSUER,
            edgecolor="white",
            linewidth=0.5,
            alpha=alpha,
            zorder=6,
        )
    )


def draw_capture_set(axes: Axes, scenario: Scenario, pose: Float[np.ndarray, "3"]) -> None:
    """The capture circle and the capture set K around a pursuer."""
    style.draw_disc(axes, _at(pose[:2]), float(scenario.capture_distance), style.PURSUER, alpha=0.12)
    outline = to_world(capture_set_outline(scenario), pose)
    # Above the level h = 0, which coincides with it for shields that keep K.
    axes.plot(*outline.T, **CAPTURE_SET_LOOK, zorder=3)


def draw_obstacles(
    axes: Axes, scenario: Scenario, trajectory: Trajectory, period: int, marks: Sequence[int]
) -> None:
    """Each obstacle's path and its collision circle at control period `period`, faintly at the time marks."""
    radius, length = float(scenario.collision_distance), float(scenario.control_period)
    path = np.asarray(trajectory.worlds.obstacles)
    for index in range(path.shape[1]):
        axes.plot(*path[:, index, :2].T, color=style.OBSTACLE, linewidth=1.0, zorder=2)
        for mark in (0, *marks):
            axes.add_patch(
                Circle(
                    _at(path[mark, index]), radius, fill=False, edgecolor=style.FAINT, linewidth=0.7,
                    linestyle=":", zorder=1,
                )
            )  # fmt: skip
        draw_time_marks(axes, path[:, index, :2], marks, length, style.OBSTACLE)
        centre = _at(path[period, index])
        style.draw_disc(axes, centre, radius, style.OBSTACLE, alpha=0.18)
        axes.plot(*centre, "o", color=style.OBSTACLE, markersize=4, zorder=8.5)


def draw_target(axes: Axes, scenario: Scenario, target: Float[np.ndarray, "2"]) -> None:
    """The target and the reach distance."""
    reach = float(scenario.reach_distance)
    axes.add_patch(Circle(_at(target), reach, facecolor=style.TARGET, alpha=0.25, linewidth=0, zorder=2))
    axes.plot(*target, "*", zorder=7, **style.mark(style.TARGET, 9, width=0.6))


def draw_time_marks(
    axes: Axes,
    path: Float[np.ndarray, "t 2"],
    periods: Sequence[int],
    period: float,
    colour: str,
    *,
    dots: bool = True,
    side: float = 1.0,
) -> None:
    """The time in seconds, and a dot, at these control periods of a path; `side` -1 prefers its right.

    Labels without room are left out when the figure is saved, see `place_labels`.
    """
    span = np.ptp(np.asarray([axes.get_xlim(), axes.get_ylim()]), axis=1).max()
    place = axes.get_subplotspec()
    # Labels keep their size in small scenes, so fewer fit.
    room = 0.022 * span * (1 if place is None else place.get_gridspec().ncols)
    last = None
    for mark in periods:
        if mark >= len(path):
            continue
        if dots:
            axes.plot(*path[mark], "o", zorder=8, **style.mark("white", 3.2, colour, 0.9))
        # Labels of a robot that stands still would overlap.
        if last is not None and np.hypot(*(path[mark] - last)) < room:
            continue
        last = path[mark]
        ahead = path[min(mark + 1, len(path) - 1)] - path[max(mark - 1, 0)]
        norm = np.hypot(*ahead)
        along = ahead / norm if norm > 0 else np.array([1.0, 0.0])
        aside = side * np.array([-along[1], along[0]])
        ways = (aside, -aside, aside + along, aside - along, along - aside, -along - aside, along, -along)
        places = [_at(far * way / np.hypot(*way)) for far in (9.0, 13.0) for way in ways]
        axes.add_artist(
            Label(
                f"{mark * period:g}", _at(path[mark]), places, rank=_RANKS.get(colour, len(_RANKS)),
                fontsize=6.5, color=colour, zorder=8, path_effects=_LABEL_HALO,
            )
        )  # fmt: skip


def draw_evader_path(axes: Axes, trajectory: Trajectory, norm: Normalize) -> LineCollection:
    """The evader's path; thick and coloured by the size of the correction where the shield intervened."""
    path = np.asarray(trajectory.worlds.evader)
    correction = np.asarray(trajectory.intervention)
    segments = np.stack([path[:-1], path[1:]], axis=1)
    axes.plot(*path.T, color=style.EVADER, linewidth=1.1, zorder=4)
    stepped_in = correction > 1e-6
    lines = LineCollection(
        list(segments[stepped_in]), array=correction[stepped_in], cmap=correction_colours(), norm=norm,
        linewidth=4.2, capstyle="round", zorder=3.9,
    )  # fmt: skip
    axes.add_collection(lines, autolim=False)
    return lines
