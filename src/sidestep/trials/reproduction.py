"""The paper's experiment as one study: train, measure and test under several shields."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

import sidestep
from sidestep._arrays import seed_number, whole_number
from sidestep.learning import TrainingOptions, load_policy, make_options, options_to_dict, train
from sidestep.loop.keys import evaluation_seed
from sidestep.loop.policies import GOAL_SEEKING
from sidestep.loop.rollout import Trajectory, load_trajectory, rollout, save_trajectory
from sidestep.pursuit import make_pursuer
from sidestep.safety import Status, make_shield
from sidestep.store import runs as records
from sidestep.store.files import json_safe, read_json, write_json
from sidestep.trials.captures import examine_captures
from sidestep.trials.monte_carlo import Hook, evaluate, quiet
from sidestep.trials.survey import save_survey, take_survey
from sidestep.world import Scenario, load_scenario, scenario_to_dict

PAPER: dict[str, Any] = {
    "training": {
        "episodes": 200,
        "safe_episodes": 200,
        "captured": 0,
        "collided": 0,
        "converged_episode": 80,
        "final_return": 1000.0,
    },
    "scene_trained": {"outcome": "reached"},
}
"""The paper's results (section IV and Table I), under the names used here."""

COMPARED = ("none", "paper", "game", "joint")
"""Shields that are compared unless others are named. A newly registered one is not."""


@dataclass(frozen=True)
class ShieldStudy:
    """The results for one shield. Evaluations are `Evaluation.to_dict()`."""

    shield: str
    folder: Path
    training: dict[str, Any]
    trained: dict[str, Any]
    untrained: dict[str, Any]
    scene_trained: Trajectory
    scene_untrained: Trajectory

    def to_dict(self) -> dict[str, Any]:
        """Plain JSON values."""
        return {
            "training": self.training,
            "trained": self.trained,
            "untrained": self.untrained,
            "scene_trained": describe(self.scene_trained),
            "scene_untrained": describe(self.scene_untrained),
        }


def describe(trajectory: Trajectory) -> dict[str, Any]:
    """A summary of a recorded episode: outcome, time (s), clearances (m), corrections (m/s)."""
    events, status = trajectory.events, np.asarray(trajectory.status)
    return json_safe(
        {
            "outcome": trajectory.outcome,
            # The time of the first period is exact; later times have accumulated rounding errors.
            "seconds": round(trajectory.length * float(trajectory.worlds.time[1]), 4),
            "return": float(events.reward.sum()),
            "min_pursuer_clearance": float(events.pursuer_clearance.min()),
            "min_obstacle_clearance": float(events.obstacle_clearance.min()),
            "intervention_rate": float(np.mean(status != Status.OK)),
            "infeasible_rate": float(np.mean(status == Status.INFEASIBLE)),
            "invalid_rate": float(np.mean(status == Status.INVALID)),
            "mean_correction": float(trajectory.intervention.mean()),
            "pursuer_invalid": trajectory.pursuer_invalid,
        }
    )


def test_scene_of(scenario: Scenario) -> Scenario:
    """The paper's fixed test scene with the constants of `scenario`."""
    scene = scenario_to_dict(load_scenario("paper-test"))
    starts = {
        name: scene[name] for name in ("evader_start", "pursuer_starts", "obstacle_starts", "target_start")
    }
    return load_scenario("paper-test", **{**scenario_to_dict(scenario), **starts, "name": "paper-test"})


test_scene_of.__test__ = False  # type: ignore[attr-defined]


def _measured(path: Path, run: Callable[[], dict[str, Any]]) -> dict[str, Any]:
    if not path.exists():
        write_json(path, run())
    return read_json(path)


def _recorded(path: Path, run: Callable[[], Trajectory]) -> Trajectory:
    if not path.exists():
        save_trajectory(path, run())
    return load_trajectory(path)


def study_settings(folder: str | Path) -> dict[str, Any]:
    """The arguments with which `reproduce` continues the study in `folder`.

    **Raises** `RunError` when the folder holds no study.
    """
    config = records.open_run(folder, "study")
    return {
        "scenario": load_scenario("paper", **config["scenario"]),
        "shields": tuple(config["study"]),
        "options": make_options(**config["learner"]),
        **{name: config[name] for name in ("pursuer", "seed", "episodes", "evaluation_episodes")},
    }


