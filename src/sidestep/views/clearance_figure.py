"""Histograms of each episode's least clearances, per shield."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np
from jaxtyping import Float
from matplotlib.axes import Axes
from matplotlib.ticker import NullFormatter, NullLocator

from sidestep.views import style

Clearances = tuple[Float[np.ndarray, "episodes"], Float[np.ndarray, "episodes"]]

_HAZARDS = (
    ("captured", "Least distance to capture, per episode"),
    ("collided", "Least distance to collision, per episode"),
)
_TICKS = (0.0, 0.05, 0.2, 0.5, 1.0, 2.0, 4.0, 8.0)
_BINS_PER_ROOT = 24
"""Bins per square root of a metre. The square-root scale resolves both millimetres and metres."""


def clearance_figure(
    clearances: Mapping[str, Clearances],
    path: str | Path,
    *,
    capture_distance: float,
    collision_distance: float,
) -> tuple[Path, Path]:
    """Histograms of the least clearance to pursuers and to obstacles of every episode, a row per shield.

    Clearances are on a square-root scale; counts are logarithmic, so that one lost episode among a thousand
    is visible. Contacts (0 and less) are one separate bar.

    **Arguments:** `clearances` by shield: to pursuers and to obstacles, m, infinite without such a robot.
    Writes PNG and PDF.
    """
    names = list(clearances)
    hazards = [
        index
        for index in range(len(_HAZARDS))
        if any(np.any(np.isfinite(pair[index])) for pair in clearances.values())
    ]
    with style.house_style():
        figure = style.new_figure(style.WIDTH, 0.75 + 0.85 * max(len(names), 1))
        grid = figure.subplots(
            max(len(names), 1), max(len(hazards), 1), sharex="col", sharey=True, squeeze=False
        )
        most = 1.0
        for column, index in enumerate(hazards):
            finite = np.concatenate([pair[index][np.isfinite(pair[index])] for pair in clearances.values()])
            edges = _edges(float(np.max(finite, initial=0.1)))
            for row, name in enumerate(names):
                axes = grid[row, column]
                highest = _draw(axes, clearances[name][index], edges, index, style.shield_colour(name, row))
                most = max(most, highest)
                if column == 0:
                    axes.set_ylabel(f"{style.shield_words(name)}\nepisodes")
            distance = (capture_distance, collision_distance)[index]
            word = ("capture", "collision")[index]
            grid[-1, column].set_xlabel(f"m beyond the {word} distance of {distance:g} m (√ scale)")
        for axes in grid.flat:
            axes.set_yscale("symlog", linthresh=1.0, linscale=0.5)
            axes.set_ylim(0.0, 8.0 * most)
            axes.set_yticks([value for value in (1, 10, 100, 1000, 10_000) if value <= 3.0 * most])
            axes.yaxis.set_major_formatter("{x:g}")
            axes.yaxis.set_minor_locator(NullLocator())
            axes.yaxis.set_minor_formatter(NullFormatter())
        style.panel_titles(list(grid[0]), [_HAZARDS[index][1] for index in hazards] or [""], in_caption=True)
        figure.align_ylabels(grid[:, 0])
        return style.save(figure, path)


def _edges(highest: float) -> Float[np.ndarray, "edges"]:
    """Edges of bins (m), of equal width in the square root."""
    count = max(4, int(np.ceil(_BINS_PER_ROOT * np.sqrt(highest))))
    return (np.arange(count + 1) / _BINS_PER_ROOT) ** 2


def _root(values: Float[np.ndarray, "n"]) -> Float[np.ndarray, "n"]:
    return np.sqrt(np.maximum(values, 0.0))


def _draw(
    axes: Axes,
    clearances: Float[np.ndarray, "episodes"],
    edges: Float[np.ndarray, "edges"],
    index: int,
    colour: str,
) -> float:
    """Draw one histogram; returns its highest bar."""
    finite = clearances[np.isfinite(clearances)]
    contacts = int(np.sum(finite <= 0.0))
    counts, _ = np.histogram(finite[finite > 0.0], edges)
    places, width = _root(edges), 1.0 / _BINS_PER_ROOT
    style.light_grid(axes, "y")
    axes.bar(places[:-1], counts, width=0.92 * width, align="edge", color=colour, linewidth=0)
    left = -3.2 * width
    lost = style.OUTCOME_COLOURS[_HAZARDS[index][0]]
    axes.bar(left, contacts, width=1.8 * width, align="edge", color=lost, linewidth=0)
    axes.annotate(
        f"{contacts} {_HAZARDS[index][0]}", (left, 1.0), xycoords=("data", "axes fraction"),
        fontsize=7, color=lost if contacts else style.INK, ha="left", va="top",
        weight="bold" if contacts else None,
    )  # fmt: skip
    axes.axvline(0.0, ymax=0.84, color=style.INK, linewidth=0.9, linestyle=(0, (4, 3)))
    axes.set_xlim(left - 0.4 * width, places[-1])
    ticks = [tick for tick in _TICKS if tick <= edges[-1]]
    axes.set_xticks([float(np.sqrt(tick)) for tick in ticks], [f"{tick:g}" for tick in ticks])
    if not len(finite):
        axes.text(0.5, 0.5, "none", transform=axes.transAxes, ha="center", va="center", color="#777777")
    return float(max(contacts, np.max(counts, initial=0)))
