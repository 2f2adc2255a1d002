"""Figures of one episode: paths with time marks, interventions, barriers over time."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.colors import Normalize
from matplotlib.lines import Line2D
from matplotlib.patches import Patch

from sidestep.loop import Trajectory
from sidestep.safety import PURSUIT_SHIELDS, Status
from sidestep.views import style
from sidestep.views.outlines import LevelOutlines, draw_barrier_levels
from sidestep.views.scene import (
    CAPTURE_SET_LOOK,
    LEVEL_COLOUR,
    LEVELS,
    capture_set_words,
    correction_colours,
    draw_capture_set,
    draw_evader_path,
    draw_obstacles,
    draw_pursuer,
    draw_target,
    draw_time_marks,
    mark_periods,
    set_limits,
    tightest_period,
    world_at,
)
from sidestep.world import Scenario

Limits = tuple[np.ndarray, np.ndarray]
"""Lowest and highest x and y, m."""

_ROOM = 0.08
"""m around circles and capture sets, for labels."""
_EDGE = 0.02
"""m between the outermost level set and the frame."""
_BARRIER_TICKS = (0.0, 0.05, 0.2, 0.5, 1.0, 2.0, 3.0)


def trajectory_figure(
    scenario: Scenario,
    trajectory: Trajectory,
    path: str | Path,
    *,
    shield: str = "",
    title: str | None = None,
    moment: float | None = None,
) -> tuple[Path, Path]:
    """The paths of evader, pursuers and obstacles; below them the shield's trace over time: barriers,
    corrections and status.

    **Arguments:** `shield` its name, for texts and for the barrier whose level sets are drawn; `moment` the
    time (s) at which capture sets, obstacles and level sets are drawn (default: see `tightest_period`).

    Writes PNG and PDF; returns their paths.
    """
    period = tightest_period(trajectory)
    if moment is not None:
        period = int(np.clip(round(moment / float(scenario.control_period)), 0, trajectory.length))
    with style.house_style():
        low, high = scene_limits(scenario, trajectory, shield=shield, period=period)
        spans = high - low
        # The height that the scene needs at full width, within bounds.
        scene_height = float(np.clip((style.WIDTH - 0.6) * spans[1] / spans[0], 1.8, 5.2))
        figure = style.new_figure(style.WIDTH, scene_height + 3.75)
        scene, key, barriers, corrections, answers = figure.subplots(
            5, 1, height_ratios=[scene_height + 0.4, 0.4, 1.3, 0.85, 0.16]
        )
        norm = correction_norm(scenario)
        draw_scene(scene, scenario, trajectory, norm, shield=shield, period=period)
        scene_legend(key, scenario, [trajectory])
        draw_barriers(barriers, scenario, trajectory)
        draw_corrections(corrections, scenario, trajectory, norm)
        now, duration = (count * float(scenario.control_period) for count in (period, trajectory.length))
        for strip in (barriers, corrections):
            _mark_moment(strip, now)
        _say_moment(barriers, now, duration)
        _draw_answers(answers, scenario, trajectory)
        for upper in (barriers, corrections):
            upper.sharex(answers)
            upper.tick_params(axis="x", labelbottom=False)
        words = f"{style.shield_words(shield)}: " if shield else ""
        heading = title or f"{words}{style.OUTCOME_WORDS[trajectory.outcome]} after {duration:.2f} s"
        style.panel_titles(
            [scene, barriers, corrections, answers],
            [
                heading[:1].upper() + heading[1:],
                "Barriers: how far from capture and collision",
                "How far the shield changed the velocity (colours as above)",
                "Answer",
            ],
            in_caption=True,
        )
        return style.save(figure, path)


def scenes_figure(
    scenario: Scenario, trajectories: Mapping[str, Trajectory], path: str | Path
) -> tuple[Path, Path]:
    """The same scene under several shields, at one scale. Writes PNG and PDF.

    **Arguments:** `trajectories` by name of shield.
    """
    with style.house_style():
        norm = correction_norm(scenario)
        low, high = common_limits(
            scene_limits(scenario, trajectory, shield=shield) for shield, trajectory in trajectories.items()
        )
        spans = high - low
        # Two columns for three or more scenes, to fit a page.
        count, columns = len(trajectories), 1 if len(trajectories) <= 2 else 2
        rows = -(-count // columns)
        height = float(np.clip((style.WIDTH - 1.3) / columns * spans[1] / spans[0], 1.5, 4.0))
        figure = style.new_figure(style.WIDTH, (height + 0.35) * rows + 0.6)
        grid = figure.add_gridspec(rows + 1, columns, height_ratios=[height + 0.35] * rows + [0.4])
        axes = [figure.add_subplot(grid[divmod(index, columns)]) for index in range(count)]
        key = figure.add_subplot(grid[rows, :])
        titles = []
        for one, (shield, trajectory) in zip(axes, trajectories.items(), strict=True):
            draw_scene(one, scenario, trajectory, norm, shield=shield, limits=(low, high))
            duration = trajectory.length * float(scenario.control_period)
            # Short titles for half a page's width.
            words = f"{style.shield_words(shield)}: {trajectory.outcome.replace('_', ' ')}, {duration:.2f} s"
            titles.append(words[:1].upper() + words[1:])
        for index, one in enumerate(axes):
            if index + columns < count:
                one.set_xlabel("")
                one.tick_params(labelbottom=False)
            if index % columns:
                one.set_ylabel("")
                one.tick_params(labelleft=False)
        scene_legend(key, scenario, list(trajectories.values()))
        bar = figure.colorbar(
            ScalarMappable(norm, correction_colours()), ax=[*axes, key], shrink=0.4, aspect=25, pad=0.015
        )
        bar.set_label("correction, m/s")
        bar.outline.set_visible(False)  # type: ignore[operator]
        style.panel_titles(axes, titles)
        return style.save(figure, path)


def correction_norm(scenario: Scenario) -> Normalize:
    """From 0 to 2 v_e (a full reversal), so that colours are the same in every figure."""
    return Normalize(0.0, 2.0 * float(scenario.evader_speed))


def scene_margin(scenario: Scenario) -> float:
    """Margin (m) around all paths, for the circles around robots."""
    return max(float(scenario.capture_distance), float(scenario.collision_distance)) + _ROOM


def scene_extent(trajectory: Trajectory, near: float = np.inf) -> tuple[np.ndarray, np.ndarray]:
    """Least and largest x and y (m) of all paths and of the target; of pursuers only where they are within
    `near` (m) of the evader."""
    worlds = trajectory.worlds
    evader, pursuers = np.asarray(worlds.evader), np.asarray(worlds.pursuers)[..., :2]
    close = np.linalg.norm(pursuers - evader[:, None], axis=-1) <= near
    points = np.concatenate(
        [
            evader,
            pursuers[close],
            np.asarray(worlds.obstacles)[..., :2].reshape(-1, 2),
            np.asarray(worlds.target)[:1],
        ]
    )
    return points.min(axis=0), points.max(axis=0)


def scene_limits(
    scenario: Scenario,
    trajectory: Trajectory,
    *,
    shield: str = "",
    period: int | None = None,
    near: float = np.inf,
) -> Limits:
    """Least and largest x and y (m) of everything that `draw_scene` draws: paths, circles, and level sets at
    control period `period` (default: see `tightest_period`). Pursuers count only where they are within `near`
    (m) of the evader.
    """
    low, high = scene_extent(trajectory, near)
    margin = scene_margin(scenario)
    world = world_at(trajectory, tightest_period(trajectory) if period is None else period)
    poses = np.asarray(world.pursuers)
    # The sets of a pursuer that has just gone out of reach may still be in the picture.
    poses = poses[np.linalg.norm(poses[:, :2] - np.asarray(world.evader), axis=-1) <= 2.0 * near]
    outlines = LevelOutlines(scenario, pursuit=shield in PURSUIT_SHIELDS)
    level = outlines.at(poses, np.asarray(world.obstacles)[:, :2], max(LEVELS))
    level = np.concatenate([level[np.isfinite(level).all(axis=1)], [low, high]])
    return (
        np.minimum(low - margin, level.min(axis=0) - _EDGE),
        np.maximum(high + margin, level.max(axis=0) + _EDGE),
    )


def common_limits(limits: Iterable[Limits]) -> Limits:
    """The smallest limits that contain all of these."""
    lows, highs = zip(*limits, strict=True)
    return np.min(lows, axis=0), np.max(highs, axis=0)


def draw_scene(
    axes: Axes,
    scenario: Scenario,
    trajectory: Trajectory,
    norm: Normalize,
    *,
    shield: str = "",
    period: int | None = None,
    limits: Limits | None = None,
) -> None:
    """Draw all paths, with time marks and a mark at the end; capture and level sets at control period
    `period`."""
    period = tightest_period(trajectory) if period is None else period
    world = world_at(trajectory, period)
    if limits is None:
        limits = scene_limits(scenario, trajectory, shield=shield, period=period)
    set_limits(axes, np.stack(limits), 0.0)
    axes.set_xlabel("x, m")
    axes.set_ylabel("y, m")
    draw_barrier_levels(axes, scenario, world, pursuit=shield in PURSUIT_SHIELDS)
    length = float(scenario.control_period)
    marks = mark_periods(trajectory.length * length, length)
    draw_obstacles(axes, scenario, trajectory, period, marks)
    draw_target(axes, scenario, np.asarray(trajectory.worlds.target[0]))
    draw_evader_path(axes, trajectory, norm)

    paths = np.asarray(trajectory.worlds.pursuers)
    for index in range(paths.shape[1]):
        draw_capture_set(axes, scenario, paths[period, index])
        axes.plot(*paths[:, index, :2].T, color=style.PURSUER, linewidth=1.3, zorder=4)
        draw_time_marks(axes, paths[:, index, :2], marks, length, style.PURSUER, dots=False)
        for mark in (0, *marks):
            draw_pursuer(axes, paths[mark, index])
        draw_pursuer(axes, paths[period, index], size=0.11)
    evader = np.asarray(trajectory.worlds.evader)
    draw_time_marks(axes, evader, marks, length, style.EVADER)
    axes.plot(*evader[0], "o", zorder=7, **style.mark(style.EVADER, 5, width=0.7))
    axes.plot(*evader[period], "o", zorder=7, **style.mark(style.EVADER, 5.5, style.INK, 0.9))
    axes.plot(*evader[-1], **_end_look(trajectory.outcome), zorder=9)


def _end_look(outcome: str) -> dict[str, Any]:
    """The look of the mark at the end of the evader's path."""
    if outcome in ("captured", "collided"):
        look = style.mark(style.OUTCOME_COLOURS[outcome], 9)
        return look | {"marker": style.OUTCOME_MARKERS[outcome]}
    colour = style.OUTCOME_COLOURS.get(outcome, style.INK)
    return style.mark("white", 5.5, colour, 1.6) | {"marker": "s" if outcome == "timed_out" else "D"}


