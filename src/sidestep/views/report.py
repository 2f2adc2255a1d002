"""The report of one or several runs: one HTML file that needs nothing else."""

from __future__ import annotations

import importlib.metadata
import platform
from collections.abc import Mapping, Sequence
from itertools import zip_longest
from pathlib import Path
from typing import Any

import numpy as np
from jinja2 import Environment, PackageLoader, StrictUndefined

import sidestep
from sidestep.learning.records import converged_episode, write_bytes
from sidestep.pursuit import CaptureGame
from sidestep.safety import Status
from sidestep.trials import Capture, InterventionMap, Trajectory, explain_capture
from sidestep.views.capture_figure import capture_figure
from sidestep.views.clearance_figure import clearance_figure
from sidestep.views.html import data_uri, shown_number, shown_value
from sidestep.views.intervention_figure import intervention_figure
from sidestep.views.pooling import pooled_evaluation
from sidestep.views.replay import AFTER, BEFORE, episodes_for_page, player
from sidestep.views.runs import Run, by_shield, load_run
from sidestep.views.scene import guarded
from sidestep.views.style import COLUMN, OUTCOME_WORDS, shield_colour, shield_words
from sidestep.views.training_figures import (
    PAPER_CONVERGED,
    outcome_figure,
    reward_figure,
    safety_rows,
    safety_table,
    shows_episodes,
)
from sidestep.views.trajectory_figures import scenes_figure, trajectory_figure
from sidestep.world import Scenario

_PACKAGES = ("jax", "equinox", "optax", "numpy", "matplotlib")
_MOST_REPLAYS = 4
"""Episodes to replay per shield."""
_CAUSE_WORDS = {
    "reversing": "the pursuer drove backwards, which the row takes for leaving",
    "head-on": "the pursuer came straight on, and no velocity satisfied the row",
    "other": "neither",
}


def write_report(
    runs: Sequence[Run | str | Path],
    path: str | Path,
    *,
    figures: str | Path | None = None,
    command: str | None = None,
) -> Path:
    """Draw the figures of these runs and write the report.

    **Arguments:** `runs` run folders, or `Run`s; several seeds of a shield are pooled, and its test scene and
    capture are those of its first run that has one. `path` the HTML file; `figures` the folder for the
    figures as PNG and PDF (`figures` beside `path` if not given); `command` what to type to run it again.

    **Raises** `ValueError` without a run, `RunError` for a folder that holds none.
    """
    if not runs:
        raise ValueError("a report needs at least one run")
    loaded = [run if isinstance(run, Run) else load_run(run) for run in runs]
    path = Path(path)
    folder = path.parent / "figures" if figures is None else Path(figures)
    safety_table(loaded, folder / "safety")
    content = _content(loaded, folder) | {"command": command}
    environment = Environment(
        loader=PackageLoader("sidestep.views"), autoescape=True, undefined=StrictUndefined, trim_blocks=True,
        lstrip_blocks=True,
    )  # fmt: skip
    html = environment.get_template("report.html").render(content)
    path.parent.mkdir(parents=True, exist_ok=True)
    write_bytes(path, html.encode())
    return path


def _content(runs: Sequence[Run], folder: Path) -> dict[str, Any]:
    groups = by_shield(runs)
    first = runs[0]
    scenario = first.scenario
    evaluations = _pooled_evaluations(groups, "evaluation")
    untrained = _pooled_evaluations(groups, "untrained_evaluation")
    untrained_scenes = {shield: scene for shield, (_, scene) in _first_of(groups, "untrained_scene").items()}
    scenes = _first_of(groups, "scene")
    return {
        "title": f"{scenario.name} scenario: " + ", ".join(shield_words(shield) for shield in groups),
        "version": first.config.get("version", sidestep.__version__),
        "versions": {name: importlib.metadata.version(name) for name in _PACKAGES},
        "python": platform.python_version(),
        "pursuers": sorted({str(run.config.get("pursuer", "?")) for run in runs}),
        "seeds": sorted({run.seed for run in runs}),
        "cards": [_card(shield, group, scenes) for shield, group in groups.items()],
        "comparison": _comparison(
            groups, {shield: scene for shield, (_, scene) in scenes.items()}, untrained_scenes
        ),
        "reward": _reward(runs, folder),
        "shows_episodes": shows_episodes(runs),
        "several_runs": any(len(group) > 1 for group in groups.values()),
        "evaluations": evaluations,
        "untrained": untrained,
        "untrained_scenes": _figure(
            scenes_figure(scenario, untrained_scenes, folder / "test-scene-untrained")
        )
        if untrained_scenes
        else None,
        "outcomes": _figure(outcome_figure(evaluations, folder / "outcomes", untrained))
        if evaluations
        else None,
        "scenes": [_scene(run.scenario, shield, scene, folder) for shield, (run, scene) in scenes.items()],
        "clearances": _clearance_section(groups, scenario, folder),
        "map": _map_section(groups, scenario, folder),
        "replay": _replay_section(groups),
        "differences": _differences(runs),
        "capture": _capture_section(groups, folder),
        "game": _game_numbers(scenario),
        "joint": "joint" in groups,
        "configurations": [_configuration(run) for run in runs],
        "outcome_words": OUTCOME_WORDS,
        "shield_words": shield_words,
        "colour": shield_colour,
        "percent": _percent,
        "number": shown_number,
        "paper_converged": PAPER_CONVERGED,
    }


