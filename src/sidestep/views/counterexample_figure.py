"""The figure of a counterexample: scene, pursuer's frame, clearances and wheel speeds."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import jax
import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import Normalize
from matplotlib.lines import Line2D
from matplotlib.patches import Circle

from sidestep.loop import Trajectory
from sidestep.views import style
from sidestep.views.motion import relative
from sidestep.views.outlines import pursuer_heights
from sidestep.views.scene import (
    CAPTURE_SET_LOOK,
    capture_set_outline,
    capture_set_words,
    draw_capture_set,
    draw_evader_path,
    draw_obstacles,
    draw_pursuer,
    draw_target,
    draw_time_marks,
    mark_periods,
    set_limits,
)
from sidestep.world import Scenario

_SHOWN_SECONDS = 6.0


def counterexample_figure(
    scenario: Scenario, trajectory: Trajectory, path: str | Path, *, shield: str = "", words: str = ""
) -> tuple[Path, Path]:
    """One lost episode, its last six seconds, in four panels. Writes PNG and PDF; returns their paths.

    a: the scene; b: the evader in the frame of the pursuer that is nearest at the end, with its capture set;
    c: clearances from capture and collision; d: that pursuer's wheel speeds.

    **Arguments:** `shield` its name, for texts; `words` below the title, such as the broken assumption.
    """
    first = max(0, trajectory.length - round(_SHOWN_SECONDS / float(scenario.control_period)))
    nearest = _nearest(trajectory)
    with style.house_style():
        figure = style.new_figure(style.WIDTH, 6.6)
        grid = figure.add_gridspec(3, 2, height_ratios=[1.9, 1.0, 0.8])
        scene, seen = figure.add_subplot(grid[0, 0]), figure.add_subplot(grid[0, 1])
        gaps, wheels = figure.add_subplot(grid[1, :]), figure.add_subplot(grid[2, :])
        _draw_scene(scene, scenario, trajectory, first)
        _draw_seen(seen, scenario, trajectory, nearest, first)
        _draw_gaps(gaps, scenario, trajectory, first)
        _draw_wheels(wheels, scenario, trajectory, nearest, first)
        gaps.sharex(wheels)
        gaps.tick_params(axis="x", labelbottom=False)
        style.panel_titles(
            [scene, seen, gaps, wheels],
            [
                "The last seconds" if first else "The whole episode",
                "The evader in the pursuer's frame",
                "What was left",
                "The pursuer's wheels",
            ],
        )
        duration = trajectory.length * float(scenario.control_period)
        title = f"{style.shield_words(shield)}: " if shield else ""
        title += f"{style.OUTCOME_WORDS[trajectory.outcome]} after {duration:.2f} s"
        title = title[:1].upper() + title[1:]
        figure.suptitle(f"{title}\n{words}" if words else title, x=0.01, ha="left", fontsize=8.5)
        return style.save(figure, path)


def _nearest(trajectory: Trajectory) -> int:
    offsets = np.asarray(trajectory.worlds.pursuers[-1, :, :2]) - np.asarray(trajectory.worlds.evader[-1])
    return int(np.argmin(np.hypot(*offsets.T)))


def _draw_scene(axes: Axes, scenario: Scenario, trajectory: Trajectory, first: int) -> None:
    worlds, length = trajectory.worlds, float(scenario.control_period)
    evader, poses = np.asarray(worlds.evader), np.asarray(worlds.pursuers)
    end = trajectory.length
    shown = [evader[first:], poses[first:, :, :2].reshape(-1, 2)]
    reach = float(scenario.collision_distance)
    for centre in np.asarray(worlds.obstacles)[end, :, :2]:
        # A distant obstacle would make the scene small.
        if np.hypot(*(centre - evader[end])) < reach + 0.6:
            shown += [centre + reach * np.array([[-1.0, -1.0], [1.0, 1.0]])]
    around = float(np.abs(capture_set_outline(scenario)).max())
    shown += [poses[end, :, :2] - around, poses[end, :, :2] + around]
    points = np.concatenate(shown)
    centre, half = (points.min(axis=0) + points.max(axis=0)) / 2, np.ptp(points, axis=0).max() / 2
    set_limits(axes, np.stack([centre - half, centre + half]), 0.06)
    axes.set_xlabel("x, m")
    axes.set_ylabel("y, m")
    marks = [mark for mark in mark_periods(end * length, length) if mark >= first]
    if len(marks) < 3:
        every = max(1, round((end - first) / 4))
        marks = list(range(first + every, end + 1, every))
    draw_obstacles(axes, scenario, trajectory, end, [])
    draw_target(axes, scenario, np.asarray(worlds.target[0]))
    recent = jax.tree.map(lambda leaf: leaf[first:], trajectory)
    draw_evader_path(axes, recent, Normalize(0.0, 2.0 * float(scenario.evader_speed)))
    size = 0.06 * float(np.ptp(axes.get_xlim()))
    for index in range(poses.shape[1]):
        draw_capture_set(axes, scenario, poses[end, index])
        axes.plot(*poses[first:, index, :2].T, color=style.PURSUER, linewidth=1.3, zorder=4)
        draw_pursuer(axes, poses[first, index], size=size, alpha=0.6)
        draw_pursuer(axes, poses[end, index], size=1.4 * size)
        draw_time_marks(axes, poses[:, index, :2], marks, length, style.PURSUER, dots=False, side=-1.0)
    draw_time_marks(axes, evader, marks, length, style.EVADER)
    colour = style.OUTCOME_COLOURS.get(trajectory.outcome, style.INK)
    axes.plot(*evader[end], "X", zorder=9, **style.mark(colour, 8))


def _draw_seen(axes: Axes, scenario: Scenario, trajectory: Trajectory, pursuer: int, first: int) -> None:
    """The path of z = R(-theta)(p_e - p_d)."""
    poses = np.asarray(trajectory.worlds.pursuers)[first:, pursuer]
    z = relative(np.asarray(trajectory.worlds.evader)[first:], poses)
    outline = capture_set_outline(scenario)
    span = 2.2 * float(np.abs(outline).max())
    set_limits(axes, np.array([[-span, -span], [span, span]]) / 1.15, 0.0)
    axes.add_patch(
        Circle((0.0, 0.0), float(scenario.capture_distance), facecolor=style.PURSUER, alpha=0.15, linewidth=0)
    )
    axes.plot(*outline.T, **CAPTURE_SET_LOOK, label=capture_set_words(scenario))
    draw_pursuer(axes, np.zeros(3), size=0.12 * span)
    axes.plot(*z.T, color=style.EVADER, linewidth=1.1)
    axes.plot(*z[-1], "X", zorder=9, **style.mark(style.INK, 7))
    axes.set_xlabel("ahead, m")
    axes.set_ylabel("left, m")
    axes.legend(loc="lower right")


def _draw_gaps(axes: Axes, scenario: Scenario, trajectory: Trajectory, first: int) -> None:
    """Clearances and margins over time, linear near 0 and logarithmic beyond."""
    times = (np.arange(first, trajectory.length) + 1) * float(scenario.control_period)
    margin = _margins(scenario, trajectory)[first + 1 :]
    curves: list[tuple[Any, str, str]] = [
        (trajectory.events.pursuer_clearance[first:], style.PURSUER, "to the capture distance"),
        (margin, style.BLUE, "to the capture set K"),
    ]
    if trajectory.worlds.obstacles.shape[1]:
        curves.append((trajectory.events.obstacle_clearance[first:], style.OBSTACLE, "to an obstacle"))
    style.light_grid(axes, "y")
    for values, colour, label in curves:
        axes.plot(times, np.asarray(values), color=colour, linewidth=1.3, label=label)
    axes.axhline(0.0, color=style.INK, linewidth=1.0)
    # Linear within a fraction of a millimetre of 0, logarithmic beyond.
    axes.set_yscale("symlog", linthresh=1e-4, linscale=0.6)
    ticks = [-0.1, -0.01, -0.001, -0.0001, 0.0, 0.0001, 0.001, 0.01, 0.1, 1.0]
    labels = ["−10 cm", "−1 cm", "−1 mm", "−0.1 mm", "0", "0.1 mm", "1 mm", "1 cm", "10 cm", "1 m"]
    values = np.concatenate([np.asarray(values) for values, *_ in curves])
    low, high = min(float(values.min()), 0.0), max(float(values.max()), 1e-3)
    shown = [(t, word) for t, word in zip(ticks, labels, strict=True) if 3.0 * low <= t <= 2.0 * high]
    axes.set_yticks([tick for tick, _ in shown], [word for _, word in shown])
    axes.minorticks_off()
    axes.set_ylim(1.6 * low if low < 0.0 else -3e-5, 2.0 * high)
    axes.set_ylabel("distance left")
    _legend_above(axes)


def _margins(scenario: Scenario, trajectory: Trajectory) -> np.ndarray:
    """h (m), the least over pursuers, at each control instant."""
    evader, poses = np.asarray(trajectory.worlds.evader), np.asarray(trajectory.worlds.pursuers)
    return pursuer_heights(scenario, evader[:, None], poses, pursuit=True).min(axis=1)


def _draw_wheels(axes: Axes, scenario: Scenario, trajectory: Trajectory, pursuer: int, first: int) -> None:
    length = float(scenario.control_period)
    wheels = np.asarray(trajectory.wheel_speeds)[first:, pursuer]
    edges = np.arange(first, trajectory.length + 1) * length
    style.light_grid(axes, "y")
    for side, colour, dashes in ((0, style.PURSUER, "solid"), (1, style.INK, (0, (3, 1.5)))):
        axes.stairs(wheels[:, side], edges, color=colour, linewidth=1.3, linestyle=dashes, baseline=None)
    handles = [
        Line2D([], [], color=style.PURSUER, label="left"),
        Line2D([], [], color=style.INK, linestyle=(0, (3, 1.5)), label="right"),
    ]
    limit = float(scenario.pursuer_speed)
    axes.set_ylim(-1.25 * limit, 1.25 * limit)
    axes.set_xlim(edges[0], edges[-1])
    axes.set_ylabel("rim speed, m/s")
    axes.set_xlabel("time, s")
    _legend_above(axes, handles=handles)


def _legend_above(axes: Axes, **entries: Any) -> None:
    """The legend to the right of the title, where no curve is."""
    axes.legend(
        loc="lower right", bbox_to_anchor=(1.0, 1.0), ncols=3, borderpad=0.1, borderaxespad=0.2, **entries
    )
