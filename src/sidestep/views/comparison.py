"""Tables of a reproduction study from its summary: a column with the paper's results, then one per shield."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

OUTCOME_ROWS = (
    ("captured", "captured"),
    ("collided", "collided"),
    ("timed_out", "timed out"),
    ("reached", "reached"),
)
UNKNOWN = "-"
REPORTED = "reported"
"""The title of the column with the paper's results."""


@dataclass(frozen=True)
class Section:
    """One table: its title, the names of its columns (the paper's first), and its labelled rows.

    Labels have at most 23 characters and cells 9, so that four shields fit into 80 columns. A label that
    begins with a space belongs to the row above it.
    """

    title: str
    columns: tuple[str, ...]
    rows: tuple[tuple[str, tuple[str, ...]], ...]


def comparison_sections(summary: Mapping[str, Any]) -> list[Section]:
    """The tables of a study.

    **Arguments:** `summary`, the content of `summary.json` of `reproduce`.

    **Returns** the tables of the training, of random starts with the learned and the goal-seeking policy, and
    of the test scene with each. Periods with invalid input have a row only if there were any.
    """
    shields, paper = summary["shields"], summary["paper"]
    sections = [
        _section("Training", shields, "training", paper["training"], _TRAINING),
    ]
    for key, policy in (("trained", "learned"), ("untrained", "goal-seeking (not learned)")):
        count = next(iter(shields.values()))[key]["episodes"]
        sections.append(_section(f"{count} random starts, {policy} policy", shields, key, {}, _EVALUATION))
    for key, policy in (("scene_trained", "learned"), ("scene_untrained", "goal-seeking (not learned)")):
        reported = paper.get(key, {})
        sections.append(_section(f"The paper's test scene, {policy} policy", shields, key, reported, _SCENE))
    return sections


def markdown_tables(sections: Sequence[Section]) -> str:
    """The tables as Markdown."""
    lines: list[str] = []
    for section in sections:
        head = ["", *section.columns]
        lines += [f"**{section.title}**", "", _markdown_row(head), _markdown_row(["---"] * len(head))]
        lines += [_markdown_row([label.strip(), *cells]) for label, cells in section.rows]
        lines.append("")
    return "\n".join(lines)


def _markdown_row(cells: Sequence[str]) -> str:
    return "| " + " | ".join(cells) + " |"


Figures = Mapping[str, Any]
Show = Callable[[Figures], str]


def _section(
    title: str,
    shields: Mapping[str, Figures],
    key: str,
    reported: Figures,
    rows: Sequence[tuple[str, Show]],
) -> Section:
    shown = []
    for label, show in rows:
        if show is _invalid and not any(study[key].get("invalid_rate") for study in shields.values()):
            continue
        try:
            paper = show(reported)
        except KeyError:
            paper = UNKNOWN
        shown.append((label, (paper, *(show(study[key]) for study in shields.values()))))
    return Section(title, (REPORTED, *shields), tuple(shown))


def _share(name: str) -> Show:
    """A share in per cent; rounding never gives 0 % or 100 % unless exact."""

    def show(figures: Figures) -> str:
        share = figures[name]
        if share is None or share in (0.0, 1.0):
            return UNKNOWN if share is None else f"{100 * share:.0f} %"
        return f"{min(max(100 * share, 0.1), 99.9):.1f} %"

    return show


def _bounds(figures: Figures, name: str) -> str:
    low, high = (f"{100 * figures[f'{name}_rate_{end}']:.1f}" for end in ("low", "high"))
    return f"{low.replace('100.0', '100')}-{high.replace('100.0', '100')}"


def _count(name: str) -> Show:
    return lambda figures: f"{figures[name]:d}"


def _decimals(name: str, digits: int) -> Show:
    def show(figures: Figures) -> str:
        value = figures[name]
        # Adding 0.0 turns -0.0 into 0.0.
        return UNKNOWN if value is None else f"{round(value, digits) + 0.0:.{digits}f}"

    return show


def _converged(figures: Figures) -> str:
    episode = figures["converged_episode"]
    return "never" if episode is None else str(episode)


def _invalid(figures: Figures) -> str:
    return UNKNOWN if figures.get("invalid_rate") is None else _share("invalid_rate")(figures)


def _stays_from(figures: Figures) -> str:
    # Missing in the paper and in summaries before version 0.2.
    if "converged_stays_from" not in figures:
        return UNKNOWN
    episode = figures["converged_stays_from"]
    return "never" if episode is None else str(episode)


def _longest_stay(figures: Figures) -> str:
    stay = figures.get("converged_longest")
    return UNKNOWN if stay is None else f"{stay[0]}-{stay[1]}"


_INTERFERENCE: tuple[tuple[str, Show], ...] = (
    ("periods corrected", _share("intervention_rate")),
    ("mean correction, m/s", _decimals("mean_correction", 4)),
    ("periods infeasible", _share("infeasible_rate")),
    ("periods invalid", _invalid),
)

_CLEARANCES: tuple[tuple[str, Show], ...] = (
    ("closest to capture, m", _decimals("min_pursuer_clearance", 4)),
    ("closest to collision, m", _decimals("min_obstacle_clearance", 4)),
)

_TRAINING: tuple[tuple[str, Show], ...] = (
    ("episodes", _count("episodes")),
    ("safe episodes", _count("safe_episodes")),
    ("captured", _count("captured")),
    ("collided", _count("collided")),
    ("first converged at", _converged),
    ("  stays so from", _stays_from),
    ("  longest stay", _longest_stay),
    ("return, mean of last 20", _decimals("final_return", 0)),
    *_INTERFERENCE,
)

_EVALUATION: tuple[tuple[str, Show], ...] = (
    *(
        row
        for name, words in OUTCOME_ROWS
        for row in (
            (words, _share(f"{name}_rate")),
            ("  95 % bounds", lambda figures, name=name: _bounds(figures, name)),
        )
    ),
    ("median s to reach", _decimals("reach_time_median", 1)),
    *_INTERFERENCE,
    *_CLEARANCES,
)

_SCENE: tuple[tuple[str, Show], ...] = (
    ("outcome", lambda figures: figures["outcome"].replace("_", " ")),
    ("seconds", _decimals("seconds", 2)),
    *_INTERFERENCE,
    *_CLEARANCES,
)
