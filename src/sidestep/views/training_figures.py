"""Figures of a training: returns and outcomes over episodes, and how many episodes were safe."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.lines import Line2D

from sidestep.learning.records import CONVERGENCE_RETURN, CONVERGENCE_WINDOW, converged_episode, moving_mean
from sidestep.trials import interquartile_mean, wilson_interval
from sidestep.views.runs import Run, by_shield
from sidestep.views.style import (
    INK,
    OUTCOME_COLOURS,
    OUTCOME_MARKERS,
    OUTCOME_WORDS,
    WIDTH,
    house_style,
    light_grid,
    new_figure,
    panel_titles,
    save,
    shield_colour,
    shield_dashes,
    shield_words,
)

PAPER_CONVERGED = 80
PAPER_EPISODES = 200
_MANY_RUNS = 6
_BESIDE = -0.19
"""Where a panel's letter stands in a column, in widths of the axes: above their labels, beside the legend."""
_MOST_SHIELDS_WITH_EPISODES = 2


def reward_figure(runs: Sequence[Run], path: str | Path, *, width: float = WIDTH) -> tuple[Path, Path]:
    """Accumulated reward over training episodes, and below it how every episode ended.

    Thick: mean of the last 20 episodes, and over several seeds the interquartile mean of it with the range of
    the seeds; faint: each episode, for up to two shields (see `shows_episodes`). A diamond marks convergence
    (mean of 20 at least 940). Writes PNG and PDF, `width` inches wide.
    """
    groups = by_shield(runs)
    rows = [run for group in groups.values() for run in group]
    with house_style():
        row_height = 0.24 if len(rows) <= _MANY_RUNS else 0.16
        raster_height = row_height * max(len(rows), 1) + 0.25
        # In a column there is room for the letters of the panels alone.
        narrow = width < WIDTH
        figure = new_figure(width, (2.5 if narrow else 2.9) + raster_height)
        top, raster = figure.subplots(2, 1, sharex=True, height_ratios=[2.6, raster_height])
        for position, (shield, group) in enumerate(groups.items()):
            colour, words = shield_colour(shield, position), shield_words(shield)
            kind = "line" if len(groups) == 1 else "dots" if shows_episodes(runs) else "none"
            _draw_returns(top, group, colour, words, shield_dashes(shield), episodes_as=kind)
        titles = ["Accumulated reward per training episode", "How each episode ended"]
        panel_titles([top, raster], ["", ""] if narrow else titles, in_caption=True)
        _finish_returns(top, rows, narrow=narrow)
        _draw_outcomes(raster, rows, narrow=narrow)
        if narrow:
            raster.set_title(raster.get_title("left"), x=_BESIDE)
        return save(figure, path)


def shows_episodes(runs: Sequence[Run]) -> bool:
    """Whether `reward_figure` shows each episode's return, or only means.

    Returns are near 0 or near 1000, so those of more than two shields would cover each other.
    """
    return len(by_shield(runs)) <= _MOST_SHIELDS_WITH_EPISODES


def _returns(run: Run) -> np.ndarray:
    return np.array([float(episode["return"]) for episode in run.metrics])


def _draw_returns(
    axes: Axes, group: Sequence[Run], colour: str, label: str, dashes: Any, *, episodes_as: str
) -> None:
    curves = [_returns(run) for run in group]
    several = len(group) > 1
    label += f", {len(group)} seeds" if several else ""
    for returns in curves:
        episodes = np.arange(1, len(returns) + 1)
        if several:
            axes.plot(episodes, moving_mean(returns), color=colour, alpha=0.35, linewidth=0.7)
        elif episodes_as == "line":
            axes.plot(episodes, returns, color=colour, alpha=0.3, linewidth=0.7)
        elif episodes_as == "dots":
            axes.scatter(episodes, returns, s=7, color=colour, alpha=0.45, linewidth=0)
        closed = converged_episode(returns)
        if closed is not None:
            axes.plot(
                closed, moving_mean(returns)[closed - 1], marker="D", markersize=5, color=colour,
                markeredgecolor="white", markeredgewidth=0.8, zorder=5, linestyle="none",
            )  # fmt: skip
    shortest = min(len(returns) for returns in curves)
    means = np.stack([moving_mean(returns[:shortest]) for returns in curves])
    episodes = np.arange(1, shortest + 1)
    middle = np.array([interquartile_mean(column) for column in means.T])
    axes.plot(
        episodes, middle, color=colour, linewidth=2.0, linestyle=dashes, label=label, zorder=4,
        dash_capstyle="butt",
    )  # fmt: skip
    if several:
        axes.fill_between(
            episodes, means.min(axis=0), means.max(axis=0), color=colour, alpha=0.15, linewidth=0
        )


