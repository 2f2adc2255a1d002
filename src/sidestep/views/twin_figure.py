"""The figure that compares an episode on a plant with the same scene in the simulation."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

import numpy as np
from jaxtyping import Float
from matplotlib.axes import Axes

from sidestep.loop import Trajectory
from sidestep.views import style
from sidestep.views.trajectory_figures import (
    common_limits,
    correction_norm,
    draw_scene,
    scene_legend,
    scene_limits,
)
from sidestep.world import Scenario

_TICKS = (0.05, 0.1, 0.2, 0.3, 0.5, 1.0, 2.0, 3.0, 5.0, 10.0, 20.0, 50.0)


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
    """Both scenes at one scale, and the least distances to a pursuer and to an obstacle over time.

    A pursuer that is farther than `near` (m) from the evader may be out of the picture.

    Writes PNG and PDF; returns their paths.
    """
    with style.house_style():
        both = {"simulation": simulation, twin_words: twin}
        limits = common_limits(
            scene_limits(scenario, trajectory, shield=shield, near=near) for trajectory in both.values()
        )
        spans = limits[1] - limits[0]
        height = float(np.clip((style.WIDTH - 0.7) * spans[1] / spans[0], 1.5, 3.6))
        figure = style.new_figure(style.WIDTH, 2 * height + 4.2)
        heights = [height + 0.35, height + 0.35, 0.45, 1.2, 1.2]
        upper, lower, key, pursuers, obstacles = figure.subplots(5, 1, height_ratios=heights)
        norm, titles = correction_norm(scenario), []
        for axes, (words, trajectory) in zip((upper, lower), both.items(), strict=True):
            draw_scene(axes, scenario, trajectory, norm, shield=shield, limits=limits)
            duration = trajectory.length * float(scenario.control_period)
            outcome = style.OUTCOME_WORDS[trajectory.outcome]
            titles.append(f"{words[0].upper()}{words[1:]}: {outcome} after {duration:.2f} s")
        upper.set_xlabel("")
        upper.tick_params(labelbottom=False)
        scene_legend(key, scenario, list(both.values()))
        period = float(scenario.control_period)
        for axes, name, least in (
            (pursuers, "pursuers", float(scenario.capture_distance)),
            (obstacles, "obstacles", float(scenario.collision_distance)),
        ):
            for trajectory, colour, words in (
                (simulation, style.GREY, "simulation"),
                (twin, style.BLUE, twin_words),
            ):
                _draw_distance(axes, _distances(trajectory, name), period, colour, words)
            axes.axhline(least, color=style.INK, linewidth=1.0)
            _scale(axes, least, name, both.values())
            style.light_grid(axes, "y")
        pursuers.sharex(obstacles)
        pursuers.tick_params(axis="x", labelbottom=False)
        # Beside the title, where no curve is.
        pursuers.legend(loc="lower right", bbox_to_anchor=(1.0, 1.0), ncols=2, borderaxespad=0.2)
        obstacles.set_xlabel("time, s")
        obstacles.set_xlim(0.0, period * max(simulation.length, twin.length))
        titles += [
            "Nearest pursuer; black: captured",
            "Nearest obstacle; black: collided",
        ]
        style.panel_titles([upper, lower, pursuers, obstacles], titles)
        return style.save(figure, path)


def _scale(axes: Axes, least: float, name: str, trajectories: Iterable[Trajectory]) -> None:
    """A logarithmic axis for both curves, with the contact distance at the bottom."""
    found = np.concatenate([_distances(trajectory, name) for trajectory in trajectories])
    found = found[np.isfinite(found) & (found > 0.0)]
    low, high = float(np.min(found, initial=least)), float(np.max(found, initial=3.0 * least))
    axes.set_yscale("log")
    axes.set_ylim(0.85 * low, 1.15 * high)
    ticks, room = [], (1.3 * high / low) ** 0.12
    for tick in _TICKS:
        if low <= tick <= high and (not ticks or tick >= room * ticks[-1]):
            ticks.append(tick)
    axes.set_yticks(ticks, [f"{tick:g}" for tick in ticks])
    axes.minorticks_off()
    axes.set_ylabel("distance, m")


def _distances(trajectory: Trajectory, group: str) -> Float[np.ndarray, "t"]:
    """The evader's least distance (m) to a robot of a group at the beginning of every period."""
    robots = np.asarray(getattr(trajectory.worlds, group))[..., :2]
    apart = np.linalg.norm(robots - np.asarray(trajectory.worlds.evader)[:, None], axis=-1)
    return np.min(apart, axis=1, initial=np.inf)


def _draw_distance(
    axes: Axes, distances: Float[np.ndarray, "t"], period: float, colour: str, words: str
) -> None:
    axes.plot(period * np.arange(len(distances)), distances, color=colour, linewidth=1.2, label=words)
