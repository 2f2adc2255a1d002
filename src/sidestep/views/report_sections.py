"""The sections of a report that show episodes: figures and texts."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import zip_longest
from pathlib import Path
from typing import Any

import numpy as np

from sidestep.loop import Trajectory
from sidestep.safety import Status
from sidestep.trials import Capture, InterventionMap, explain_capture
from sidestep.views.capture_figure import capture_figure
from sidestep.views.clearance_figure import clearance_figure
from sidestep.views.html import data_uri, shown_number
from sidestep.views.intervention_figure import intervention_figure
from sidestep.views.replay import AFTER, BEFORE, episodes_for_page, player
from sidestep.views.report_tables import percent
from sidestep.views.runs import Run
from sidestep.views.style import OUTCOME_WORDS, shield_words
from sidestep.views.trajectory_figures import trajectory_figure
from sidestep.world import Scenario

_MOST_REPLAYS = 4
"""Number of replayed episodes per shield."""
_CAUSE_WORDS = {
    "reversing": "the pursuer drove backwards, which the row takes for leaving",
    "head-on": "the pursuer came straight on, and no velocity satisfied the row",
    "other": "neither",
}


def first_of(groups: Mapping[str, Sequence[Run]], field: str) -> dict[str, tuple[Run, Any]]:
    """Per shield, the first run that has this field, and the field's value."""
    found = {}
    for shield, group in groups.items():
        for run in group:
            if getattr(run, field) is not None:
                found[shield] = (run, getattr(run, field))
                break
    return found


def embedded(written: tuple[Path, Path]) -> str:
    """A PNG as a data URI."""
    return data_uri(written[0])


def scene_section(scenario: Scenario, shield: str, scene: Trajectory, folder: Path) -> dict[str, Any]:
    """The test scene with one shield: figure, outcome and least clearances."""
    written = trajectory_figure(
        scenario, scene, folder / f"test-scene-{shield}", shield=shield, title="Paths, marked in seconds"
    )
    corrected = float(np.mean(np.asarray(scene.status) != Status.OK)) if scene.length else 0.0
    facts = [
        f"The shield changed the velocity in {percent(corrected)} of the control periods, on average over "
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
        "figure": embedded(written),
        "outcome": OUTCOME_WORDS[scene.outcome],
        "seconds": scene.length * float(scenario.control_period),
        "facts": facts,
    }


def clearance_section(
    groups: Mapping[str, Sequence[Run]], scenario: Scenario, folder: Path
) -> dict[str, Any] | None:
    """Clearance histograms of the evaluation's episodes, or of the training's if there is no evaluation."""
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
        "figure": embedded(written),
        "surveyed": surveyed,
        "episodes": {shield: len(pair[0]) for shield, pair in clearances.items()},
    }


def map_section(
    groups: Mapping[str, Sequence[Run]], scenario: Scenario, folder: Path
) -> dict[str, Any] | None:
    """Maps of interventions over the evaluation's episodes; None if there were no interventions."""
    maps: dict[str, InterventionMap] = {}
    episodes: dict[str, int] = {}
    for shield, group in groups.items():
        for run in group:
            if run.survey is None or run.survey.evaluation.map is None:
                continue
            found = run.survey.evaluation.map
            # The maps of runs with other capture distances cover another region.
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
        "figure": embedded(intervention_figure(scenario, maps, folder / "interventions")),
        "episodes": {shield: episodes[shield] for shield in maps},
        "periods": {shield: int(one.periods.sum()) + one.outside for shield, one in maps.items()},
        "outside": {shield: one.outside for shield, one in maps.items()},
        "reach": next(iter(maps.values())).reach,
    }


def replay_section(groups: Mapping[str, Sequence[Run]]) -> dict[str, Any] | None:
    """The worst episodes of each shield, alternately from its runs, for the player."""
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


def capture_section(groups: Mapping[str, Sequence[Run]], folder: Path) -> dict[str, Any] | None:
    """One capture under the paper's shield, and the causes of all its captures, if known."""
    found = first_of({shield: group for shield, group in groups.items() if shield == "paper"}, "capture")
    if not found:
        return None
    run, trajectory = found["paper"]
    scenario = run.scenario
    capture: Capture = explain_capture(scenario, trajectory)
    evaluation = run.evaluation or {}
    causes = {name: count for name, count in evaluation.get("capture_causes", {}).items() if count}
    return {
        "figure": embedded(capture_figure(scenario, trajectory, folder / "capture")),
        "cause": capture.cause,
        "late": capture.decisive_period * float(scenario.control_period),
        "seconds": trajectory.length * float(scenario.control_period),
        "barrier_then": float(capture.range_barrier[capture.decisive_period]),
        "asked_last": float(capture.expected[-1]),
        "needed_last": float(capture.needed[-1]),
        "causes": {_CAUSE_WORDS.get(name, name): count for name, count in causes.items()},
        "examined": sum(causes.values()),
    }