def _finish_returns(axes: Axes, runs: Sequence[Run], *, narrow: bool) -> None:
    longest = max((len(run.metrics) for run in runs), default=1)
    light_grid(axes, "y")
    axes.axhline(CONVERGENCE_RETURN, color=INK, linewidth=0.8, linestyle=(0, (4, 3)))
    axes.text(
        1.005, CONVERGENCE_RETURN, f"{CONVERGENCE_RETURN:.0f}", transform=axes.get_yaxis_transform(),
        va="center", fontsize=7,
    )  # fmt: skip
    if longest > PAPER_CONVERGED:
        axes.axvline(PAPER_CONVERGED, color=INK, linewidth=0.8, linestyle=(0, (1, 2)))
        axes.text(
            PAPER_CONVERGED,
            0.03,
            "the paper " if narrow else "the paper converged by here ",
            transform=axes.get_xaxis_transform(),
            fontsize=7,
            ha="right",
        )
    axes.set_ylabel("accumulated reward")
    axes.set_xlim(0, longest + 1)
    handles, _ = axes.get_legend_handles_labels()
    diamond = Line2D(
        [], [], marker="D", linestyle="none", color=INK, markersize=4.5,
        label="converged"
        if narrow
        else f"converged: mean of {CONVERGENCE_WINDOW} at least {CONVERGENCE_RETURN:.0f}",
    )  # fmt: skip
    # Above the axes, where no curve can run.
    in_one_row = len(handles) <= 3 and len(runs) == len(handles)
    most = 2 if narrow else 3
    columns, rows = (4, 1) if in_one_row and not narrow else (most, len(handles) // most + 1)
    axes.set_title(
        axes.get_title("left"), pad=(-8.0 if narrow else 6.0) + 14.0 * rows, x=_BESIDE if narrow else 0.0
    )
    axes.legend(
        handles=[*handles, diamond], loc="lower left", bbox_to_anchor=(0.0, 1.0), ncols=columns,
        borderaxespad=0.2, columnspacing=1.4, handletextpad=0.5,
    ).set_in_layout(not narrow)  # fmt: skip


def _draw_outcomes(axes: Axes, runs: Sequence[Run], *, narrow: bool) -> None:
    many = len(runs) > _MANY_RUNS
    for row, run in enumerate(runs):
        for outcome, colour in OUTCOME_COLOURS.items():
            episodes = [i + 1 for i, episode in enumerate(run.metrics) if episode["outcome"] == outcome]
            size = {"reached": 2.5, "timed_out": 9.0}.get(outcome, 18.0) * (0.6 if many else 1.0)
            axes.scatter(
                episodes, [row] * len(episodes), s=size, marker=OUTCOME_MARKERS[outcome], color=colour,
                linewidth=0, zorder=3 if outcome != "reached" else 2,
            )  # fmt: skip
    several_seeds = len(runs) > len({run.shield for run in runs})
    labels = [run.shield + (f", seed {run.seed}" if several_seeds else "") for run in runs]
    axes.set_yticks(range(len(runs)), labels, fontsize=6 if many else 7.5)
    axes.set_ylim(len(runs) - 0.4, -0.6)
    axes.tick_params(axis="y", length=0)
    axes.spines["left"].set_visible(False)
    axes.set_xlabel("training episode")
    handles = [
        Line2D(
            [], [], marker=OUTCOME_MARKERS[name], linestyle="none", color=colour, markeredgewidth=0,
            markersize=5, label=name.replace("_", " ") if narrow else OUTCOME_WORDS[name],
        )
        for name, colour in OUTCOME_COLOURS.items()
    ]  # fmt: skip
    axes.legend(
        handles=handles, loc="lower right", bbox_to_anchor=(1.0, 1.0), ncols=4, borderaxespad=0.2,
        handletextpad=0.1, columnspacing=0.7 if narrow else 1.2,
    ).set_in_layout(not narrow)  # fmt: skip


def safety_rows(runs: Sequence[Run]) -> list[dict[str, Any]]:
    """The paper's Table I, its own column first: episodes, safe episodes, ratio and its 95 % bounds.

    Several seeds of a shield are pooled.
    """
    low, high = wilson_interval(PAPER_EPISODES, PAPER_EPISODES)
    rows = [
        {
            "name": "the paper reports",
            "shield": None,
            "episodes": PAPER_EPISODES,
            "safe": PAPER_EPISODES,
            "captured": 0,
            "collided": 0,
            "ratio": 1.0,
            "low": low,
            "high": high,
        }
    ]
    for shield, group in by_shield(runs).items():
        outcomes = [episode["outcome"] for run in group for episode in run.metrics]
        captured, collided = outcomes.count("captured"), outcomes.count("collided")
        safe = len(outcomes) - captured - collided
        low, high = wilson_interval(safe, len(outcomes))
        rows.append(
            {
                "name": shield_words(shield),
                "shield": shield,
                "episodes": len(outcomes),
                "safe": safe,
                "captured": captured,
                "collided": collided,
                "ratio": safe / len(outcomes) if outcomes else None,
                "low": low,
                "high": high,
            }
        )
    return rows


def safety_table(runs: Sequence[Run], path: str | Path) -> tuple[Path, Path]:
    """The number of safe episodes in training as a table, the paper's beside ours. Writes PNG and PDF."""
    columns = safety_rows(runs)

    def share(value: float | None) -> str:
        return "–" if value is None else f"{100 * value:.1f} %"

    lines = [
        ("episodes", [str(column["episodes"]) for column in columns]),
        ("safe episodes", [str(column["safe"]) for column in columns]),
        ("   captured", [str(column["captured"]) for column in columns]),
        ("   collided", [str(column["collided"]) for column in columns]),
        ("safety ratio", [share(column["ratio"]) for column in columns]),
        ("   95 % bounds", [f"{share(column['low'])[:-2]} – {share(column['high'])}" for column in columns]),
    ]
    with house_style():
        height = 0.24
        figure = new_figure(min(WIDTH, 1.6 + 1.35 * len(columns)), height * (len(lines) + 2.2))
        axes = figure.add_subplot()
        axes.set_axis_off()
        axes.set_xlim(0, 1.2 + len(columns))
        axes.set_ylim(len(lines) + 0.6, -1.0)
        for index, column in enumerate(columns):
            axes.text(2.1 + index, -0.35, column["name"], ha="right", va="center", weight="bold")
        for row, (name, cells) in enumerate(lines):
            quiet = "#555555" if name.startswith(" ") else INK
            axes.text(0.02, row + 0.5, name, va="center", color=quiet)
            for index, cell in enumerate(cells):
                axes.text(2.1 + index, row + 0.5, cell, ha="right", va="center", color=quiet)
        for y, width in ((-0.85, 1.2), (0.0, 0.6), (len(lines) + 0.1, 1.2)):
            axes.plot([0, 1.2 + len(columns)], [y, y], color=INK, linewidth=width, clip_on=False)
        return save(figure, path)


def outcome_figure(
    evaluations: Mapping[str, Mapping[str, Any]],
    path: str | Path,
    untrained: Mapping[str, Mapping[str, Any]] | None = None,
) -> tuple[Path, Path]:
    """Shares of episodes captured, collided, timed out and reached per shield, with 95 % Wilson intervals.

    Filled: the learned policy; hollow below it: the one that heads straight for the target, if given. What
    differs between the two is the policy's work, what differs between rows the shield's.

    **Arguments:** `evaluations`, `untrained` what `Evaluation.to_dict` gives, by shield. Writes PNG and PDF.
    """
    panels = (
        ("captured", "Captured"),
        ("collided", "Collided"),
        ("timed_out", "Timed out"),
        ("reached", "Reached"),
    )
    untrained = untrained or {}
    names = list(dict.fromkeys([*evaluations, *untrained]))
    apart = 0.21 if untrained else 0.0
    with house_style():
        figure = new_figure(WIDTH, 0.95 + (0.46 if untrained else 0.27) * len(names))
        axes = figure.subplots(1, len(panels), sharey=True)
        for one, (outcome, title) in zip(axes, panels, strict=True):
            most = 1.0
            for row, name in enumerate(names):
                colour = shield_colour(name, row)
                for reports, place, face in (
                    (evaluations, row - apart, colour),
                    (untrained, row + apart, "white"),
                ):
                    if name in reports:
                        high = _draw_share(one, reports[name], outcome, place, colour, face)
                        most = max(most, high)
            one.set_xlim(-0.04 * most, 1.08 * most) if outcome != "reached" else None
            one.set_xlabel("% of episodes")
            one.set_title(title)
            light_grid(one, "x")
            one.tick_params(axis="y", length=0)
            one.spines["left"].set_visible(False)
        axes[0].set_yticks(range(len(names)), [shield_words(name) for name in names])
        axes[0].set_ylim(len(names) - 0.5, -0.65)
        if untrained:
            handles = [
                Line2D([], [], marker="o", linestyle="none", color=INK, markersize=5, label="learned policy"),
                Line2D(
                    [], [], marker="o", linestyle="none", color=INK, markerfacecolor="white", markersize=5,
                    label="straight for the target, not learned",
                ),
            ]  # fmt: skip
            figure.legend(handles=handles, loc="outside lower center", ncols=2)
        return save(figure, path)


def _draw_share(
    axes: Axes, report: Mapping[str, Any], outcome: str, place: float, colour: str, face: str
) -> float:
    """One share (%) with its interval and count; the upper end of the interval."""
    rate, low, high = (100 * report[f"{outcome}_rate{end}"] for end in ("", "_low", "_high"))
    axes.plot([low, high], [place, place], color=colour, linewidth=2.2, alpha=0.5)
    axes.plot(rate, place, "o", color=colour, markerfacecolor=face, markersize=5)
    axes.annotate(
        f"{report[outcome]}", (rate, place), xytext=(0, 4), textcoords="offset points", ha="center",
        fontsize=6.5,
    )  # fmt: skip
    return high
