"""The report of one or several runs, as one self-contained HTML file."""

from __future__ import annotations

import importlib.metadata
import platform
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from jinja2 import Environment, PackageLoader, StrictUndefined

import sidestep
from sidestep.pursuit import CaptureGame
from sidestep.store.files import write_bytes
from sidestep.store.runs import held_if_run
from sidestep.views import style
from sidestep.views.html import shown_number, shown_value
from sidestep.views.pooling import pooled_evaluation
from sidestep.views.report_sections import (
    capture_section,
    clearance_section,
    embedded,
    first_of,
    map_section,
    replay_section,
    scene_section,
)
from sidestep.views.report_tables import card, comparison, percent
from sidestep.views.runs import Run, by_shield, load_run
from sidestep.views.scene import guarded
from sidestep.views.time_figure import time_figure
from sidestep.views.training_figures import (
    PAPER_CONVERGED,
    outcome_figure,
    reward_figure,
    safety_table,
)
from sidestep.views.trajectory_figures import scenes_figure
from sidestep.world import Scenario

_PACKAGES = ("jax", "equinox", "optax", "numpy", "matplotlib")


def write_report(
    runs: Sequence[Run | str | Path],
    path: str | Path,
    *,
    figures: str | Path | None = None,
    command: str | None = None,
) -> Path:
    """Draw the figures of these runs and write the report.

    **Arguments:**

    - `runs`: run folders, or `Run`s; several seeds of a shield are pooled. The test scene and the capture of
      a shield are those of its first run that has one
    - `path`: the HTML file
    - `figures`: the folder for the figures as PNG and PDF (default: `figures` beside `path`)
    - `command`: the command line that writes the report, to be shown in it

    **Raises** `ValueError` without a run, `RunError` for a folder without a run, `FolderInUseError` when
    `path` is in a run folder that another process writes in.
    """
    if not runs:
        raise ValueError("a report needs at least one run")
    loaded = [run if isinstance(run, Run) else load_run(run) for run in runs]
    path = Path(path)
    folder = path.parent / "figures" if figures is None else Path(figures)
    with held_if_run(path.parent):
        return _write(loaded, path, folder, command)


def _write(loaded: Sequence[Run], path: Path, folder: Path, command: str | None) -> Path:
    safety_table(loaded, folder / "safety")
    content = _content(loaded, folder) | {"command": command}
    environment = Environment(
        loader=PackageLoader("sidestep.views"), autoescape=True, undefined=StrictUndefined, trim_blocks=True,
        lstrip_blocks=True,
    )  # fmt: skip
    html = environment.get_template("report.html").render(content)
    write_bytes(path, html.encode())
    return path


def _content(runs: Sequence[Run], folder: Path) -> dict[str, Any]:
    groups = by_shield(runs)
    first = runs[0]
    scenario = first.scenario
    evaluations = _pooled_evaluations(groups, "evaluation")
    untrained = _pooled_evaluations(groups, "untrained_evaluation")
    untrained_scenes = {shield: scene for shield, (_, scene) in first_of(groups, "untrained_scene").items()}
    scenes = first_of(groups, "scene")
    return {
        "title": f"{scenario.name} scenario: " + ", ".join(style.shield_words(shield) for shield in groups),
        "version": first.config.get("version", sidestep.__version__),
        "versions": {name: importlib.metadata.version(name) for name in _PACKAGES},
        "python": platform.python_version(),
        "pursuers": sorted({str(run.config.get("pursuer", "?")) for run in runs}),
        "seeds": sorted({run.seed for run in runs}),
        "cards": [card(shield, group, scenes) for shield, group in groups.items()],
        "comparison": comparison(
            groups, {shield: scene for shield, (_, scene) in scenes.items()}, untrained_scenes
        ),
        "reward": _reward(runs, folder),
        "times": embedded(time_figure(runs, folder / "times")),
        "several_runs": any(len(group) > 1 for group in groups.values()),
        "evaluations": evaluations,
        "untrained": untrained,
        "untrained_scenes": embedded(
            scenes_figure(scenario, untrained_scenes, folder / "test-scene-untrained")
        )
        if untrained_scenes
        else None,
        "outcomes": embedded(outcome_figure(evaluations, folder / "outcomes", untrained))
        if evaluations
        else None,
        "scenes": [
            scene_section(run.scenario, shield, scene, folder) for shield, (run, scene) in scenes.items()
        ],
        "clearances": clearance_section(groups, scenario, folder),
        "map": map_section(groups, scenario, folder),
        "replay": replay_section(groups),
        "differences": _differences(runs),
        "capture": capture_section(groups, folder),
        "game": _game_numbers(scenario),
        "joint": "joint" in groups,
        "configurations": [_configuration(run) for run in runs],
        "outcome_words": style.OUTCOME_WORDS,
        "shield_words": style.shield_words,
        "colour": style.shield_colour,
        "percent": percent,
        "number": shown_number,
        "paper_converged": PAPER_CONVERGED,
    }


