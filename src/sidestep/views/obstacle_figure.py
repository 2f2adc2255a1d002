"""How far away must an obstacle be? Clearances by direction around an evader beside a pursuer."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np

from sidestep.safety.certificate.obstacles import HEIGHTS, clearances
from sidestep.safety.clearance import ClearanceTable
from sidestep.views import style
from sidestep.views.scene import draw_pursuer, set_limits

_BEARINGS = (0.1, 8.0, 35.0, 90.0)
_COLOURS = (style.ORANGE, style.YELLOW, style.SKY, style.PURPLE)


def obstacle_figure(table: ClearanceTable, path: str | Path) -> tuple[Path, Path]:
    """Where the centre of an obstacle may be: four panels, with the evader at four bearings in the pursuer's
    frame, and in each a closed line for every h'. Inside a line the obstacle is too near. Writes PNG and PDF;
    returns their paths."""
    game = table.game
    with style.house_style():
        figure = style.new_figure(style.WIDTH, 6.6)
        grid = figure.add_gridspec(3, 2, height_ratios=[1.0, 1.0, 0.16])
        panels = [figure.add_subplot(grid[i // 2, i % 2]) for i in range(4)]
        key = figure.add_subplot(grid[2, :])
        for axes, degrees in zip(panels, _BEARINGS, strict=True):
            bearing = math.radians(degrees)
            drawn = [np.zeros((1, 2))]
            for height, colour in zip(HEIGHTS, _COLOURS, strict=True):
                distance = (game.capture_distance + height) / math.cos(max(game.angle - bearing, 0.0))
                z = distance * np.array([math.cos(bearing), math.sin(bearing)])
                towards, needed = clearances(table, z)
                line = z + needed[:, None] * np.stack([np.cos(towards), np.sin(towards)], -1)
                line = np.concatenate([line, line[:1]])
                axes.plot(*line.T, color=colour, label=f"h' = {1e3 * height:.0f} mm")
                axes.plot(*z, "o", color=colour, markersize=3.0)
                drawn.append(line)
            around = np.linspace(0.0, 2.0 * math.pi, 200)
            circle = z + game.collision_distance * np.stack([np.cos(around), np.sin(around)], -1)
            axes.plot(*circle.T, color=style.GREY, linestyle=":", label="collision distance")
            draw_pursuer(axes, np.zeros(3))
            set_limits(axes, np.concatenate(drawn), 0.03)
        key.set_axis_off()
        handles, labels = panels[0].get_legend_handles_labels()
        key.legend(handles, labels, loc="center", ncols=3, borderaxespad=0.0, labelspacing=0.4)
        titles = [f"Evader {round(degrees):g} deg off the axis" for degrees in _BEARINGS]
        titles[0] = "Evader just left of the axis"
        for axes in panels[2:]:
            axes.set_xlabel("ahead of the pursuer (m)")
        for axes in panels[::2]:
            axes.set_ylabel("left of it (m)")
        style.panel_titles(panels, titles)
        return style.save(figure, path)
