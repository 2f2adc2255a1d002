"""A survey of a run: every episode's results, the map of interventions, and recordings of the worst
episodes."""

from __future__ import annotations

import dataclasses
import hashlib
import zipfile
from collections.abc import Callable
from dataclasses import dataclass
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np

from sidestep.learning import load_policy
from sidestep.loop.keys import episode_key, evaluation_seed
from sidestep.loop.rollout import Trajectory, load_trajectory, rollout, save_trajectory
from sidestep.store.files import read_json, write_bytes
from sidestep.store.runs import OUTCOMES, RunError, held_if_run, open_run
from sidestep.trials.evaluation import Evaluation
from sidestep.trials.intervention_map import InterventionMap
from sidestep.trials.monte_carlo import evaluate
from sidestep.world import Scenario, load_scenario

EPISODES_FILE = "episodes.npz"
WORST_FOLDER = "worst"
HAZARDS = ("capture", "collision")
_MAP = "map."


@dataclass(frozen=True)
class WorstEpisode:
    """One of the episodes with the least clearances.

    **Attributes:** `number` in the evaluation; `hazard`, the one of `HAZARDS` it was chosen for.
    """

    number: int
    hazard: str
    trajectory: Trajectory


@dataclass(frozen=True)
class Survey:
    """An evaluation and its worst episodes. `seed` is that of the evaluation: `episode_key(seed, i)` is the
    key of episode i."""

    evaluation: Evaluation
    seed: int
    worst: tuple[WorstEpisode, ...] = ()


def worst_numbers(evaluation: Evaluation) -> list[tuple[int, str]]:
    """All episode numbers, the worst first: alternately the next closest to capture and to collision.

    Hazards without such a robot are left out.
    """
    orders = [
        [(int(number), hazard) for number in np.argsort(clearances, kind="stable")]
        for hazard, clearances in (
            ("capture", evaluation.min_pursuer_clearance),
            ("collision", evaluation.min_obstacle_clearance),
        )
        if np.any(np.isfinite(clearances))
    ]
    found: dict[int, str] = {}
    for turn in zip(*orders, strict=True):
        for number, hazard in turn:
            found.setdefault(number, hazard)
    return list(found.items())


def record_worst(
    scenario: Scenario,
    policy: Any,
    shield: Any,
    pursuer: Any,
    evaluation: Evaluation,
    seed: int,
    *,
    most: int = 4,
) -> tuple[WorstEpisode, ...]:
    """Replay the `most` worst episodes of an evaluation.

    **Arguments:** those of the call of `evaluate`.
    """
    found = []
    # Rounding differs between a single episode and a batch, so a borderline episode may end differently.
    for number, hazard in worst_numbers(evaluation)[: 2 * most]:
        if len(found) == most:
            break
        trajectory = rollout(scenario, policy, shield, pursuer, episode_key(seed, number))
        if trajectory.outcome == OUTCOMES[evaluation.outcome[number]]:
            found.append(WorstEpisode(number, hazard, trajectory))
    return tuple(found)


def take_survey(
    scenario: Scenario,
    policy: Any,
    shield: Any,
    pursuer: Any,
    episodes: int,
    seed: int,
    *,
    progress: Callable[[int, int], None] | None = None,
) -> Survey:
    """Evaluate, and record the worst episodes. Arguments and errors are those of `evaluate`."""
    evaluation = evaluate(
        scenario, policy, shield, pursuer, episodes, seed, batch=min(episodes, 256), mapped=True,
        progress=progress,
    )  # fmt: skip
    return Survey(evaluation, seed, record_worst(scenario, policy, shield, pursuer, evaluation, seed))


def survey_run(
    folder: str | Path, episodes: int, *, progress: Callable[[int, int], None] | None = None
) -> Survey:
    """A survey of a run's policy, with the run's scenario, shield and pursuer.

    The episodes are the first ones of those on which `reproduce` measures a run with this seed.

    **Raises** `RunError` when the folder holds no run or no policy yet, `ValueError` when its shield or
    pursuer is a custom one.
    """
    config = open_run(folder)
    scenario = load_scenario("paper", **config["scenario"])
    policy = load_policy(folder)
    seed = evaluation_seed(int(config["seed"]))
    return take_survey(
        scenario, policy, config["shield"], config["pursuer"], episodes, seed, progress=progress
    )


