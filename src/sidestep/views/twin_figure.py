"""The figure that sets an episode on robots beside the same scene in the plain simulation."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from jaxtyping import Float
from matplotlib.axes import Axes

from sidestep.trials import Trajectory
from sidestep.views.style import (
    BLUE,
    GREY,
    INK,
    OUTCOME_WORDS,
    WIDTH,
    house_style,
    light_grid,
    new_figure,
    panel_titles,
    save,
)
from sidestep.views.trajectory_figures import (
    correction_norm,
    draw_scene,
    scene_extent,
    scene_legend,
    scene_margin,
)
from sidestep.world import Scenario

_NEAR = 3.0
"""Distances are drawn up to this many times the capture distance."""


def twin_figure(
    scenario: Scenario,
    simulation: Trajectory,
    twin: Trajectory,
    path: str | Path,
    *,
    shield: str = "",
    twin_words: str = "physics twin",
    near: float = np.inf,
) -> tuple[Path, Path]:
    """Both paths at one scale, and below them the least distance to a pursuer and to an obstacle over time.

    A pursuer that is farther than `near` (m) from the evader may be out of the picture.

    Writes PNG and PDF; returns their paths.
    """
    with house_style():
        both = {"simulation": simulation, twin_words: twin}
        extents = [scene_extent(trajectory, near) for trajectory in both.values()]
        limits = (
            np.min([low for low, _ in extents], axis=0),
            np.max([high for _, high in extents], axis=0),
        )
        spans = limits[1] - limits[0] + 2 * scene_margin(scenario)
        height = float(np.clip((WIDTH - 0.7) * spans[1] / spans[0], 1.5, 3.6))
        figure = new_figure(WIDTH, 2 * height + 4.2)
        heights = [height + 0.35, height + 0.35, 0.45, 1.2, 1.2]
        upper, lower, key, pursuers, obstacles = figure.subplots(5, 1, height_ratios=heights)
        norm, titles = correction_norm(scenario), []
        for axes, (words, trajectory) in zip((upper, lower), both.items(), strict=True):
            draw_scene(axes, scenario, trajectory, norm, shield=shield, limits=limits)
            duration = trajectory.length * float(scenario.control_period)
            titles.append(
                f"{words[0].upper()}{words[1:]}: {OUTCOME_WORDS[trajectory.outcome]} after {duration:.2f} s"
            )
        upper.set_xlabel("")
        upper.tick_params(labelbottom=False)
        scene_legend(key, simulation)
        period = float(scenario.control_period)
        for axes, name, least in (
            (pursuers, "pursuers", float(scenario.capture_distance)),
            (obstacles, "obstacles", float(scenario.collision_distance)),
        ):
            for trajectory, colour, words in ((simulation, GREY, "simulation"), (twin, BLUE, twin_words)):
                _draw_distance(axes, _distances(trajectory, name), period, colour, words)
            axes.axhline(least, color=INK, linewidth=1.0)
            axes.set_ylim(0.95 * least, _NEAR * least)
            axes.set_ylabel("m")
            light_grid(axes, "y")
        pursuers.sharex(obstacles)
        pursuers.tick_params(axis="x", labelbottom=False)
        pursuers.legend(loc="upper right", ncols=2)
        obstacles.set_xlabel("time, s")
        obstacles.set_xlim(0.0, period * max(simulation.length, twin.length))
        titles += [
            "Distance to the pursuer; black: captured",
            "Distance to the obstacle; black: collided",
        ]
        panel_titles([upper, lower, pursuers, obstacles], titles)
        return save(figure, path)


def _distances(trajectory: Trajectory, group: str) -> Float[np.ndarray, "t"]:
    """Least distance (m) from the evader to any of a group at the beginning of every period."""
    robots = np.asarray(getattr(trajectory.worlds, group))[..., :2]
    apart = np.linalg.norm(robots - np.asarray(trajectory.worlds.evader)[:, None], axis=-1)
    return np.min(apart, axis=1, initial=np.inf)


def _draw_distance(
    axes: Axes, distances: Float[np.ndarray, "t"], period: float, colour: str, words: str
) -> None:
    axes.plot(period * np.arange(len(distances)), distances, color=colour, linewidth=1.2, label=words)
