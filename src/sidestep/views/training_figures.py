"""Figures of trainings: returns and outcomes over episodes, and numbers of safe episodes."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.lines import Line2D

from sidestep.store.runs import (
    CONVERGENCE_RETURN,
    CONVERGENCE_WINDOW,
    converged_episode,
    moving_mean,
    stays_converged_from,
)
from sidestep.trials import interquartile_mean, wilson_interval
from sidestep.views import style
from sidestep.views.runs import Run, by_shield

PAPER_CONVERGED = 80
PAPER_EPISODES = 200
_MANY_RUNS = 6
_BESIDE = -0.19
"""Horizontal position of a panel's letter in a narrow figure, in widths of the axes."""
_BAND, _HIGHEST = 0.32, 1000.0
"""Half the height of a run's band of returns, in rows, and the return at its top."""


def reward_figure(runs: Sequence[Run], path: str | Path, *, width: float = style.WIDTH) -> tuple[Path, Path]:
    """Returns over training episodes: above as means, below one by one, with how every episode ended.

    a: mean return of the last 20 episodes; for several seeds its interquartile mean (thick), each seed (thin)
    and their range. A filled diamond marks a run's first convergence (mean of 20 at least 940), a hollow one
    the episode from which it stayed converged. b: the return of each episode, a row per run, clipped to
    [0, 1000], with markers for the outcome. Writes PNG and PDF, `width` inches wide.
    """
    groups = by_shield(runs)
    rows = [run for group in groups.values() for run in group]
    with style.house_style():
        raster_height = _row_height(rows) * max(len(rows), 1) + 0.25
        # A narrow figure has room for the panels' letters only.
        narrow = width < style.WIDTH
        figure = style.new_figure(width, (2.5 if narrow else 2.9) + raster_height)
        top, raster = figure.subplots(2, 1, sharex=True, height_ratios=[2.6, raster_height])
        for position, (shield, group) in enumerate(groups.items()):
            colour, words = style.shield_colour(shield, position), style.shield_words(shield)
            _draw_returns(top, group, colour, words, style.shield_dashes(shield))
        titles = [f"Mean return of the last {CONVERGENCE_WINDOW} episodes", "Return of each episode"]
        style.panel_titles([top, raster], ["", ""] if narrow else titles, in_caption=True)
        _finish_returns(top, rows, narrow=narrow)
        _draw_episodes(raster, rows, narrow=narrow)
        if narrow:
            raster.set_title(raster.get_title("left"), x=_BESIDE)
        return style.save(figure, path)


def _row_height(runs: Sequence[Run]) -> float:
    """Height (inches) of the row of one run."""
    return 0.4 if len(runs) <= _MANY_RUNS else 0.24


def _returns(run: Run) -> np.ndarray:
    return np.array([float(episode["return"]) for episode in run.metrics])


def _draw_returns(axes: Axes, group: Sequence[Run], colour: str, label: str, dashes: Any) -> None:
    curves = [_returns(run) for run in group]
    draw_means(axes, curves, colour, label, dashes)
    for returns in curves:
        means = moving_mean(returns)
        first, stays = converged_episode(returns), stays_converged_from(returns)
        look: dict[str, Any] = {"marker": "D", "markersize": 5, "linestyle": "none"}
        if first is not None:
            edge = {"color": colour, "markeredgecolor": "white", "markeredgewidth": 0.8}
            axes.plot(first, means[first - 1], **look, **edge, zorder=5.2)
        if stays is not None and stays != first:
            edge = {"color": "white", "markeredgecolor": colour, "markeredgewidth": 1.3}
            axes.plot(stays, means[stays - 1], **look, **edge, zorder=5.1)


