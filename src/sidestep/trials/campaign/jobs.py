"""One job of a campaign: its settings, and how it is run."""

from __future__ import annotations

import hashlib
import importlib.metadata
import json
import os
import platform
import socket
import time
from collections.abc import Mapping
from contextlib import nullcontext
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from sidestep.store.files import json_safe
from sidestep.store.lock import hold
from sidestep.store.runs import summarise

KINDS = ("evaluate", "train")
AXES = ("scenario", "shield", "pursuer", "policy", "learner", "seed")
"""The possible axes of a grid; the last one varies fastest."""

_FORMAT = 1
_VERSIONED = ("sidestep", "jax", "jaxlib", "equinox", "optax", "numpy")


@dataclass(frozen=True)
class Task:
    """A job as sent to a worker: plain values only.

    **Attributes:** `job` the identity; `settings` everything that determines the result; `policy` the file of
    the policy to measure, None for the untrained policy.
    """

    job: str
    settings: dict[str, Any]
    policy: str | None = None


@dataclass(frozen=True)
class Job:
    """One combination of a grid. `labels` are its names in the file, per axis; they do not affect the
    result."""

    labels: dict[str, Any]
    settings: dict[str, Any]
    policy: str | None = None
    id: str = field(init=False)

    def __post_init__(self) -> None:
        object.__setattr__(self, "id", identity(self.settings))

    @property
    def task(self) -> Task:
        """The job as sent to a worker."""
        return Task(self.id, self.settings, self.policy)


def identity(settings: Mapping[str, Any]) -> str:
    """20 hexadecimal digits of SHA-256 over the settings: equal settings give the same job on any machine."""
    text = json.dumps({"format": _FORMAT, **settings}, sort_keys=True, allow_nan=False)
    return hashlib.sha256(text.encode()).hexdigest()[:20]


def digest_of_file(path: str | Path) -> str:
    """SHA-256 of a file's content, in hexadecimal digits."""
    return hashlib.sha256(Path(path).read_bytes()).hexdigest()


def versions() -> dict[str, str]:
    """The versions of Python and of the numerical packages."""
    import sidestep

    found = {"python": platform.python_version()}
    for name in _VERSIONED:
        try:
            found[name] = importlib.metadata.version(name)
        except importlib.metadata.PackageNotFoundError:
            continue
    # A source folder on the path has no metadata.
    return found | {"sidestep": sidestep.__version__}


def flat(figures: Mapping[str, Any]) -> dict[str, Any]:
    """Figures with nested tables flattened: one figure per entry, `NAME_ENTRY`."""
    found: dict[str, Any] = {}
    for name, value in figures.items():
        if isinstance(value, Mapping):
            found |= {f"{name}_{key}": item for key, item in flat(value).items()}
        else:
            found[name] = value
    return found


def figure_names(kind: str) -> list[str]:
    """The names of the figures of a job of this kind."""
    from sidestep.trials.evaluation import Evaluation

    whole, real = np.zeros(1, np.int32), np.zeros(1)
    counts = Evaluation(whole, real, whole + 1, real, real, real, whole, whole, whole, real, real)
    names = list(flat(counts.to_dict()))
    if kind == "train":
        names += [f"training_{name}" for name in summarise([], wall_seconds=0.0)]
    return names


def run_task(task: Task, folder: Path | None) -> dict[str, Any]:
    """Run a job and return its record, as JSON values.

    **Arguments:** `folder` for the run folder of a training; an interrupted training in it is resumed. With
    None only the figures are kept.

    **Raises** what the job raises; `ValueError` when the policy's file has changed.
    """
    return _RUN[task.settings["kind"]](task, folder)


def record_of(task: Task, figures: Mapping[str, Any], seconds: float | int) -> dict[str, Any]:
    """The record of a job: settings, figures, host, time and versions."""
    return json_safe(
        {
            "job": task.job,
            "settings": task.settings,
            "figures": figures,
            "seconds": seconds,
            "ended": time.strftime("%Y-%m-%dT%H:%M:%SZ", time.gmtime()),
            "host": socket.gethostname(),
            "process": os.getpid(),
            "versions": versions(),
        }
    )


def _run_evaluate(task: Task, folder: Path | None) -> dict[str, Any]:
    from sidestep.learning import load_policy
    from sidestep.trials.monte_carlo import evaluate
    from sidestep.world import load_scenario

    settings = task.settings
    policy: Any = settings["policy"]
    if task.policy is not None:
        if digest_of_file(task.policy) != policy:
            raise ValueError(f"{task.policy} is no longer the policy with which this campaign began")
        policy = load_policy(task.policy)
    evaluation = evaluate(
        load_scenario("paper", **settings["scenario"]), policy, settings["shield"], settings["pursuer"],
        settings["episodes"], settings["seed"], batch=settings["batch"],
    )  # fmt: skip
    return evaluation.to_dict()


def _run_train(task: Task, folder: Path | None) -> dict[str, Any]:
    from sidestep.learning import make_options, train
    from sidestep.loop.keys import evaluation_seed
    from sidestep.trials.monte_carlo import evaluate
    from sidestep.world import load_scenario

    settings = task.settings
    scenario = load_scenario("paper", **settings["scenario"])
    # Another process may be training in the folder: the job waits for it, then continues.
    with nullcontext() if folder is None else hold(folder, wait=True):
        training = train(
            scenario, shield=settings["shield"], pursuer=settings["pursuer"], seed=settings["seed"],
            episodes=settings["episodes"], options=make_options(**settings["learner"]), out=folder,
            resume=folder is not None and (folder / "config.json").exists(),
        )  # fmt: skip
    if training.interrupted:
        raise KeyboardInterrupt
    evaluation = evaluate(
        scenario, training.policy, settings["shield"], settings["pursuer"], settings["evaluation_episodes"],
        evaluation_seed(settings["seed"]), batch=settings["batch"],
    )  # fmt: skip
    about = ("scenario", "shield", "pursuer", "seed", "version")
    training_figures = {
        f"training_{name}": value for name, value in training.summary.items() if name not in about
    }
    return {**evaluation.to_dict(), **training_figures}


_RUN = {"evaluate": _run_evaluate, "train": _run_train}
