"""Figures of what `benchmarks/bench.py` measured, from its JSON alone."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter

from sidestep.views import style
from speed.timing import tail, tail_exponent

CURVE_COLOURS = (style.BLUE, style.VERMILION, style.GREEN, style.PURPLE)
MARKERS = ("o", "s", "^", "D")


def draw_all(results: dict[str, Any], folder: Path) -> list[Path]:
    """One PNG for each figure that there is something for."""
    sections = results["sections"]
    figures: dict[str, tuple[Callable[..., Any], Sequence[str]]] = {
        "bench_speed": (speed_figure, ("learning", "simulation", "roofline", "joint")),
        "bench_filter": (filter_figure, ("filter",)),
        "bench_scaling": (scaling_figure, ("scaling",)),
        "bench_memory": (memory_figure, ("scaling",)),
    }
    paths = []
    for name, (draw, needs) in figures.items():
        there = {need: sections[need] for need in needs if need in sections and _cases(sections[need])}
        if there:
            with style.house_style():
                png, pdf = style.save(draw(there), folder / name)
            pdf.unlink()
            paths.append(png)
    return paths


def _cases(section: dict[str, Any]) -> list[dict[str, Any]]:
    """The cases that could run."""
    return [case for case in section["cases"] if "missing" not in case and "error" not in case]


def _bars(axes: Axes, values: dict[str, float], unit: str, digits: Callable[[float], str]) -> None:
    """Horizontal bars with their values, largest first; ours in blue."""
    names = sorted(values, key=lambda name: values[name])
    colours = [style.BLUE if name.startswith("ours") else style.GREY for name in names]
    axes.barh(names, [values[name] for name in names], color=colours, height=0.62)
    for place, name in enumerate(names):
        axes.annotate(
            digits(values[name]),
            (values[name], place),
            (3, 0),
            textcoords="offset points",
            va="center",
            fontsize=7,
            zorder=5,
            bbox={"facecolor": "white", "edgecolor": "none", "pad": 1.2},
        )
    axes.set_xlabel(unit)
    axes.margins(x=0.16)
    axes.tick_params(axis="y", length=0)


def _plain_log(axes: Axes) -> None:
    """A logarithmic x axis in plain numbers: ticks at 1, 2 and 5, or at powers of ten where it is long."""
    axes.set_xscale("log")
    low, high = axes.get_xlim()
    axes.xaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0) if high < 150.0 * low else (1.0,)))
    axes.xaxis.set_major_formatter(FuncFormatter(_plain))
    axes.xaxis.set_minor_formatter(NullFormatter())


def _plain(value: float, _: Any = None) -> str:
    for size, letter in ((1e6, "M"), (1e3, "k")):
        if value >= size:
            return f"{value / size:g}{letter}"
    return f"{value:g}"


def speed_figure(sections: dict[str, Any]) -> Any:
    """Training loops, simulation, the roofline, and how long a decision takes."""
    draw = {
        "learning": (_learning, "Training loop, one update per step"),
        "simulation": (_simulation, "Worlds with a pursuer"),
        "roofline": (_roofline, "Arithmetic of the update"),
        "joint": (_joint, "One decision of a shield"),
    }
    height = 1.9 * ((len(sections) + 1) // 2)
    figure = style.new_figure(style.WIDTH, height)
    columns = 1 if len(sections) == 1 else 2
    panels = np.atleast_1d(figure.subplots((len(sections) + 1) // 2, columns)).ravel()
    for axes in panels[len(sections) :]:
        axes.set_axis_off()
    used = list(panels[: len(sections)])
    for axes, (name, section) in zip(used, sections.items(), strict=True):
        draw[name][0](axes, section)
    style.panel_titles(used, [draw[name][1] for name in sections])
    return figure


def _learning(axes: Axes, section: dict[str, Any]) -> None:
    _bars(axes, section["summary"]["steps_per_second"], "steps per second", lambda v: f"{v:.0f}")


def _simulation(axes: Axes, section: dict[str, Any]) -> None:
    values = {name: value / 1e6 for name, value in section["summary"]["steps_per_second"].items()}
    _bars(axes, values, "million control periods per second", lambda v: f"{v:.3g}")


def _roofline(axes: Axes, section: dict[str, Any]) -> None:
    summary = section["summary"]
    per_update = summary["megaflops_per_update"] / 1000.0
    values = dict(summary["gflops"])
    for name, share in summary["share_of_roofline"].items():
        values[f"ours, {name}"] = share * summary["roofline_updates_per_second"] * per_update
    _bars(axes, values, "GFLOP/s", lambda v: f"{v:.0f}")
    axes.axvline(max(summary["gflops"].values()), color=style.INK, linewidth=0.8, linestyle=(0, (2, 2)))


def _joint(axes: Axes, section: dict[str, Any]) -> None:
    cases = _cases(section)
    for place, case in enumerate(cases):
        timed = case["latency"]
        low, middle, high = (timed[key] / 1000.0 for key in ("p50", "p99", "worst"))
        axes.plot([low, high], [place, place], color=style.FAINT, linewidth=2.0, zorder=1)
        # The numbers stand apart, because a shield that always does the same has them close together.
        marks = (
            (low, "o", "median", "right", (-6, -2.5)),
            (middle, "s", "99 of 100", "center", (0, 5)),
            (high, "X", "worst", "left", (6, -2.5)),
        )
        for value, marker, word, side, away in marks:
            axes.scatter(
                value,
                place,
                color=style.BLUE,
                marker=marker,
                s=26,
                zorder=2,
                label=word if place == 0 else None,
            )
            axes.annotate(
                f"{value:.2g}", (value, place), away, textcoords="offset points", ha=side, fontsize=7
            )
    axes.margins(x=0.3)
    _plain_log(axes)
    axes.set_yticks(range(len(cases)), [case["name"] for case in cases])
    axes.set_ylim(-1.5, len(cases) - 0.3)  # below the last there is room for the key
    axes.set_xlabel("milliseconds")
    axes.legend(loc="lower center", ncols=3, handletextpad=0.2, columnspacing=0.8)
    style.light_grid(axes, "x")


def filter_figure(sections: dict[str, Any]) -> Any:
    """Single calls, median to 99 of 100, and problems per second in a batch; two and eight rows."""
    cases = _cases(sections["filter"])
    names = list(dict.fromkeys(case["name"] for case in cases))[::-1]
    figure = style.new_figure(style.WIDTH, 0.7 + 0.32 * len(names))
    left, right = figure.subplots(1, 2, sharey=True)
    looped = {
        case["name"] for case in cases
    } - {case["name"] for case in cases if case["settings"]["calls"] == "batch"}  # fmt: skip
    for case in cases:
        settings = case["settings"]
        few = settings["rows"] == min(one["settings"]["rows"] for one in cases)
        place = names.index(case["name"]) + (0.16 if few else -0.16)
        look: dict[str, Any] = {"color": style.BLUE if few else style.ORANGE, "marker": "o" if few else "s"}
        if settings["calls"] == "single":
            timed = case["latency"]
            left.plot(
                [timed["p50"], timed["p99"]], [place] * 2, color=look["color"], linewidth=1.2, alpha=0.5
            )
            left.plot(
                timed["p50"], place, linestyle="", markersize=4.5, label=f"{settings['rows']} rows", **look
            )
        if settings["calls"] == "batch" or case["name"] in looped:
            hollow = {"markerfacecolor": "white"} if settings["calls"] == "single" else {}
            right.plot(case["throughput"]["value"], place, linestyle="", markersize=4.5, **look, **hollow)
    left.set_yticks(range(len(names)), names)
    for axes, label in (
        (left, "microseconds: median, line to 99 of 100"),
        (right, "problems per second (hollow: one by one)"),
    ):
        _plain_log(axes)
        axes.set_xlabel(label)
        axes.tick_params(axis="y", length=0)
        style.light_grid(axes)
    handles, labels = left.get_legend_handles_labels()
    unique = dict(zip(labels, handles, strict=True))
    right.legend(unique.values(), unique.keys(), loc="lower right")
    style.panel_titles([left, right], ["A single call", "A batch"])
    return figure


def _draw_fit(axes: Axes, points: Sequence[tuple[float | int, float]], power: float) -> None:
    """The power law through the sizes it was fitted to."""
    sizes, spent = np.log(np.asarray(points, float).T)
    middle = np.mean(spent) + power * (sizes - np.mean(sizes))
    axes.plot(
        np.exp(sizes), np.exp(middle), color=style.INK, linewidth=0.9, linestyle=(0, (2, 1.5)), zorder=3
    )


PANELS = {
    "worlds": "Worlds side by side",
    "obstacles": "Obstacles",
    "pursuers": "Pursuers",
    "rows": "Rows in the filter",
    "episodes": "Episodes",
    "seeds": "Seeds trained",
}
Y_LABELS = {
    "worlds": "s per control period",
    "obstacles": "s per control period",
    "pursuers": "s per control period",
    "rows": "s per problem, batched",
    "episodes": "s in all",
    "seeds": "s per step of all",
}


def scaling_figure(sections: dict[str, Any]) -> Any:
    """Seconds against each size, with the exponents of their growth, and dashed the fits that they are of."""
    return _growth(sections["scaling"], lambda point: point["seconds"], Y_LABELS, exponents=True)


def memory_figure(sections: dict[str, Any]) -> Any:
    """Peak memory of the process against each size."""
    labels = dict.fromkeys(PANELS, "peak memory, MiB")
    return _growth(sections["scaling"], lambda point: point["peak_memory_mib"], labels, exponents=False)


def _growth(
    section: dict[str, Any],
    quantity: Callable[[dict[str, Any]], float],
    labels: dict[str, str],
    *,
    exponents: bool,
) -> Any:
    cases = _cases(section)
    kinds = [kind for kind in PANELS if any(case["settings"]["curve"] == kind for case in cases)]
    rows = (len(kinds) + 2) // 3
    figure = style.new_figure(style.WIDTH, 2.2 * rows)
    panels = np.atleast_1d(figure.subplots(rows, min(3, len(kinds)))).ravel()
    for axes in panels[len(kinds) :]:
        axes.set_axis_off()
    for axes, kind in zip(panels, kinds, strict=False):
        curves = [case for case in cases if case["settings"]["curve"] == kind]
        for case, colour, marker in zip(curves, CURVE_COLOURS, MARKERS, strict=False):
            points = [point for point in case["points"] if point["size"] > 0]
            which = case["name"].partition(", ")[2]
            # Not the one in the file: what is enough for a fit is decided in one place.
            sizes, spent = [p["size"] for p in points], [quantity(p) for p in points]
            power = tail_exponent(sizes, spent) if exponents else None
            growth = "" if power is None else f"exponent {power:.2f}"
            label = ": ".join(part for part in (which, growth) if part) or None
            axes.plot(sizes, spent, color=colour, marker=marker, markersize=3, label=label)
            if power is not None:
                _draw_fit(axes, tail(sizes, spent), power)
        axes.set_xscale("log", base=10 if kind in ("worlds", "episodes") else 2)
        if exponents:
            axes.set_yscale("log")
        sizes = sorted({point["size"] for case in curves for point in case["points"] if point["size"] > 0})
        if kind not in ("worlds", "episodes"):
            axes.set_xticks(sizes, [f"{size:g}" for size in sizes])
        axes.minorticks_off()
        axes.set_ylabel(labels[kind])
        low, high = axes.get_ylim()
        # Room for the legend.
        room = 0.14 * (1 + len(curves))
        if exponents:
            axes.set_ylim(low, high * (high / low) ** room)
        else:
            axes.set_ylim(0.0, high * (1.0 + room))
        if axes.get_legend_handles_labels()[0]:
            axes.legend(loc="upper left", fontsize=6.5, borderaxespad=0.1, labelspacing=0.2)
        style.light_grid(axes)
    style.panel_titles(list(panels[: len(kinds)]), [PANELS[kind] for kind in kinds])
    return figure