def draw_means(
    axes: Axes, curves: Sequence[np.ndarray], colour: str, label: str, dashes: Any = "solid"
) -> None:
    """Draw the moving mean of a curve per seed (thin), their interquartile mean (thick) and their range."""
    several = len(curves) > 1
    label += f", {len(curves)} seeds" if several else ""
    if several:
        for values in curves:
            episodes = np.arange(1, len(values) + 1)
            axes.plot(episodes, moving_mean(values), color=colour, alpha=0.35, linewidth=0.7)
    shortest = min(len(values) for values in curves)
    means = np.stack([moving_mean(values[:shortest]) for values in curves])
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
    style.light_grid(axes, "y")
    axes.axhline(CONVERGENCE_RETURN, color=style.INK, linewidth=0.8, linestyle=(0, (4, 3)))
    axes.text(
        1.005, CONVERGENCE_RETURN, f"{CONVERGENCE_RETURN:.0f}", transform=axes.get_yaxis_transform(),
        va="center", fontsize=7,
    )  # fmt: skip
    if longest > PAPER_CONVERGED:
        axes.axvline(PAPER_CONVERGED, color=style.INK, linewidth=0.8, linestyle=(0, (1, 2)))
        axes.text(
            PAPER_CONVERGED,
            0.03,
            "the paper " if narrow else "the paper converged by here ",
            transform=axes.get_xaxis_transform(),
            fontsize=7,
            ha="right",
        )
    axes.set_ylabel("mean return")
    # The texts at the bottom are below every curve.
    low, high = axes.get_ylim()
    axes.set_ylim(min(low, 0.0) - (90.0 if longest > PAPER_CONVERGED else 0.0), max(high, 1050.0))
    axes.set_xlim(0, longest + 1)
    handles, _ = axes.get_legend_handles_labels()
    look: dict[str, Any] = {"marker": "D", "ls": "none", "mec": style.INK, "markersize": 4.5}
    words = ("first 940", "stays") if narrow else (f"first at {CONVERGENCE_RETURN:.0f}", "stays from here")
    diamonds = [
        Line2D([], [], **look, color=face, label=word)
        for face, word in zip((style.INK, "white"), words, strict=True)
    ]
    # Above the axes, where no curve is.
    most = 2 if narrow else 3
    rows = -(-(len(handles) + 2) // most)
    axes.set_title(
        axes.get_title("left"), pad=(-8.0 if narrow else 6.0) + 14.0 * rows, x=_BESIDE if narrow else 0.0
    )
    axes.legend(
        handles=[*handles, *diamonds], loc="lower left", bbox_to_anchor=(0.0, 1.0), ncols=most,
        borderaxespad=0.2, columnspacing=1.4, handletextpad=0.5,
    ).set_in_layout(not narrow)  # fmt: skip


def _draw_episodes(axes: Axes, runs: Sequence[Run], *, narrow: bool) -> None:
    """Every episode's return, in one band per run, with markers for the outcome."""
    many = len(runs) > _MANY_RUNS
    for row, run in enumerate(runs):
        places = row + _BAND * (1.0 - 2.0 * np.clip(_returns(run) / _HIGHEST, 0.0, 1.0))
        outcomes = np.array([episode["outcome"] for episode in run.metrics], dtype=object)
        for level in (_BAND, -_BAND):
            axes.axhline(row + level, color="#E6E6E6", linewidth=0.6, zorder=0.5)
        for outcome, colour in style.OUTCOME_COLOURS.items():
            found = np.flatnonzero(outcomes == outcome)
            size = {"reached": 3.0, "timed_out": 9.0}.get(outcome, 13.0) * (0.6 if many else 1.0)
            axes.scatter(
                found + 1, places[found], s=size, marker=style.OUTCOME_MARKERS[outcome], color=colour,
                linewidth=0, zorder=3 if outcome != "reached" else 2,
            )  # fmt: skip
    several_seeds = len(runs) > len({run.shield for run in runs})
    labels = [run.shield + (f", seed {run.seed}" if several_seeds else "") for run in runs]
    axes.set_yticks(range(len(runs)), labels, fontsize=6 if many else 7.5)
    axes.set_ylim(len(runs) - 0.45, -0.55)
    if not many:
        for row in range(len(runs)):
            for level, word in ((_BAND, "0"), (-_BAND, f"{_HIGHEST:.0f}")):
                axes.text(
                    1.005, row + level, word, transform=axes.get_yaxis_transform(), va="center", fontsize=6
                )
    axes.tick_params(axis="y", length=0)
    axes.spines["left"].set_visible(False)
    axes.set_xlabel("training episode")
    handles = [
        Line2D(
            [], [], marker=style.OUTCOME_MARKERS[name], linestyle="none", color=colour, markeredgewidth=0,
            markersize=5, label=name.replace("_", " ") if narrow else style.OUTCOME_WORDS[name],
        )
        for name, colour in style.OUTCOME_COLOURS.items()
    ]  # fmt: skip
    axes.legend(
        handles=handles, loc="lower right", bbox_to_anchor=(1.0, 1.0), ncols=4, borderaxespad=0.2,
        handletextpad=0.1, columnspacing=0.7 if narrow else 1.2,
    ).set_in_layout(not narrow)  # fmt: skip


def safety_rows(runs: Sequence[Run]) -> list[dict[str, Any]]:
    """The paper's Table I, the paper's column first: episodes, safe episodes, ratio and its 95 % bounds.

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
                "name": style.shield_words(shield),
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
    """The numbers of safe episodes in training as a table, with the paper's. Writes PNG and PDF."""
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
    with style.house_style():
        height = 0.24
        figure = style.new_figure(min(style.WIDTH, 1.6 + 1.35 * len(columns)), height * (len(lines) + 2.2))
        axes = figure.add_subplot()
        axes.set_axis_off()
        axes.set_xlim(0, 1.2 + len(columns))
        axes.set_ylim(len(lines) + 0.6, -1.0)
        for index, column in enumerate(columns):
            axes.text(2.1 + index, -0.35, column["name"], ha="right", va="center", weight="bold")
        for row, (name, cells) in enumerate(lines):
            quiet = "#555555" if name.startswith(" ") else style.INK
            axes.text(0.02, row + 0.5, name, va="center", color=quiet)
            for index, cell in enumerate(cells):
                axes.text(2.1 + index, row + 0.5, cell, ha="right", va="center", color=quiet)
        for y, width in ((-0.85, 1.2), (0.0, 0.6), (len(lines) + 0.1, 1.2)):
            axes.plot([0, 1.2 + len(columns)], [y, y], color=style.INK, linewidth=width, clip_on=False)
        return style.save(figure, path)


def outcome_figure(
    evaluations: Mapping[str, Mapping[str, Any]],
    path: str | Path,
    untrained: Mapping[str, Mapping[str, Any]] | None = None,
) -> tuple[Path, Path]:
    """Shares of episodes captured, collided, timed out and reached per shield, with 95 % Wilson intervals.

    Filled: the learned policy; hollow: the policy `goal-seeking`, if given. The difference between the two is
    due to the policy, the difference between rows due to the shield.

    **Arguments:** `evaluations`, `untrained` as of `Evaluation.to_dict`, by shield. Writes PNG and PDF.
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
    with style.house_style():
        figure = style.new_figure(style.WIDTH, 0.95 + (0.46 if untrained else 0.27) * len(names))
        axes = figure.subplots(1, len(panels), sharey=True)
        for one, (outcome, title) in zip(axes, panels, strict=True):
            most = 1.0
            for row, name in enumerate(names):
                colour = style.shield_colour(name, row)
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
            style.light_grid(one, "x")
            one.tick_params(axis="y", length=0)
            one.spines["left"].set_visible(False)
        axes[0].set_yticks(range(len(names)), [style.shield_words(name) for name in names])
        axes[0].set_ylim(len(names) - 0.5, -0.65)
        if untrained:
            dot: dict[str, Any] = {"marker": "o", "linestyle": "none", "color": style.INK, "markersize": 5}
            handles = [
                Line2D([], [], label="learned policy", **dot),
                Line2D([], [], label="straight for the target, not learned", markerfacecolor="white", **dot),
            ]
            figure.legend(handles=handles, loc="outside lower center", ncols=2)
        return style.save(figure, path)


def _draw_share(
    axes: Axes, report: Mapping[str, Any], outcome: str, place: float, colour: str, face: str
) -> float:
    """Draw one share (%) with its interval and count; returns the upper end of the interval."""
    rate, low, high = (100 * report[f"{outcome}_rate{end}"] for end in ("", "_low", "_high"))
    axes.plot([low, high], [place, place], color=colour, linewidth=2.2, alpha=0.5)
    axes.plot(rate, place, "o", color=colour, markerfacecolor=face, markersize=5)
    axes.annotate(
        f"{report[outcome]}", (rate, place), xytext=(0, 4), textcoords="offset points", ha="center",
        fontsize=6.5,
    )  # fmt: skip
    return high