def reproduce(
    out: str | Path,
    *,
    scenario: Scenario | None = None,
    shields: Sequence[str] = COMPARED,
    pursuer: str = "nash",
    seed: int = 0,
    episodes: int = 200,
    evaluation_episodes: int = 1000,
    options: TrainingOptions | None = None,
    resume: bool = False,
    training_progress: Hook = quiet,
    count_progress: Hook = quiet,
) -> list[ShieldStudy]:
    """Train under each shield, measure the trained and the untrained policy, run the paper's test scene.

    Writes one run folder per shield in `out`, and `summary.json` with all results. Finished parts are kept,
    so `resume` continues an interrupted study with its stored settings (`study_settings` reads them). Test
    starts use another key than training starts. `out` and the run folders are locked until the last file is
    written.

    **Raises** `RunError` when `out` is occupied and `resume` is not set, or its study has other settings;
    `FolderInUseError` when another process writes in it or in one of its run folders; `ValueError` for
    invalid arguments; `KeyboardInterrupt` when interrupted.
    """
    scenario = load_scenario("paper") if scenario is None else scenario
    options = make_options() if options is None else options
    seed_number(seed)
    whole_number("episodes", episodes)
    whole_number("evaluation_episodes", evaluation_episodes)
    make_pursuer(pursuer)
    for shield in shields:
        make_shield(shield, scenario)
    if not shields or len(set(shields)) != len(shields):
        raise ValueError(f"shields = {tuple(shields)!r}: name each shield once, and at least one")
    scene = test_scene_of(scenario)
    out = Path(out)
    config = {
        "study": list(shields),
        "scenario": scenario_to_dict(scenario),
        "learner": options_to_dict(options),
        "pursuer": pursuer,
        "seed": seed,
        "episodes": episodes,
        "evaluation_episodes": evaluation_episodes,
        "version": sidestep.__version__,
    }
    resume = resume and (out / "config.json").exists()
    with records.writing(out, *shields, resume=resume):
        return _run(out, config, scenario, scene, options, resume, training_progress, count_progress)


def _run(
    out: Path,
    config: dict[str, Any],
    scenario: Scenario,
    scene: Scenario,
    options: TrainingOptions,
    resume: bool,
    training_progress: Hook,
    count_progress: Hook,
) -> list[ShieldStudy]:
    """The study, with its folders locked."""
    shields, pursuer, seed = config["study"], config["pursuer"], config["seed"]
    episodes, evaluation_episodes = config["episodes"], config["evaluation_episodes"]
    if resume:
        names = [name for name in config if name != "version"]
        records.refuse_changes(out, records.open_run(out, "study"), config, names)
    else:
        records.create_run(out, config)

    evaluation_key = evaluation_seed(seed)
    studies = []
    for shield in shields:
        folder = out / shield
        if not (folder / "policy.npz").exists():
            begun = (folder / "config.json").exists()
            with training_progress(shield) as show:
                training = train(
                    scenario, shield=shield, pursuer=pursuer, seed=seed, episodes=episodes, options=options,
                    out=folder, resume=begun, progress=show,
                )  # fmt: skip
            if training.interrupted:
                raise KeyboardInterrupt
        else:
            # A run that was trained further by itself is no longer comparable with the others.
            records.refuse_changes(folder, records.open_run(folder), config, ("episodes",))
        policy = load_policy(folder)

        def measure(policy: Any, label: str, shield: str = shield, folder: Path = folder) -> dict[str, Any]:
            with count_progress(f"{shield} shield, {label}") as show:
                if policy is GOAL_SEEKING:
                    return evaluate(
                        scenario, policy, shield, pursuer, evaluation_episodes, evaluation_key, progress=show
                    ).to_dict()
                survey = take_survey(
                    scenario, policy, shield, pursuer, evaluation_episodes, evaluation_key, progress=show
                )
            save_survey(folder, survey)
            figures = survey.evaluation.to_dict()
            causes, example = examine_captures(
                scenario, policy, shield, pursuer, survey.evaluation, evaluation_key
            )
            figures["capture_causes"] = causes
            if example is not None:
                save_trajectory(folder / "capture.npz", example)
            return figures

        def play(policy: Any, shield: str = shield) -> Trajectory:
            return rollout(scene, policy, shield, pursuer, seed)

        studies.append(
            ShieldStudy(
                shield=shield,
                folder=folder,
                training=records.read_summary(folder),
                trained=_measured(folder / "evaluation.json", lambda p=policy: measure(p, "trained policy")),
                untrained=_measured(
                    folder / "evaluation_untrained.json", lambda: measure(GOAL_SEEKING, "goal-seeking policy")
                ),
                scene_trained=_recorded(folder / "test_scene.npz", lambda p=policy: play(p)),
                scene_untrained=_recorded(folder / "test_scene_untrained.npz", lambda: play(GOAL_SEEKING)),
            )
        )
    records.write_summary(
        out, {**config, "paper": PAPER, "shields": {study.shield: study.to_dict() for study in studies}}
    )
    return studies