def scene_legend(axes: Axes, scenario: Scenario, trajectories: Sequence[Trajectory]) -> None:
    """The legend of these scenes, in separate axes."""
    handles: list[Line2D | Patch] = [
        Line2D([], [], color=style.EVADER, marker="o", markersize=4, label="evader"),
        Line2D([], [], color=style.PURSUER, marker=">", markersize=4, label="pursuer"),
        Line2D([], [], **CAPTURE_SET_LOOK, label=capture_set_words(scenario)),
        Patch(facecolor=style.PURSUER, alpha=0.25, label="capture distance"),
    ]
    if trajectories[0].worlds.obstacles.shape[1]:
        handles.append(Patch(facecolor=style.OBSTACLE, alpha=0.35, label="collision distance"))
    handles += [
        Line2D([], [], color=style.INK, linewidth=1.0, label="h = 0"),
        Line2D(
            [], [], color=LEVEL_COLOUR, linewidth=0.6, label=f"h = {', '.join(f'{h:g}' for h in LEVELS)} m"
        ),
        Line2D([], [], color=style.TARGET, marker="*", linestyle="none", markersize=8, label="target"),
        Line2D(
            [],
            [],
            marker="o",
            label="evader when sets are drawn",
            **style.mark(style.EVADER, 5, style.INK, 0.9),
        ),
    ]
    for outcome in dict.fromkeys(trajectory.outcome for trajectory in trajectories):
        handles.append(Line2D([], [], **_end_look(outcome), label=style.OUTCOME_WORDS[outcome]))
    axes.set_axis_off()
    axes.legend(handles=handles, loc="center", ncols=5, columnspacing=1.4, handletextpad=0.5, fontsize=7)