def _pooled_evaluations(groups: Mapping[str, Sequence[Run]], field: str) -> dict[str, dict[str, Any]]:
    """The pooled evaluations per shield."""
    found = {shield: [getattr(run, field) for run in group] for shield, group in groups.items()}
    measured = {shield: [one for one in many if one is not None] for shield, many in found.items()}
    return {shield: pooled_evaluation(many) for shield, many in measured.items() if many}


def _reward(runs: Sequence[Run], folder: Path) -> str:
    """Draw the reward figure twice, for the page and for one column of a paper; returns the page's."""
    reward_figure(runs, folder / "reward-column", width=style.COLUMN)
    return embedded(reward_figure(runs, folder / "reward"))


def _differences(runs: Sequence[Run]) -> list[tuple[str, list[str]]]:
    """Scenario fields in which these runs differ, with their values; such runs are not comparable."""
    scenarios = [run.config["scenario"] for run in runs]
    fields = {name for scenario in scenarios for name in scenario if name != "name"}
    found = []
    for name in sorted(fields):
        values = list(dict.fromkeys(shown_value(scenario.get(name)) for scenario in scenarios))
        if len(values) > 1:
            found.append((name.replace("_", " "), values))
    return found


def _game_numbers(scenario: Scenario) -> dict[str, Any]:
    kept = guarded(scenario)
    game = CaptureGame.of(kept)
    evader, pursuer = float(scenario.evader_speed), float(scenario.pursuer_speed)
    gain = float(scenario.pursuer_gain)
    largest = float(game.largest_capture_distance)
    return {
        "evader_speed": evader,
        "pursuer_speed": pursuer,
        "capture_distance": float(kept.capture_distance),
        "own_robots": not scenario.built_in,
        "gain": gain,
        "slower": evader < pursuer,
        "infeasible_below": (pursuer - evader) / gain if gain > 0 else None,
        "largest_capture_distance": largest if np.isfinite(largest) else None,
        "margin_mm": 1000 * (largest - float(kept.capture_distance)) if np.isfinite(largest) else None,
        "escapes": bool(game.evader_can_escape),
        "period_ms": 1000 * float(scenario.control_period),
    }


def _configuration(run: Run) -> dict[str, Any]:
    return {
        "name": f"{style.shield_words(run.shield)}, seed {run.seed}",
        "run": {
            key: shown_value(run.config.get(key))
            for key in ("shield", "pursuer", "seed", "episodes", "version")
        }
        | {"seconds of training": shown_number(run.summary.get("wall_seconds"), 0)}
        | {"control periods simulated": shown_number(run.summary.get("env_steps"), 0)},
        "scenario": {key: shown_value(value) for key, value in run.config["scenario"].items()},
        "learner": {key: shown_value(value) for key, value in run.config.get("learner", {}).items()},
    }