def _pooled_evaluations(groups: Mapping[str, Sequence[Run]], field: str) -> dict[str, dict[str, Any]]:
    """By shield, the evaluations of its runs as one, where there are any."""
    found = {shield: [getattr(run, field) for run in group] for shield, group in groups.items()}
    measured = {shield: [one for one in many if one is not None] for shield, many in found.items()}
    return {shield: pooled_evaluation(many) for shield, many in measured.items() if many}


def _first_of(groups: Mapping[str, Sequence[Run]], field: str) -> dict[str, tuple[Run, Any]]:
    """By shield, the first run that has this field, and the field."""
    found = {}
    for shield, group in groups.items():
        for run in group:
            if getattr(run, field) is not None:
                found[shield] = (run, getattr(run, field))
                break
    return found


def _figure(written: tuple[Path, Path]) -> str:
    """A PNG as a data URI."""
    return data_uri(written[0])


def _reward(runs: Sequence[Run], folder: Path) -> str:
    """The page's reward figure; beside it, the same for one column of a paper."""
    reward_figure(runs, folder / "reward-column", width=COLUMN)
    return _figure(reward_figure(runs, folder / "reward"))


def _percent(value: float | int | None, digits: int = 1) -> str:
    return "–" if value is None else f"{100 * value:.{digits}f}\u00a0%"


def _convergence(group: Sequence[Run]) -> str:
    """Where a shield's runs converged, in words."""
    episodes = [converged_episode([float(e["return"]) for e in run.metrics]) for run in group]
    found = sorted(episode for episode in episodes if episode is not None)
    if len(group) == 1:
        return f"episode {found[0]}" if found else "never"
    return f"{len(found)} of {len(group)} seeds" + (f", at {', '.join(map(str, found))}" if found else "")


def _card(shield: str, group: Sequence[Run], scenes: Mapping[str, tuple[Run, Trajectory]]) -> dict[str, Any]:
    row = next(row for row in safety_rows(group) if row["shield"] == shield)
    scene = scenes.get(shield)
    return {
        "shield": shield,
        "safe": row["safe"],
        "episodes": row["episodes"],
        "captured": row["captured"],
        "collided": row["collided"],
        "converged": _convergence(group),
        "scene": OUTCOME_WORDS[scene[1].outcome] if scene else None,
    }


def _pooled(group: Sequence[Run], key: str) -> list[float]:
    return [float(episode[key]) for run in group for episode in run.metrics if episode.get(key) is not None]


