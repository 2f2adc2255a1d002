"""Figure of trainings: times to the target over episodes, beside what they can be compared with."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from matplotlib.lines import Line2D
from matplotlib.ticker import NullFormatter, ScalarFormatter

from sidestep.store.runs import CONVERGENCE_WINDOW
from sidestep.views import style
from sidestep.views.runs import Run, by_shield
from sidestep.views.training_figures import draw_means


def time_figure(runs: Sequence[Run], path: str | Path) -> tuple[Path, Path]:
    """Mean time to the target of the last 20 training episodes, on a logarithmic axis.

    An episode that did not reach the target counts as the time limit. Per shield as in `reward_figure`. At
    the right edge, from evaluations without exploration noise if there are any: filled, the trained policy;
    hollow, goal-seeking behind the same shield. Grey: the same episodes' time straight to the target at
    full speed, unless they were recorded by a version that did not keep it. Writes PNG and PDF.
    """
    groups = by_shield(runs)
    longest = max((len(run.metrics) for run in runs), default=1)
    with style.house_style():
        figure = style.new_figure(style.WIDTH, 2.9)
        axes = figure.subplots()
        axes.set_yscale("log")  # first: matplotlib refuses it later where runs are too short for a mean
        for position, (shield, group) in enumerate(groups.items()):
            colour, words = style.shield_colour(shield, position), style.shield_words(shield)
            draw_means(axes, [_times(run) for run in group], colour, words, style.shield_dashes(shield))
            for field, place, look in (
                ("evaluation", 1.01, style.mark(colour, 5)),
                ("untrained_evaluation", 1.02, style.mark("white", 4.5, colour, 1.2)),
            ):
                reports = [getattr(run, field) or {} for run in group]
                times = [report["time_mean"] for report in reports if "time_mean" in report]
                if times:
                    axes.plot(
                        (place + 0.025 * position) * longest,
                        np.mean(times),
                        marker="o",
                        clip_on=False,
                        zorder=5,
                        **look,
                    )
        straight = [times for run in runs if len(times := _straight(run))]
        if straight:
            shortest = min(len(times) for times in straight)
            means = np.mean([times[:shortest] for times in straight], axis=0)
            draw_means(axes, [means], style.FAINT, "straight there, alone")
        axes.yaxis.set_major_formatter(ScalarFormatter())
        axes.yaxis.set_minor_formatter(NullFormatter())
        style.light_grid(axes, "y")
        axes.set_xlabel("training episode")
        axes.set_ylabel("mean time, s")
        style.panel_titles([axes], [f"Mean time to the target of the last {CONVERGENCE_WINDOW} episodes"])
        handles, _ = axes.get_legend_handles_labels()
        ends = {
            "trained policy": style.mark(style.INK, 5),
            "goal-seeking": style.mark("white", 4.5, style.INK, 1.2),
        }
        handles += [Line2D([], [], marker="o", label=label, **look) for label, look in ends.items()]
        figure.legend(handles=handles, loc="outside lower center", ncols=4)
        return style.save(figure, path)


def _times(run: Run) -> np.ndarray:
    """Time to the target of each training episode, s; the time limit where it was not reached."""
    scenario = run.scenario
    steps = [
        episode["steps"] if episode["outcome"] == "reached" else scenario.episode_steps
        for episode in run.metrics
    ]
    return np.array(steps) * float(scenario.control_period)


def _straight(run: Run) -> np.ndarray:
    """Time straight there at full speed of each training episode, s; empty if it is not known of all."""
    times = [episode.get("straight_time") for episode in run.metrics]
    return np.array([] if None in times else times, float)