def _times(scenario: Scenario, trajectory: Trajectory) -> np.ndarray:
    return np.arange(trajectory.length) * float(scenario.control_period)


def _stretches(scenario: Scenario, flags: np.ndarray) -> list[tuple[float, float]]:
    """Begin and duration (s) of every uninterrupted stretch of control periods for which the flag is set."""
    length = float(scenario.control_period)
    edges = np.flatnonzero(np.diff(np.concatenate([[False], flags, [False]]).astype(int))).reshape(-1, 2)
    return [(float(begin) * length, float(end - begin) * length) for begin, end in edges]


def _shade_infeasible(axes: Axes, scenario: Scenario, trajectory: Trajectory) -> None:
    """Background where the shield could not satisfy its rows."""
    for begin, duration in _stretches(scenario, np.asarray(trajectory.status) == Status.INFEASIBLE):
        axes.axvspan(begin, begin + duration, color=style.PURSUER, alpha=0.18, linewidth=0)


def draw_barriers(axes: Axes, scenario: Scenario, trajectory: Trajectory) -> None:
    """h towards every pursuer and obstacle over time, on a square-root scale."""
    times, values = _times(scenario, trajectory), np.asarray(trajectory.barriers)
    pursuers = trajectory.worlds.pursuers.shape[1]
    style.light_grid(axes, "y")
    _shade_infeasible(axes, scenario, trajectory)
    for index in range(values.shape[1]):
        chased = index < pursuers
        colour, word = (style.PURSUER, "pursuer") if chased else (style.OBSTACLE, "obstacle")
        first = index in (0, pursuers)
        axes.plot(
            times, values[:, index], color=colour, linewidth=1.3, label=f"h towards {word}" if first else None
        )
    axes.axhline(0.0, color=style.INK, linewidth=1.0)
    finite = values[np.isfinite(values)]
    highest, lowest = float(np.max(finite, initial=0.1)), float(np.min(finite, initial=0.0))
    # Margins of millimetres and distances of metres in one strip.
    axes.set_yscale(
        "function",
        functions=(lambda h: np.sign(h) * np.sqrt(np.abs(h)), lambda root: np.sign(root) * root**2),
    )
    axes.set_ylim(min(-0.01 * highest, 1.3 * lowest), 1.1 * highest)
    ticks = [tick for tick in _BARRIER_TICKS if tick <= 1.1 * highest]
    axes.set_yticks(ticks, [f"{tick:g}" for tick in ticks])
    axes.set_ylabel("h, m (√ scale)")
    axes.legend(loc="lower right", bbox_to_anchor=(1.0, 0.98), ncols=2, borderpad=0.1, borderaxespad=0.0)