def _comparison(
    groups: Mapping[str, Sequence[Run]],
    scenes: Mapping[str, Trajectory],
    untrained_scenes: Mapping[str, Trajectory],
) -> dict[str, Any]:
    """The paper's figures beside ours: names of the columns, and rows of cells."""
    safety = {row["shield"]: row for row in safety_rows([run for group in groups.values() for run in group])}
    paper = safety.pop(None)
    rows: list[tuple[str, list[str]]] = [
        ("training episodes", [str(paper["episodes"]), *(str(row["episodes"]) for row in safety.values())]),
        ("safe episodes", [str(paper["safe"]), *(str(row["safe"]) for row in safety.values())]),
        *((name, ["0", *(str(row[name]) for row in safety.values())]) for name in ("captured", "collided")),
        ("safety ratio", [_percent(row["ratio"]) for row in (paper, *safety.values())]),
        (
            "its 95 % bounds",
            [f"{_percent(row['low'])[:-2]} to {_percent(row['high'])}" for row in (paper, *safety.values())],
        ),
        ("converged", [f"within {PAPER_CONVERGED} episodes", *(_convergence(g) for g in groups.values())]),
    ]

    def add(name: str, reported: str, cells: Sequence[str]) -> None:
        rows.append((name, [reported, *cells]))

    finals = [
        np.mean([r for run in g for r in _pooled([run], "return")[-20:]] or [np.nan]) for g in groups.values()
    ]
    add(
        "mean return of the last 20",
        "1000",
        [shown_number(None if np.isnan(f) else float(f), 0) for f in finals],
    )
    steps = [sum(_pooled(group, "steps")) for group in groups.values()]
    for key, name in (("interventions", "periods corrected"), ("infeasible", "periods infeasible")):
        shares = [
            sum(_pooled(g, key)) / s if s else None for g, s in zip(groups.values(), steps, strict=True)
        ]
        add(name, "–", [_percent(share) for share in shares])
    corrections = [
        sum(float(e["mean_correction"]) * int(e["steps"]) for run in group for e in run.metrics) / periods
        if periods
        else None
        for group, periods in zip(groups.values(), steps, strict=True)
    ]
    add("mean correction", "–", [shown_number(value, 4, " m/s") for value in corrections])
    closest = [min(_pooled(group, "min_pursuer_clearance"), default=None) for group in groups.values()]
    add("closest to capture", "–", [shown_number(value, 4, " m") for value in closest])
    for policy, found, reported in (
        ("learned policy", scenes, "reached the target"),
        ("straight for the target", untrained_scenes, "–"),
    ):
        ends = [OUTCOME_WORDS[found[shield].outcome] if shield in found else "not run" for shield in groups]
        add(f"test scene, {policy}", reported, ends)
    return {"columns": ["the paper reports", *(shield_words(shield) for shield in groups)], "rows": rows}


def _scene(scenario: Scenario, shield: str, scene: Trajectory, folder: Path) -> dict[str, Any]:
    written = trajectory_figure(
        scenario, scene, folder / f"test-scene-{shield}", shield=shield, title="Paths, marked in seconds"
    )
    corrected = float(np.mean(np.asarray(scene.status) != Status.OK)) if scene.length else 0.0
    facts = [
        f"The shield changed the velocity in {_percent(corrected)} of the control periods, on average over "
        f"all of them by {shown_number(float(np.mean(np.asarray(scene.intervention))), 4, ' m/s')}."
        if corrected
        else "The shield never changed the velocity."
    ]
    clearances = (("capture", scene.events.pursuer_clearance), ("collision", scene.events.obstacle_clearance))
    for event, clearance in clearances:
        least = float(np.min(np.asarray(clearance)))
        if 0.0 < least < np.inf:
            spare = shown_number(1000 * least, 1, " mm") if least < 0.05 else shown_number(least, 2, " m")
            facts.append(f"Closest to {event}: {spare} to spare.")
    return {
        "shield": shield,
        "figure": _figure(written),
        "outcome": OUTCOME_WORDS[scene.outcome],
        "seconds": scene.length * float(scenario.control_period),
        "facts": facts,
    }


def _clearance_section(
    groups: Mapping[str, Sequence[Run]], scenario: Scenario, folder: Path
) -> dict[str, Any] | None:
    """Histograms of the episodes after training, or of those in training where a run has no others."""
    surveyed = all(run.survey is not None for group in groups.values() for run in group)

    def of(run: Run, hazard: str) -> np.ndarray:
        if surveyed and run.survey is not None:
            return np.asarray(getattr(run.survey.evaluation, f"min_{hazard}_clearance"))
        values = [episode.get(f"min_{hazard}_clearance") for episode in run.metrics]
        return np.array([np.inf if value is None else float(value) for value in values])

    clearances = {
        shield: (
            np.concatenate([of(run, "pursuer") for run in group]),
            np.concatenate([of(run, "obstacle") for run in group]),
        )
        for shield, group in groups.items()
    }
    if not any(np.any(np.isfinite(values)) for pair in clearances.values() for values in pair):
        return None
    written = clearance_figure(
        clearances,
        folder / "clearances",
        capture_distance=float(scenario.capture_distance),
        collision_distance=float(scenario.collision_distance),
    )
    return {
        "figure": _figure(written),
        "surveyed": surveyed,
        "episodes": {shield: len(pair[0]) for shield, pair in clearances.items()},
    }


