"""Run a training: run folder, progress, checkpoints, interruption and resume."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from contextlib import nullcontext, suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from sidestep import _interrupts
from sidestep._arrays import seed_number, whole_number
from sidestep._version import __version__
from sidestep.learning.curves import Curves
from sidestep.learning.divergence import Diverged, check_networks, divergence
from sidestep.learning.options import TrainingOptions, make_options, options_to_dict
from sidestep.learning.players import EVADING, LearnedPursuer, Player, Pursuing
from sidestep.learning.policy import (
    LearnedPolicy,
    from_anywhere,
    load_policy,
    load_pursuer,
    load_trained,
    write_policy,
)
from sidestep.learning.td3 import Learner
from sidestep.learning.training import Report, TrainState, run_chunk, start
from sidestep.learning.variation import Variation
from sidestep.loop.episode import straight_times
from sidestep.loop.policies import GOAL_SEEKING
from sidestep.pursuit import as_pursuer
from sidestep.safety import as_shield
from sidestep.store import runs as records
from sidestep.store.checkpoints import list_checkpoints, read_checkpoint, read_part, write_checkpoint
from sidestep.store.files import OutputError, json_safe, write_json
from sidestep.world import Scenario, load_scenario, scenario_to_dict

CHUNK, CHUNK_OF_MANY = 100, 20
"""Decisions per compiled call, of one world and of each of many: some 0.5 s, so that progress and Ctrl-C
respond quickly."""


_SETTINGS = ("scenario", "learner", "shield", "pursuer", "seed", "warm_start", "against", "vary")


@dataclass(frozen=True)
class Progress:
    """The progress of a training. `last` is the newest episode's line of `metrics.jsonl`, if one has
    ended."""

    episode: int
    episodes: int
    safe: int
    env_steps: int
    steps_per_second: float
    mean_return: float
    last: dict[str, Any] | None


@dataclass(frozen=True)
class Training:
    """The result of a training: policy (or pursuer), `summary.json`, one entry per episode, the final state.

    `had_ended`: the training was resumed but had already ended.
    """

    policy: LearnedPolicy | LearnedPursuer
    summary: dict[str, Any]
    metrics: list[dict[str, Any]]
    state: TrainState
    interrupted: bool = False
    folder: Path | None = None
    chunk_seconds: list[tuple[int, float]] = field(default_factory=list)
    had_ended: bool = False


def _capacity(options: TrainingOptions, scenario: Scenario, episodes: int) -> int:
    # Every world begins an episode, and the last decision may end one in each.
    most = (episodes + 2 * options.worlds - 2) * -(-scenario.episode_steps // options.decision_steps)
    return max(1, min(options.replay_capacity, most))


def _name(thing: Any) -> str:
    if isinstance(thing, str):
        return thing
    return getattr(thing, "name", getattr(thing, "__name__", type(thing).__name__))


def _episode_lines(scenario: Scenario, report: Report, done: int) -> list[dict[str, Any]]:
    """The lines of `metrics.jsonl` for the episodes that ended in a chunk."""
    ended = np.nonzero(np.asarray(report.ended))
    tally = jax.tree.map(lambda leaf: np.asarray(leaf)[ended], report.tally)
    straight = straight_times(scenario, tally.distance, np.asarray(report.evader_speed)[ended])
    outcome, env_steps = np.asarray(report.outcome)[ended], np.asarray(report.env_steps)[ended[0]]
    return [
        json_safe(
            {
                "episode": done + i + 1,
                "outcome": records.OUTCOMES[outcome[i]],
                "return": tally.total_reward[i],
                "steps": tally.steps[i],
                "straight_time": straight[i],
                "env_steps": env_steps[i],
                "min_pursuer_clearance": tally.pursuer_clearance[i],
                "min_obstacle_clearance": tally.obstacle_clearance[i],
                "interventions": tally.interventions[i],
                "infeasible": tally.infeasible[i],
                "invalid": tally.invalid[i],
                "pursuer_invalid": tally.pursuer_invalid[i],
                "mean_correction": tally.correction[i] / tally.steps[i],
            }
        )
        for i in range(len(outcome))
    ]


def resume_settings(folder: str | Path) -> dict[str, Any]:
    """The arguments with which `train` continues a run: scenario, shield, pursuer, seed and others.

    **Raises** `RunError` when `folder` holds no training.
    """
    config = records.open_run(folder, "run", otherwise=records.NOT_BEGUN)
    fields = dict(config["scenario"])
    # The stored fields are complete, so the preset has no effect.
    return {
        "scenario": load_scenario("paper", **fields),
        "shield": config["shield"],
        "pursuer": config["pursuer"],
        "seed": config["seed"],
        "episodes": config["episodes"],
        "options": make_options(**config["learner"]),
        **{name: config.get(name) for name in ("warm_start", "against", "vary")},
    }


@_interrupts.held()
def train(
    scenario: Scenario,
    *,
    shield: Any = "joint",
    pursuer: Any = "nash",
    seed: int = 0,
    episodes: int = 200,
    options: TrainingOptions | None = None,
    out: str | Path | None = None,
    resume: bool = False,
    progress: Callable[[Progress], None] | None = None,
    checkpoint_seconds: float = 20.0,
    chunk: int | None = None,
    warm_start: str | Path | None = None,
    against: str | Path | None = None,
    vary: Mapping[str, Any] | None = None,
) -> Training:
    """Train a policy with TD3 behind a shield, or a pursuer against such a policy.

    With `out` the run is a folder: `config.json`, `metrics.jsonl`, checkpoints, TensorBoard curves, and at
    the end `summary.json` and `policy.npz`. The same seed gives the same run on the same machine, with or
    without interruption and resume. `KeyboardInterrupt` stops the training after the current chunk and writes
    a checkpoint.

    **Arguments:** `shield` and `pursuer` names or objects, for a pursuer also names as `load_pursuer` takes
    them; `resume` continues the run in `out`, with the stored scenario, shield, pursuer, seed and options
    (`resume_settings` reads them), while `episodes` may be larger; `progress` is called after every chunk of
    `chunk` decisions (by default what takes some 0.5 s).

    With `warm_start`, another run's folder, the learner begins with the networks and moments of its newest
    checkpoint and an empty replay: for another shield, pursuer or scenario with equal observations.

    With `against`, a run folder, `pretrained` or `goal-seeking`, the pursuer learns, and the evader drives by
    that policy behind the shield (see `Pursuing`); `pursuer` then drives the `guided` worlds. With `vary`,
    such as `{"capture_distance": [0.1, 0.2], "obstacle_count": [0, 5]}`, every episode draws its own robots
    (see `Variation`).

    The folder is locked until the last file is written. A run that has all its episodes is not changed. A
    damaged checkpoint is skipped with a `DamageWarning`.

    **Raises** `ValueError` for an invalid argument; `RunError` when `out` is occupied and `resume` is not
    set, has nothing to resume, or has other settings, or when `warm_start` holds no training that fits;
    `FolderInUseError` when another process writes there; `OutputError` when the run cannot be written any
    more; `Diverged` when networks, losses or actions are not finite. After the last two the newest checkpoint
    is kept, and the run can be resumed from it.
    """
    whole_number("episodes", episodes)
    seed_number(seed)
    options = make_options() if options is None else options
    options = options if against is None else Pursuing.options(options)
    if chunk is None:
        chunk = CHUNK if options.worlds == 1 else CHUNK_OF_MANY
    whole_number("chunk", chunk)
    pursuer = from_anywhere(pursuer) if isinstance(pursuer, str) else pursuer
    names = {"shield": _name(shield), "pursuer": _name(pursuer)}
    shield = as_shield(shield, scenario)
    variation, scenario, shield = Variation.of(vary or {}, scenario, shield)
    pursuer = load_pursuer(pursuer) if isinstance(pursuer, str) else as_pursuer(pursuer)
    player: Player = EVADING
    if against is not None:
        against = from_anywhere(str(against))
        player = Pursuing.against(against if against == GOAL_SEEKING else load_policy(against), scenario)
    capacity = _capacity(options, scenario, episodes)
    config = {
        "scenario": scenario_to_dict(scenario),
        "learner": options_to_dict(options),
        **names,
        "seed": int(seed),
        "episodes": int(episodes),
        "version": __version__,
    }
    if against is not None:
        config["against"] = against
    if vary:
        config["vary"] = {name: list(ends) for name, ends in vary.items()}
    folder, learner = None if out is None else Path(out), None
    if warm_start is not None:
        config["warm_start"] = str(Path(warm_start).absolute())
        if not (resume and folder is not None and list_checkpoints(folder)):
            learner = _learner_of(warm_start, player.observation_size(scenario), options)
    setup = _Setup(scenario, shield, pursuer, options, capacity, learner, player, variation)
    with nullcontext() if folder is None else records.writing(folder, resume=resume):
        return _run(setup, config, folder, resume, progress, checkpoint_seconds, chunk)


class _Setup(NamedTuple):
    """What is trained; `learner` to begin with, None for a new one."""

    scenario: Scenario
    shield: Any
    pursuer: Any
    options: TrainingOptions
    capacity: int
    learner: Learner | None
    player: Player
    variation: Variation


def _learner_of(run: str | Path, observations: int, options: TrainingOptions) -> Learner:
    """The learner of another training. **Raises** `RunError` if it does not fit."""
    records.open_run(run, otherwise="name the run folder of a training")
    example = options.algorithm.init(observations, 2, jax.random.key(0))
    return read_part(run, "learner", example)


def _run(
    setup: _Setup,
    config: dict[str, Any],
    folder: Path | None,
    resume: bool,
    progress: Callable[[Progress], None] | None,
    checkpoint_seconds: float,
    chunk: int,
) -> Training:
    """The training, with its folder locked."""
    scenario, shield, pursuer, options, capacity, learner, player, variation = setup
    episodes = int(config["episodes"])
    if folder is not None and resume:
        _check_same_run(folder, config)
    elif folder is not None:
        records.create_run(folder, config)
    state = start(scenario, shield, options, jax.random.key(config["seed"]), capacity, player, variation)
    if learner is not None:
        state = eqx.tree_at(lambda state: state.learner, state, learner)
    metrics: list[dict[str, Any]] = []
    earlier = 0.0
    if folder is not None and resume:
        state, earlier = _reopen(folder, config, state)
        check_networks(state.learner, folder)
        metrics = records.read_metrics(folder)
        if (ended := _ended_before(folder, state, metrics, episodes)) is not None:
            return ended
    elif folder is not None:
        write_checkpoint(folder, state, wall_seconds=0.0)

    curves = None
    if folder is not None:
        curves = Curves(folder, purge_step=int(state.ended) + 1, averaged=options.worlds > 1)
    begun = saved = time.perf_counter()
    limit = jnp.asarray(episodes)
    interrupted, diverged = False, None
    chunk_seconds: list[tuple[int, float]] = []

    def summary() -> dict[str, Any]:
        about = {key: config[key] for key in ("scenario", "shield", "pursuer", "seed", "version")}
        return records.summarise(metrics, wall_seconds=earlier + time.perf_counter() - begun, **about)

    try:
        while int(state.ended) < episodes:
            _interrupts.check()
            chunk_begun, steps_before = time.perf_counter(), int(state.env_steps)
            reached, report = run_chunk(
                scenario, shield, pursuer, options, state, limit, chunk, player, variation
            )
            diverged = divergence(report, reached.learner, len(metrics))
            if diverged is not None:
                break
            lines = _episode_lines(scenario, report, len(metrics))
            # One statement, so that state and metrics are consistent at an interrupt.
            state, metrics = reached, metrics + lines
            now = time.perf_counter()
            chunk_seconds.append((int(state.env_steps) - steps_before, now - chunk_begun))
            if folder is not None and curves is not None:
                records.append_metrics(folder, lines)
                curves.write(lines, report.losses)
                if now - saved >= checkpoint_seconds:
                    write_checkpoint(folder, state, wall_seconds=earlier + now - begun)
                    saved = now
            if progress is not None:
                # The first chunk compiles; its rate is used only until the second has ended.
                recent = chunk_seconds[1:][-20:] or chunk_seconds
                steps, seconds = (sum(column) for column in zip(*recent, strict=True))
                progress(_progress(metrics, state, episodes, steps / seconds))
    except KeyboardInterrupt:
        interrupted = True
    except BaseException as error:
        if folder is not None:
            # Report the first error.
            with suppress(OutputError):
                _keep(folder, metrics, state, earlier + time.perf_counter() - begun, summary())
            if isinstance(error, OutputError):
                raise error.and_kept(_kept(folder)) from error.__cause__
        raise
    figures, checkpoint = summary(), None

    kind = LearnedPolicy if player is EVADING else LearnedPursuer
    policy = kind(state.learner.actor, options.decision_steps)
    if folder is not None:
        try:
            checkpoint = _keep(folder, metrics, state, earlier + time.perf_counter() - begun, figures)
            if not interrupted and diverged is None:
                write_policy(folder, policy)
        except OutputError as error:
            raise error.and_kept(_kept(folder)) from error.__cause__
    if diverged is not None:
        raise Diverged(diverged, options, len(metrics), checkpoint)
    return Training(policy, figures, metrics, state, interrupted, folder, chunk_seconds)


def _keep(
    folder: Path, metrics: list[dict[str, Any]], state: TrainState, seconds: float, figures: dict[str, Any]
) -> Path:
    """Write the run's files for this state; returns the checkpoint's path."""
    records.append_metrics(folder, metrics[len(records.read_metrics(folder)) :])
    checkpoint = write_checkpoint(folder, state, wall_seconds=seconds)
    records.write_summary(folder, figures)
    return checkpoint


def _kept(folder: Path) -> str:
    """A message that names the checkpoint from which a stopped run can be resumed."""
    kept = list_checkpoints(folder)
    if not kept:
        return f"Nothing of the training is kept in {folder} yet"
    return f"Kept: {kept[-1]}, the newest checkpoint, from which the run can be resumed"


def _check_same_run(folder: Path, config: Mapping[str, Any]) -> None:
    """**Raises** `RunError` naming the settings that differ from the run in `folder`."""
    stored = records.open_run(folder, "run", otherwise=records.NOT_BEGUN)
    records.refuse_changes(folder, stored, config, _SETTINGS)
    if config["episodes"] < stored["episodes"]:
        raise records.RunError(
            f"{folder} was begun for {stored['episodes']} episodes; it cannot be resumed for fewer "
            f"({config['episodes']})"
        )


def _reopen(folder: Path, config: Mapping[str, Any], example: TrainState) -> tuple[TrainState, float]:
    """The state to continue from; truncates the run's files to it."""
    if not list_checkpoints(folder) and not records.read_metrics(folder):
        # Killed before its first checkpoint: it resumes at the start, and so must it after another kill.
        state, wall_seconds = example, 0.0
        write_checkpoint(folder, state, wall_seconds=wall_seconds)
    else:
        state, manifest = read_checkpoint(folder, example)
        wall_seconds = float(manifest["wall_seconds"])
        if len(records.read_metrics(folder)) != int(state.ended):
            records.truncate_metrics(folder, int(state.ended))
    if records.open_run(folder)["episodes"] != config["episodes"]:
        write_json(folder / "config.json", config)
    return state, wall_seconds


def _ended_before(
    folder: Path, state: TrainState, metrics: list[dict[str, Any]], episodes: int
) -> Training | None:
    """The result of a run that has all its episodes and files; None if anything is left to do."""
    try:
        policy, summary = load_trained(folder), records.read_summary(folder)
    except records.RunError:
        return None
    if int(state.ended) < episodes or summary.get("episodes", 0) < episodes:
        return None
    return Training(policy, summary, metrics, state, folder=folder, had_ended=True)


def _progress(metrics: list[dict[str, Any]], state: TrainState, episodes: int, rate: float) -> Progress:
    recent = [line["return"] for line in metrics[-records.CONVERGENCE_WINDOW :]]
    return Progress(
        episode=len(metrics),
        episodes=episodes,
        safe=sum(line["outcome"] not in ("captured", "collided") for line in metrics),
        env_steps=int(state.env_steps),
        steps_per_second=rate,
        mean_return=float(np.mean(recent)) if recent else float("nan"),
        last=metrics[-1] if metrics else None,
    )
