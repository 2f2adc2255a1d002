"""The report of one episode, for example of a log, as one self-contained HTML file."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from jinja2 import Environment, PackageLoader, StrictUndefined

import sidestep
from sidestep.loop import Trajectory
from sidestep.safety import Status
from sidestep.store.files import write_bytes
from sidestep.views.html import data_uri, shown_number, shown_value
from sidestep.views.style import OUTCOME_WORDS
from sidestep.views.trajectory_figures import trajectory_figure
from sidestep.world import Scenario
from sidestep.world.loading import scenario_to_dict


def write_episode_report(
    scenario: Scenario,
    trajectory: Trajectory,
    path: str | Path,
    *,
    title: str = "One episode",
    about: Mapping[str, Any] | None = None,
    notes: Sequence[str] = (),
    figures: str | Path | None = None,
) -> Path:
    """Draw an episode and write its report; returns the HTML file's path.

    **Arguments:** `about` metadata by name, including `shield` for the figure; `notes` on missing data;
    `figures` the folder for the figure as PNG and PDF (default: `figures` beside `path`).
    """
    path, about = Path(path), dict(about or {})
    folder = path.parent / "figures" if figures is None else Path(figures)
    drawn = trajectory_figure(
        scenario,
        trajectory,
        folder / path.stem,
        shield=str(about.get("shield", "")),
        title="Paths, in seconds",
    )
    content = {
        "title": title,
        "outcome": OUTCOME_WORDS[trajectory.outcome],
        "seconds": trajectory.length * float(scenario.control_period),
        "number": shown_number,
        "about": {name: shown_value(value) for name, value in about.items() if value not in (None, "")},
        "cards": _cards(trajectory),
        "notes": list(notes),
        "figure": data_uri(drawn[0]),
        "scenario": {name: shown_value(value) for name, value in scenario_to_dict(scenario).items()},
        "version": sidestep.__version__,
    }
    environment = Environment(
        loader=PackageLoader("sidestep.views"), autoescape=True, undefined=StrictUndefined, trim_blocks=True,
        lstrip_blocks=True,
    )  # fmt: skip
    write_bytes(path, environment.get_template("episode.html").render(content).encode())
    return path


def _cards(trajectory: Trajectory) -> list[tuple[str, str, str]]:
    """Name, number and unit of the most important results."""
    status, changed = np.asarray(trajectory.status), np.asarray(trajectory.intervention)
    cards = []
    for name, clearance in (
        ("Closest to capture", trajectory.events.pursuer_clearance),
        ("Closest to collision", trajectory.events.obstacle_clearance),
    ):
        least = float(np.min(np.asarray(clearance)))
        if np.isfinite(least):
            cards.append((name, shown_number(1000.0 * least, 1), "mm to spare"))
    share = 100.0 * float(np.mean(status != Status.OK))
    cards.append(("Corrected", shown_number(share, 1), "% of the control periods"))
    cards.append(("Largest correction", shown_number(float(np.max(changed)), 3), "m/s"))
    lost = 100.0 * float(np.mean(status >= Status.INFEASIBLE))
    cards.append(("Rows that could not hold", shown_number(lost, 1), "% of the control periods"))
    if trajectory.pursuer_invalid:
        still = str(trajectory.pursuer_invalid)
        cards.append(("Pursuer's wheel speeds not finite", still, "control periods: it stood still"))
    return cards