def draw_corrections(axes: Axes, scenario: Scenario, trajectory: Trajectory, norm: Normalize) -> None:
    """The size of the correction over time, in the colours of the path."""
    times, correction = _times(scenario, trajectory), np.asarray(trajectory.intervention)
    style.light_grid(axes, "y")
    _shade_infeasible(axes, scenario, trajectory)
    axes.bar(
        times,
        correction,
        width=float(scenario.control_period),
        align="edge",
        color=correction_colours()(norm(correction)),
        linewidth=0,
    )
    axes.step(times, correction, where="post", color=style.INK, linewidth=0.5)
    axes.set_ylim(0.0, 2.1 * float(scenario.evader_speed))
    axes.set_ylabel("m/s")
    if np.max(correction, initial=0.0) <= 1e-6:
        axes.text(
            0.5, 0.45, "it never did", transform=axes.transAxes, ha="center", va="center", color="#777777"
        )


def _mark_moment(axes: Axes, now: float) -> None:
    axes.axvline(now, color=style.INK, linewidth=0.8, linestyle=(0, (1, 2)))


def _say_moment(axes: Axes, now: float, duration: float) -> None:
    late = now > 0.8 * duration
    axes.annotate(
        "drawn above", (now, 1.0), xycoords=axes.get_xaxis_transform(), xytext=(-3 if late else 3, -2),
        textcoords="offset points", ha="right" if late else "left", va="top", fontsize=6.5,
    )  # fmt: skip


ANSWERS = {
    Status.OK: ("#DDDDDD", "unchanged"),
    Status.CORRECTED: (style.BLUE, "corrected"),
    Status.INFEASIBLE: (style.PURSUER, "not all rows can hold"),
    Status.INVALID: (style.INK, "invalid input"),
}


def _draw_answers(axes: Axes, scenario: Scenario, trajectory: Trajectory) -> None:
    """The status of every control period as a strip, with a legend of those that occur and their shares."""
    status, handles = np.asarray(trajectory.status), []
    for value, (colour, words) in ANSWERS.items():
        share = float(np.mean(status == value)) if len(status) else 0.0
        if share:
            # One bar per stretch instead of thousands of hairlines.
            axes.broken_barh(_stretches(scenario, status == value), (0.0, 1.0), facecolor=colour, linewidth=0)
            handles.append(Patch(facecolor=colour, label=f"{words}, {100 * share:.1f} %"))
    axes.set_ylim(0.0, 1.0)
    axes.set_yticks([])
    axes.spines["left"].set_visible(False)
    axes.set_xlim(0.0, max(trajectory.length, 1) * float(scenario.control_period))
    axes.set_xlabel("time, s")
    axes.legend(
        handles=handles, loc="lower right", bbox_to_anchor=(1.0, 1.0), ncols=4, borderpad=0.1,
        borderaxespad=0.3, columnspacing=1.1, handlelength=0.9, handletextpad=0.5, fontsize=7,
    )  # fmt: skip
