"""Read a run folder for figures and reports, complete or not."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from sidestep.loop import Trajectory, load_trajectory
from sidestep.safety.shields.catalogue import SHIELDS
from sidestep.store.files import read_json
from sidestep.store.runs import RunError, read_metrics, summarise
from sidestep.trials import Survey, load_survey
from sidestep.world import Scenario, load_scenario

EVALUATION_FILE = "evaluation.json"
SCENE_FILE = "test_scene.npz"
CAPTURE_FILE = "capture.npz"
UNTRAINED_EVALUATION_FILE = "evaluation_untrained.json"
UNTRAINED_SCENE_FILE = "test_scene_untrained.npz"


@dataclass(frozen=True)
class Run:
    """One training run.

    **Attributes:** `config`, `metrics`, `summary` as on disk; `evaluation` after training, as
    `Evaluation.to_dict`; `scene` the paper's test scene with the trained policy; `capture` an example of a
    capture; `untrained_evaluation` and `untrained_scene` with the untrained policy `goal-seeking`; `survey`
    of the evaluation. All but `config` and `metrics` may be missing.
    """

    config: Mapping[str, Any]
    metrics: Sequence[Mapping[str, Any]]
    summary: Mapping[str, Any] = field(default_factory=dict)
    evaluation: Mapping[str, Any] | None = None
    scene: Trajectory | None = None
    capture: Trajectory | None = None
    untrained_evaluation: Mapping[str, Any] | None = None
    untrained_scene: Trajectory | None = None
    survey: Survey | None = None
    folder: Path | None = None

    @property
    def shield(self) -> str:
        """Name of the shield of the training."""
        return str(self.config.get("shield", "unknown"))

    @property
    def seed(self) -> int:
        """Its seed."""
        return int(self.config.get("seed", 0))

    @property
    def scenario(self) -> Scenario:
        """The scenario of the training."""
        return load_scenario("paper", **self.config["scenario"])


def load_run(folder: str | Path) -> Run:
    """Read a run folder. The summary of a running or stopped run is computed from its metrics.

    **Raises** `RunError` when `folder` holds no run.
    """
    folder = Path(folder)
    if not (folder / "config.json").is_file():
        raise RunError(f"{folder} holds no run (no config.json)")
    config, metrics = read_json(folder / "config.json"), read_metrics(folder)
    if (folder / "summary.json").is_file():
        summary = read_json(folder / "summary.json")
    else:
        about = {key: config.get(key) for key in ("scenario", "shield", "pursuer", "seed", "version")}
        summary = summarise(metrics, wall_seconds=float("nan"), **about)

    def figures(name: str) -> Any:
        return read_json(folder / name) if (folder / name).is_file() else None

    def episode(name: str) -> Trajectory | None:
        return load_trajectory(folder / name) if (folder / name).is_file() else None

    return Run(
        config=config,
        metrics=metrics,
        summary=summary,
        evaluation=figures(EVALUATION_FILE),
        scene=episode(SCENE_FILE),
        capture=episode(CAPTURE_FILE),
        untrained_evaluation=figures(UNTRAINED_EVALUATION_FILE),
        untrained_scene=episode(UNTRAINED_SCENE_FILE),
        survey=load_survey(folder),
        folder=folder,
    )


def by_shield(runs: Iterable[Run]) -> dict[str, list[Run]]:
    """The runs of each shield, weakest shield first, then in the order given."""
    order = list(SHIELDS)
    groups: dict[str, list[Run]] = {}
    for run in runs:
        groups.setdefault(run.shield, []).append(run)
    return dict(
        sorted(groups.items(), key=lambda item: order.index(item[0]) if item[0] in order else len(order))
    )