def save_survey(folder: str | Path, survey: Survey) -> None:
    """Write `worst/` and then `episodes.npz` in a run folder, so that `episodes.npz` implies the rest.

    **Raises** `FolderInUseError` when another process writes there.
    """
    with held_if_run(folder):
        _save(Path(folder), survey)


def _save(folder: Path, survey: Survey) -> None:
    scenario, about = _scenario_and_about(folder)
    for episode in survey.worst:
        save_trajectory(_worst_path(folder, episode.number), episode.trajectory, scenario, about)
    arrays: dict[str, Any] = {
        entry.name: getattr(survey.evaluation, entry.name)
        for entry in dataclasses.fields(Evaluation)
        if entry.name != "map" and getattr(survey.evaluation, entry.name) is not None
    }
    if survey.evaluation.map is not None:
        arrays |= {_MAP + name: values for name, values in survey.evaluation.map.to_arrays().items()}
    arrays |= {
        "seed": np.asarray(survey.seed),
        "policy": np.asarray(_policy_digest(folder)),
        "worst_numbers": np.array([episode.number for episode in survey.worst], dtype=int),
        "worst_hazards": np.array([HAZARDS.index(episode.hazard) for episode in survey.worst], dtype=int),
    }
    buffer = BytesIO()
    np.savez_compressed(buffer, **arrays)
    write_bytes(folder / EPISODES_FILE, buffer.getvalue())


def load_survey(folder: str | Path) -> Survey | None:
    """Read a survey of `save_survey`; None if there is none, or if training has changed the policy since.

    **Raises** `RunError` when the file is damaged.
    """
    folder = Path(folder)
    path = folder / EPISODES_FILE
    if not path.is_file():
        return None
    try:
        with np.load(BytesIO(path.read_bytes()), allow_pickle=False) as archive:
            arrays = {name: archive[name] for name in archive.files}
        if str(arrays.pop("policy")) != _policy_digest(folder):
            return None
        where = {name.removeprefix(_MAP): arrays.pop(name) for name in list(arrays) if name.startswith(_MAP)}
        seed = int(arrays.pop("seed"))
        numbers, hazards = arrays.pop("worst_numbers"), arrays.pop("worst_hazards")
        if "time_limit" in arrays:
            arrays["time_limit"] = float(arrays["time_limit"])
        evaluation = Evaluation(**arrays, map=InterventionMap.from_arrays(where) if where else None)
        worst = tuple(
            WorstEpisode(int(number), HAZARDS[hazard], load_trajectory(_worst_path(folder, int(number))))
            for number, hazard in zip(numbers, hazards, strict=True)
            if _worst_path(folder, int(number)).is_file()
        )
    except (KeyError, TypeError, ValueError, EOFError, OSError, zipfile.BadZipFile) as error:
        raise RunError(
            f"{path} is not readable ({error}); delete it to have the episodes run again"
        ) from error
    return Survey(evaluation, seed, worst)


def _scenario_and_about(folder: Path) -> tuple[Scenario | None, dict[str, Any]]:
    """The scenario of a run folder, and the metadata of its recorded episodes."""
    if not (folder / "config.json").is_file():
        return None, {}
    config = read_json(folder / "config.json")
    about = {name: config[name] for name in ("shield", "pursuer") if name in config}
    return load_scenario("paper", **config["scenario"]), about


def _policy_digest(folder: Path) -> str:
    """The digest of a run folder's policy; empty if it has none."""
    path = folder / "policy.npz"
    return hashlib.sha256(path.read_bytes()).hexdigest() if path.is_file() else ""


def _worst_path(folder: Path, number: int) -> Path:
    return folder / WORST_FOLDER / f"episode-{number}.npz"
