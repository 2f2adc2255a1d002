"""Maps of interventions over the evader's position in the pursuer's frame."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import matplotlib
import numpy as np
from jaxtyping import Float
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.colors import Colormap, LinearSegmentedColormap, Normalize
from matplotlib.patches import Arc, Circle, Polygon, Rectangle
from matplotlib.patheffects import withStroke

from sidestep.safety import PURSUIT_SHIELDS
from sidestep.trials import InterventionMap
from sidestep.views import scene, style
from sidestep.world import Scenario
from sidestep.world.capture_geometry import capture_set_distance

_FEWEST = 5
"""Cells with fewer periods are left white: the share of a few periods is not meaningful."""
_LEVELS = (0.05, 0.1, 0.2, 0.3)
_ARROWS = 15
_LEAST_SIDE = 1.3
"""Least width (inches) of a panel; with many shields the figure becomes wider than a page."""
_HALO = [withStroke(linewidth=2.0, foreground="white")]


def intervention_figure(
    scenario: Scenario, maps: Mapping[str, InterventionMap], path: str | Path
) -> tuple[Path, Path]:
    """Maps over the evader's position in the nearest pursuer's frame, a column per shield. Above: the share
    of control periods in which the shield changed the velocity. Below: the mean correction, with its
    direction.

    Also drawn: the capture circle, its usable part (thick), the capture set K (dashed), the wheels of the
    pursuer, which heads to the right, and level sets of the shield's barrier. Writes PNG and PDF.
    """
    names = list(maps)
    columns = max(len(names), 1)
    # One or two panels at full width would be higher than a page.
    side = float(np.clip((style.WIDTH - 1.2) / columns, _LEAST_SIDE, style.COLUMN - 1.2))
    with style.house_style():
        figure = style.new_figure(side * columns + 1.2, 2 * side + 0.75)
        grid = figure.subplots(2, columns, sharex=True, sharey=True, squeeze=False)
        bars = (
            (_share_colours(), Normalize(0.0, 100.0), "periods corrected, %"),
            (
                scene.correction_colours(),
                Normalize(0.0, 2.0 * float(scenario.evader_speed)),
                "mean correction, m/s",
            ),
        )
        for column, name in enumerate(names):
            one = maps[name]
            visited = one.periods >= _FEWEST
            periods = np.maximum(one.periods, 1)
            measures = (100.0 * one.corrected / periods, one.correction / periods)
            for row, (values, (colours, norm, _)) in enumerate(zip(measures, bars, strict=True)):
                axes = grid[row, column]
                extent = (-one.reach, one.reach, -one.reach, one.reach)
                axes.imshow(
                    np.where(visited, values, np.nan), origin="lower", extent=extent, cmap=colours, norm=norm,
                    interpolation="nearest", zorder=1,
                )  # fmt: skip
                _draw_sets(axes, scenario, one.reach, pursuit=name in PURSUIT_SHIELDS)
            _draw_directions(grid[1, column], one)
        for row, (colours, norm, words) in enumerate(bars):
            bar = figure.colorbar(
                ScalarMappable(norm, colours), ax=list(grid[row]), shrink=0.85, aspect=22, pad=0.015
            )
            bar.set_label(words)
            bar.outline.set_visible(False)  # type: ignore[operator]
            grid[row, 0].set_ylabel("to its left, m")
        for axes in grid[1]:
            axes.set_xlabel("ahead of the pursuer, m")
        words = [style.shield_words(name) for name in names] or [""]
        style.panel_titles(list(grid[0]), [word[:1].upper() + word[1:] for word in words])
        return style.save(figure, path)


def _share_colours() -> Colormap:
    """From light (never) to dark (always), and distinct from the white of cells not visited."""
    whole = matplotlib.colormaps["YlGnBu"]
    return LinearSegmentedColormap.from_list("share", whole(np.linspace(0.3, 1.0, 128)))


def _draw_sets(axes: Axes, scenario: Scenario, reach: float, *, pursuit: bool) -> None:
    built_in, scenario = scenario.built_in, scene.guarded(scenario)
    radius, usable = float(scenario.capture_distance), float(scenario.usable_angle)
    half_axle = float(scenario.pursuer_half_axle)
    line = np.linspace(-reach, reach, 161)
    grid = np.stack(np.meshgrid(line, line))
    angle = scenario.usable_angle if pursuit else 0.0 * scenario.usable_angle
    heights = np.asarray(capture_set_distance(grid, angle, scenario.capture_distance))
    levels = axes.contour(
        line, line, heights, levels=list(_LEVELS), colors="#555555", linewidths=0.6, zorder=3
    )
    labels = axes.clabel(levels, _LEVELS[1:], fmt="%g", fontsize=5.5, inline_spacing=1)
    for label in labels:
        label.set_rotation(0)
    axes.add_patch(
        Circle((0, 0), radius, facecolor="white", edgecolor=style.PURSUER, linewidth=0.8, zorder=4)
    )
    outline = scene.capture_set_outline(scenario)
    axes.plot(*outline.T, zorder=5, path_effects=_HALO, **scene.CAPTURE_SET_LOOK)
    for towards in (0.0, 180.0):
        degrees = np.rad2deg(usable)
        axes.add_patch(
            Arc((0, 0), 2 * radius, 2 * radius, angle=towards, theta1=-degrees, theta2=degrees,
                color=style.PURSUER, linewidth=2.2, zorder=6)
        )  # fmt: skip
    for wheel in (-half_axle, half_axle) if built_in else ():
        place = (-0.3 * half_axle, wheel - 0.08 * half_axle)
        axes.add_patch(
            Rectangle(place, 0.6 * half_axle, 0.16 * half_axle, facecolor=style.INK, linewidth=0, zorder=6)
        )
    size = 0.55 * radius
    shape = size * np.array([[0.75, 0.0], [-0.5, 0.5], [-0.25, 0.0], [-0.5, -0.5]])
    axes.add_patch(Polygon(shape, facecolor=style.PURSUER, edgecolor="white", linewidth=0.5, zorder=7))
    axes.set_aspect("equal")
    axes.set_xlim(-reach, reach)
    axes.set_ylim(-reach, reach)


def _blocks(values: Float[np.ndarray, "cells cells"]) -> Float[np.ndarray, "arrows arrows"]:
    """Sums over square blocks of cells."""
    width = len(values) // _ARROWS
    cut = values[: width * _ARROWS, : width * _ARROWS]
    return cut.reshape(_ARROWS, width, _ARROWS, width).sum(axis=(1, 3))


def _draw_directions(axes: Axes, one: InterventionMap) -> None:
    """Arrows along the mean correction, for blocks of cells in which it is not negligible."""
    periods = _blocks(one.periods.astype(float))
    weight = np.maximum(periods, 1)
    ahead, left = _blocks(one.ahead) / weight, _blocks(one.left) / weight
    size = np.hypot(ahead, left)
    shown = (periods >= 4 * _FEWEST) & (size > 0.1 * np.max(size, initial=0.0)) & (size > 1e-6)
    if not np.any(shown):
        return
    step = 2.0 * one.reach / _ARROWS
    middle = -one.reach + step * (np.arange(_ARROWS) + 0.5)
    x, y = np.meshgrid(middle, middle)
    axes.quiver(
        x[shown], y[shown], ahead[shown], left[shown], angles="xy", scale_units="xy", pivot="mid",
        scale=float(np.max(size)) / (1.1 * step), color=style.INK, width=0.006, headwidth=4.5, headlength=4.5,
        headaxislength=4.0, zorder=3.5, path_effects=[withStroke(linewidth=1.2, foreground="white")],
    )  # fmt: skip