def _map_section(
    groups: Mapping[str, Sequence[Run]], scenario: Scenario, folder: Path
) -> dict[str, Any] | None:
    """Where each shield stepped in, over the episodes after training; None without a shield that did."""
    maps: dict[str, InterventionMap] = {}
    episodes: dict[str, int] = {}
    for shield, group in groups.items():
        for run in group:
            if run.survey is None or run.survey.evaluation.map is None:
                continue
            found = run.survey.evaluation.map
            # Runs with other capture distances have maps of another region.
            if shield not in maps:
                maps[shield] = found
            elif maps[shield].reach == found.reach:
                maps[shield] += found
            else:
                continue
            episodes[shield] = episodes.get(shield, 0) + run.survey.evaluation.episodes
    maps = {shield: one for shield, one in maps.items() if one.corrected.any()}
    if not maps:
        return None
    return {
        "figure": _figure(intervention_figure(scenario, maps, folder / "interventions")),
        "episodes": {shield: episodes[shield] for shield in maps},
        "periods": {shield: int(one.periods.sum()) + one.outside for shield, one in maps.items()},
        "outside": {shield: one.outside for shield, one in maps.items()},
        "reach": next(iter(maps.values())).reach,
    }


def _replay_section(groups: Mapping[str, Sequence[Run]]) -> dict[str, Any] | None:
    """The worst episodes of each shield, by turns from its runs, for the player."""
    shown: list[dict[str, Any]] = []
    for shield, group in groups.items():
        turns = zip_longest(*[run.survey.worst if run.survey else () for run in group])
        pairs = [
            (run, one) for turn in turns for run, one in zip(group, turn, strict=True) if one is not None
        ]
        for run, episode in pairs[:_MOST_REPLAYS]:
            words = shield_words(shield) + (f", seed {run.seed}" if len(group) > 1 else "")
            for packed in episodes_for_page(run.scenario, shield, [episode]):
                shown.append(packed | {"group": words[:1].upper() + words[1:]})
    if not shown:
        return None
    shown.sort(key=lambda episode: list(groups).index(episode["shield"]))
    return {**player(shown), "before": BEFORE, "after": AFTER, "cut": any(one["cut"] for one in shown)}


def _differences(runs: Sequence[Run]) -> list[tuple[str, list[str]]]:
    """Scenario fields in which these runs differ, with their values: their figures are then of two worlds."""
    scenarios = [run.config["scenario"] for run in runs]
    fields = {name for scenario in scenarios for name in scenario if name != "name"}
    found = []
    for name in sorted(fields):
        values = list(dict.fromkeys(shown_value(scenario.get(name)) for scenario in scenarios))
        if len(values) > 1:
            found.append((name.replace("_", " "), values))
    return found


def _capture_section(groups: Mapping[str, Sequence[Run]], folder: Path) -> dict[str, Any] | None:
    """One capture under the paper's shield, and how all of its captures came about, if known."""
    found = _first_of({shield: group for shield, group in groups.items() if shield == "paper"}, "capture")
    if not found:
        return None
    run, trajectory = found["paper"]
    scenario = run.scenario
    capture: Capture = explain_capture(scenario, trajectory)
    evaluation = run.evaluation or {}
    causes = {name: count for name, count in evaluation.get("capture_causes", {}).items() if count}
    return {
        "figure": _figure(capture_figure(scenario, trajectory, folder / "capture")),
        "cause": capture.cause,
        "late": capture.decisive_period * float(scenario.control_period),
        "seconds": trajectory.length * float(scenario.control_period),
        "barrier_then": float(capture.range_barrier[capture.decisive_period]),
        "asked_last": float(capture.expected[-1]),
        "needed_last": float(capture.needed[-1]),
        "causes": {_CAUSE_WORDS.get(name, name): count for name, count in causes.items()},
        "examined": sum(causes.values()),
    }


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
        "name": f"{shield_words(run.shield)}, seed {run.seed}",
        "run": {
            key: shown_value(run.config.get(key))
            for key in ("shield", "pursuer", "seed", "episodes", "version")
        }
        | {"seconds of training": shown_number(run.summary.get("wall_seconds"), 0)}
        | {"control periods simulated": shown_number(run.summary.get("env_steps"), 0)},
        "scenario": {key: shown_value(value) for key, value in run.config["scenario"].items()},
        "learner": {key: shown_value(value) for key, value in run.config.get("learner", {}).items()},
    }
