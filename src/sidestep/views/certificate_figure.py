"""The sets of a certificate in the pursuer's frame: capture set, budget and safe set."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
from jaxtyping import Float
from matplotlib.axes import Axes
from matplotlib.patches import Polygon

from sidestep.safety.certificate.certificate import Certificate
from sidestep.views import style
from sidestep.views.scene import draw_pursuer, set_limits

_SAFE, _LOST = "#EAF5F0", "#FBEDE4"
_SAFE_TEXT, _LOST_TEXT = "#006B4E", "#9C4400"
_PARTS = (
    ("position", "+ position error", style.YELLOW),
    ("heading", "+ heading error", style.ORANGE),
    ("delay", "+ delay", style.PURPLE),
    ("sampling", "+ sampling", style.SKY),
    ("tracking", "+ tracking error", style.GREEN),
    ("sides", "+ telling sides apart", style.GREY),
)


def certificate_figure(certificate: Certificate, path: str | Path) -> tuple[Path, Path]:
    """The capture set, the capture set enlarged by each part of the budget, and the safe set. Writes PNG and
    PDF; returns their paths.

    a: all sets around the pursuer, with the usable part of the capture circle and the stand-off points
    +-b cot S; b: the tip, where margins of millimetres are visible. If the pursuer wins, there is one panel
    without a safe set.
    """
    with style.house_style():
        # If the pursuer wins there is no budget, and the tip would show nothing new.
        split = not certificate.pursuer_wins
        figure = style.new_figure(style.WIDTH, 4.4)
        grid = figure.add_gridspec(2, 2, width_ratios=[1.15, 1.0], height_ratios=[1.0, 0.36])
        places = [grid[0, 0], grid[0, 1]] if split else [grid[0, :]]
        panels, key = [figure.add_subplot(place) for place in places], figure.add_subplot(grid[1, :])
        for axes in panels:
            _draw_sets(axes, certificate)
        _draw_pursuer_and_marks(panels[0], certificate)
        _frame_whole(panels[0], certificate)
        if split:
            _frame_tip(panels[1], certificate)
        key.set_axis_off()
        handles, labels = panels[0].get_legend_handles_labels()
        key.legend(handles, labels, loc="center", ncols=2, borderaxespad=0.0, labelspacing=0.4)
        style.panel_titles(
            panels,
            [f"Capture at {_wanted(certificate):g} m: {_verdict(certificate)}", "The tip ahead"][
                : len(panels)
            ],
        )
        return style.save(figure, path)


def _verdict(certificate: Certificate) -> str:
    if certificate.pursuer_wins:
        return "from everywhere"
    return "excluded for ever" if certificate.guaranteed else "not guaranteed"


def _wanted(certificate: Certificate) -> float:
    return certificate.situation.capture_distance


def set_outline(radius: float, angle: float, points: int = 181) -> Float[np.ndarray, "n 2"]:
    """Outline (m, closed) of a disc with tips whose sides have normals at `angle` (rad) to the axis."""
    left = np.linspace(angle, np.pi - angle, points)
    arc = radius * np.stack([np.cos(left), np.sin(left)], -1)
    apex = np.array([[radius / math.cos(angle), 0.0]])
    return np.concatenate([apex, arc, -apex, -arc, apex])


def _grown(certificate: Certificate) -> list[tuple[str, str, float]]:
    """Label, colour and radius (m) of every budget part that is not 0, outward; none if the pursuer wins."""
    radius, sets = _wanted(certificate), []
    if certificate.pursuer_wins:
        return sets
    for name, label, colour in _PARTS:
        part = certificate.budget[name]
        if part > 0.0:
            radius += part
            sets.append((f"{label} {1e3 * part:.3g} mm", colour, radius))
    return sets


def _draw_sets(axes: Axes, certificate: Certificate) -> None:
    angle = certificate.situation.game.usable_angle
    axes.set_facecolor(_LOST if certificate.pursuer_wins else _SAFE)
    style.light_grid(axes)
    grown = _grown(certificate)
    for label, colour, radius in reversed(grown):
        outline = set_outline(radius, angle)
        axes.add_patch(Polygon(outline, facecolor=colour, edgecolor="white", linewidth=0.4, label=label))
    held = _wanted(certificate)
    words = "captured at once, driving straight on" if certificate.pursuer_wins else "capture set K(l)"
    fill = Polygon(
        set_outline(held, angle), facecolor="#F3C9B5", edgecolor=style.PURSUER, linewidth=1.2,
        label=f"{words}, l = {held:g} m",
    )  # fmt: skip
    axes.add_patch(fill)
    limit = certificate.largest_capture_distance
    if math.isfinite(limit) and 0.0 < limit < 3.0 * held:
        axes.plot(
            *set_outline(limit, angle).T, color=style.INK, linewidth=1.0, linestyle=(0, (4, 2)),
            label=f"K(l_max), l_max = {limit:.5g} m: the most there is",
        )  # fmt: skip
    control = certificate.control_set
    if control is not None and (certificate.guaranteed or control.level != held):
        words = "is kept out of this set" if certificate.guaranteed else "can be kept out of this set only"
        axes.plot(
            *set_outline(control.level, control.angle).T, color=style.GREEN, linewidth=1.4,
            label=f"the evader {words}, {control.level:.5g} m",
        )  # fmt: skip


def _draw_pursuer_and_marks(axes: Axes, certificate: Certificate) -> None:
    game, held = certificate.situation.game, _wanted(certificate)
    angle = game.usable_angle
    if angle > 0.0:
        arc = np.linspace(-angle, angle, 61)
        for end in (1.0, -1.0):
            axes.plot(
                end * held * np.cos(arc), held * np.sin(arc), color=style.PURSUER, linewidth=2.6, zorder=4,
                label="usable part" if end > 0 else None,
            )  # fmt: skip
        stand_off = game.half_axle / math.tan(angle)
        axes.plot(
            [stand_off, -stand_off], [0.0, 0.0], "D", color=style.INK, markersize=4, linestyle="none",
            zorder=6, label=f"stand-off b cot S, {stand_off:.4g} m",
        )  # fmt: skip
    draw_pursuer(axes, np.zeros(3), size=0.5 * held)
    if certificate.start is not None:
        axes.plot(
            *certificate.start, "o", color=style.GREEN, markersize=5, zorder=7, label="start asked about"
        )


def _outside(certificate: Certificate) -> tuple[str, str]:
    """The text on what holds outside the sets, and its colour."""
    held, kept = _wanted(certificate), certificate.guaranteed_clearance
    if certificate.pursuer_wins:
        smaller = f"\n({kept:.4g} m is kept for ever)" if kept > 0.0 else ""
        return f"no place is safe at {held:g} m{smaller}", _LOST_TEXT
    if certificate.guaranteed:
        return "safe for ever", _SAFE_TEXT
    return (f"{kept:.4g} m is kept for ever" if kept > 0.0 else "nothing is guaranteed"), _SAFE_TEXT


def _frame_whole(axes: Axes, certificate: Certificate) -> None:
    angle = certificate.situation.game.usable_angle
    largest = max([_wanted(certificate), *(radius for _, _, radius in _grown(certificate))])
    points = set_outline(largest, angle)
    if certificate.start is not None and np.hypot(*certificate.start) < 4.0 * largest:
        points = np.concatenate([points, [certificate.start]])
    set_limits(axes, points, 0.08)
    words, colour = _outside(certificate)
    axes.text(0.02, 0.97, words, transform=axes.transAxes, color=colour, va="top", fontsize=8)
    axes.set_xlabel("ahead of the pursuer, m")
    axes.set_ylabel("left of it, m")


def _frame_tip(axes: Axes, certificate: Certificate) -> None:
    angle = certificate.situation.game.usable_angle
    radii = [_wanted(certificate), *(radius for _, _, radius in _grown(certificate))]
    tips = [radius / math.cos(angle) for radius in radii]
    if certificate.control_set is not None:
        tips.append(certificate.control_set.tip)
    limit = certificate.largest_capture_distance
    if math.isfinite(limit) and limit < 1.5 * max(radii):
        tips.append(limit / math.cos(angle))
    low, high = min(tips), max(tips)
    span = max(high - low, 0.01 * _wanted(certificate))
    axes.set_xlim(low - 1.3 * span, high + 0.7 * span)
    half = 0.5 * (high - low + 2.0 * span)
    axes.set_ylim(-half, half)
    axes.set_aspect("equal", adjustable="box")
    axes.set_xlabel("ahead of the pursuer, m")
    axes.locator_params(axis="x", nbins=4)
