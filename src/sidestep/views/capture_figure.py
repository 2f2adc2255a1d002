"""The figure of one capture under the paper's shield: where, why and how."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.patches import Circle, FancyArrowPatch, Polygon

from sidestep.loop import Trajectory
from sidestep.trials import Capture, explain_capture
from sidestep.views import style
from sidestep.views.scene import (
    draw_capture_set,
    draw_pursuer,
    draw_time_marks,
    mark_periods,
    set_limits,
)
from sidestep.world import Scenario

_SHOWN_SECONDS = 3.0


def capture_figure(scenario: Scenario, trajectory: Trajectory, path: str | Path) -> tuple[Path, Path]:
    """One capture under the paper's shield, in three panels. Writes PNG and PDF; returns their paths.

    a: the last seconds, zoomed; b: the evader's possible velocities when it was lost, with the half planes of
    the shield's row and of the pursuer's true motion; c: both over time.

    **Raises** `ValueError` when the episode did not end in a capture.
    """
    capture = explain_capture(scenario, trajectory)
    with style.house_style():
        figure = style.new_figure(style.WIDTH, 5.8)
        grid = figure.add_gridspec(3, 2, height_ratios=[1.45, 1.0, 0.26])
        scene, plane, speeds, key = (
            figure.add_subplot(grid[0, 0]),
            figure.add_subplot(grid[0, 1]),
            figure.add_subplot(grid[1, :]),
            figure.add_subplot(grid[2, :]),
        )
        _draw_last_seconds(scene, scenario, trajectory, capture)
        _draw_velocity_plane(plane, scenario, trajectory, capture)
        _draw_speeds(speeds, key, scenario, trajectory, capture)
        when = (trajectory.length - 1) * float(scenario.control_period)
        style.panel_titles(
            [scene, plane, speeds],
            ["The last seconds", f"What it could do at {when:.1f} s", "Speed away from the pursuer"],
            in_caption=True,
        )
        return style.save(figure, path)


def _first_shown(scenario: Scenario, trajectory: Trajectory) -> int:
    return max(0, trajectory.length - round(_SHOWN_SECONDS / float(scenario.control_period)))


def _arrow(axes: Axes, begin: np.ndarray, end: np.ndarray, colour: str, width: float = 1.4) -> None:
    axes.add_patch(
        FancyArrowPatch(
            tuple(begin), tuple(end), arrowstyle="-|>", mutation_scale=8, color=colour, linewidth=width,
            shrinkA=0, shrinkB=0, zorder=8,
        )
    )  # fmt: skip


def _draw_last_seconds(axes: Axes, scenario: Scenario, trajectory: Trajectory, capture: Capture) -> None:
    first, length = _first_shown(scenario, trajectory), float(scenario.control_period)
    evader = np.asarray(trajectory.worlds.evader)[first:]
    poses = np.asarray(trajectory.worlds.pursuers)[first:, capture.pursuer]
    marks = [m - first for m in mark_periods(trajectory.length * length, length) if m >= first]
    if len(marks) < 3:
        every = round(1.0 / length)
        marks = [m - first for m in range(first, trajectory.length + 1) if m % every == 0]
    reach = float(scenario.capture_distance)
    corners = poses[-1, :2] + np.array([[-reach, -reach], [reach, reach]])
    points = np.concatenate([evader, poses[:, :2], corners])
    centre, half = (points.min(axis=0) + points.max(axis=0)) / 2, np.ptp(points, axis=0).max() / 2
    set_limits(axes, np.stack([centre - half, centre + half]), 0.06)
    draw_capture_set(axes, scenario, poses[-1])
    axes.plot(*poses[:, :2].T, color=style.PURSUER, linewidth=1.4, zorder=4)
    axes.plot(*evader.T, color=style.EVADER, linewidth=1.4, zorder=4)
    size = 0.055 * float(np.ptp(axes.get_xlim()))
    for mark in marks:
        draw_pursuer(axes, poses[mark], size=size)
    draw_pursuer(axes, poses[-1], size=1.5 * size)
    _time_labels(axes, evader, marks, first, length, style.EVADER, dots=True)
    _time_labels(axes, poses[:, :2], marks, first, length, style.PURSUER, dots=False)
    late = capture.decisive_period - first
    if late >= 0:
        axes.plot(*evader[late], "o", zorder=9, **style.mark(style.EVADER, 5, style.INK, 0.9))
    axes.plot(*evader[-1], "X", zorder=9, **style.mark(style.PURSUER, 9))
    axes.set_xlabel("x, m")
    axes.set_ylabel("y, m")


def _time_labels(
    axes: Axes, path: np.ndarray, marks: list[int], first: int, length: float, colour: str, *, dots: bool
) -> None:
    # The shown part of the path begins at `first`; padding keeps the labels in the episode's time.
    padded = np.concatenate([np.repeat(path[:1], first, axis=0), path])
    side = 1.0 if dots else -1.0
    draw_time_marks(axes, padded, [mark + first for mark in marks], length, colour, dots=dots, side=side)


def _draw_velocity_plane(axes: Axes, scenario: Scenario, trajectory: Trajectory, capture: Capture) -> None:
    """Velocities in axes along and across the line from the pursuer to the evader, so n points right."""
    period, limit = trajectory.length - 1, float(scenario.evader_speed)
    normal = capture.normal[period]
    across = np.array([-normal[1], normal[0]])

    def turned(velocity: np.ndarray) -> np.ndarray:
        return np.array([velocity @ normal, velocity @ across])

    expected, needed = capture.expected[period], capture.needed[period]
    span = 1.85 * limit
    set_limits(axes, np.array([[-span, -1.6 * limit], [span, 1.6 * limit]]), 0.0)
    (left, right), (bottom, top) = axes.get_xlim(), axes.get_ylim()
    edge = max(expected, left)
    axes.add_patch(
        Polygon(
            [(edge, bottom), (right, bottom), (right, top), (edge, top)],
            facecolor=style.ORANGE,
            alpha=0.15,
            linewidth=0,
        )
    )
    axes.add_patch(Circle((0.0, 0.0), limit, facecolor=style.EVADER, alpha=0.12, linewidth=0))
    axes.add_patch(Circle((0.0, 0.0), limit, fill=False, edgecolor=style.EVADER, linewidth=1.2))
    axes.text(
        0.0, -1.15 * limit, "all the evader can do", color=style.EVADER, fontsize=7, ha="center", va="top"
    )
    words = {"va": "top", "fontsize": 7, "linespacing": 1.25}
    inset = 0.03 * span
    axes.text(edge + inset, top - inset, "the row\nallows\nthis side", color="#8A5F00", ha="left", **words)
    if expected > left:
        axes.axvline(expected, color=style.ORANGE, linewidth=1.6)
    if abs(needed - expected) > 1e-3:
        axes.axvline(needed, color=style.PURSUER, linewidth=1.6, linestyle=(0, (4, 2)))
        axes.text(needed + inset, top - inset, "needed:\nthis side", color=style.PURSUER, ha="left", **words)
    nominal, action = (
        turned(np.asarray(trajectory.nominal[period])),
        turned(np.asarray(trajectory.action[period])),
    )
    if np.hypot(*(nominal - action)) > 1e-3:
        _arrow(axes, np.zeros(2), nominal, "#999999")
        axes.annotate(
            "nominal", tuple(nominal), xytext=(3, 5), textcoords="offset points", fontsize=7, color="#777777"
        )
    _arrow(axes, np.zeros(2), action, style.INK, 1.8)
    norm = np.hypot(*action)
    beside = np.array([action[1], -action[0]]) / norm if norm > 0 else np.array([0.0, -1.0])
    axes.annotate(
        "executed", tuple(0.5 * action), xytext=tuple(9 * beside), textcoords="offset points", fontsize=7,
        va="center", ha="center" if abs(beside[1]) > 0.7 else "left" if beside[0] > 0 else "right",
    )  # fmt: skip
    axes.plot(0.0, 0.0, "o", color=style.INK, markersize=3)
    axes.set_xlabel("speed away from the pursuer n·u, m/s")
    axes.set_ylabel("speed across, m/s")


def _draw_speeds(axes: Axes, key: Axes, scenario: Scenario, trajectory: Trajectory, capture: Capture) -> None:
    first, length = _first_shown(scenario, trajectory), float(scenario.control_period)
    times = np.arange(first, trajectory.length) * length
    limit = float(scenario.evader_speed)
    style.light_grid(axes, "y")
    axes.axhline(limit, color=style.EVADER, linewidth=1.0, linestyle=(0, (4, 2)))
    late = capture.decisive_period * length
    if late >= times[0]:
        axes.axvline(late, color=style.INK, linewidth=0.8, linestyle=(0, (1, 2)))
        axes.annotate(
            "too slow from here on", (late, 1.0), xycoords=axes.get_xaxis_transform(), xytext=(3, -2),
            textcoords="offset points", va="top", fontsize=7,
        )  # fmt: skip
    curves = (
        (capture.expected, style.ORANGE, 2.2, "row asks for: V n·(cos θ, sin θ) − γ h, forwards at V"),
        (capture.moved, style.EVADER, 1.4, "executed: n·u"),
        (
            capture.needed,
            style.PURSUER,
            1.8,
            "truly needed: v n·(cos θ, sin θ) − γ h, the pursuer's own speed v",
        ),
    )
    for values, colour, width, label in curves:
        dashes = (0, (4, 2)) if values is capture.needed else "solid"
        axes.plot(times, values[first:], color=colour, linewidth=width, label=label, linestyle=dashes)
    axes.annotate(
        f"all the evader has: {limit:g} m/s", (times[0], limit), xytext=(2, 3), textcoords="offset points",
        fontsize=7, color=style.EVADER,
    )  # fmt: skip
    shown = np.concatenate([values[first:] for values, *_ in curves] + [[limit]])
    low, high = max(shown.min(), -2.5 * limit), shown.max()
    axes.set_ylim(low - 0.08 * (high - low), high + 0.18 * (high - low))
    axes.set_xlim(times[0], trajectory.length * length)
    axes.set_xlabel("time, s; the capture is at the right edge")
    axes.set_ylabel("along n, m/s")
    handles, _ = axes.get_legend_handles_labels()
    key.set_axis_off()
    key.legend(handles=handles, loc="center left", borderaxespad=0.0, labelspacing=0.3)
