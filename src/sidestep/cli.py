"""The command line: parse, call, print. Every command imports what it needs when it runs."""

from __future__ import annotations

import abc
import json
import sys
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import tyro

if TYPE_CHECKING:
    from rich.console import Console

    from sidestep.learning import Progress
    from sidestep.trials import Evaluation
    from sidestep.trials.reproduction import ShieldStudy

Overrides = Annotated[tuple[str, ...], tyro.conf.arg(metavar="[NAME=VALUE ...]")]
PursuerName = Annotated[str, tyro.conf.arg(metavar="NAME")]
ShieldName = Annotated[str, tyro.conf.arg(metavar="NAME")]
ScenarioName = Annotated[str, tyro.conf.arg(metavar="NAME|FILE")]


@dataclass(frozen=True)
class Train:
    """Train a policy with TD3 while a shield keeps the evader safe."""

    out: Path
    """Run folder to write; never overwritten silently."""
    scenario: ScenarioName = "paper"
    """Preset (paper, paper-test) or a TOML or JSON file."""
    shield: ShieldName = "game"
    """Shield during training: none, paper or game."""
    pursuer: PursuerName = "nash"
    """Pursuer: nash, turn-then-drive, turn-while-driving, pure-pursuit, interceptor, random, still."""
    episodes: int = 200
    """Episodes to train for; with --resume the new total."""
    seed: int = 0
    """Seed of everything random; the same seed gives the same run on the same machine."""
    set: Overrides = ()
    """Scenario fields to change, such as evader_speed=0.18 obstacle_count=2."""
    learner: Overrides = ()
    """Training options to change, such as discount=0.98 updates_per_decision=3."""
    resume: bool = False
    """Continue the run in --out where it stopped, bit for bit; its own settings are used."""
    json: Path | None = None
    """Also write the summary to this file."""


@dataclass(frozen=True)
class Evaluate:
    """Measure a policy under a shield against a pursuer over random episodes, with 95 % bounds."""

    run: Annotated[str, tyro.conf.Positional, tyro.conf.arg(metavar="RUN|goal-seeking")] = "goal-seeking"
    """Run folder whose policy to evaluate, or goal-seeking for the untrained one."""
    scenario: Annotated[str | None, tyro.conf.arg(metavar="NAME|FILE")] = None
    """Preset or file; the run's own scenario, or paper, by default."""
    shield: Annotated[str | None, tyro.conf.arg(metavar="NAME")] = None
    """Shield; the run's own, or game, by default."""
    pursuer: Annotated[str | None, tyro.conf.arg(metavar="NAME")] = None
    """Pursuer strategy; the run's own, or nash, by default."""
    episodes: int = 1000
    """Episodes to measure."""
    seed: int = 0
    """Seed of starts, targets and random pursuers."""
    batch: int = 512
    """Episodes that run at once."""
    set: Overrides = ()
    """Scenario fields to change, such as evader_speed=0.18 obstacle_count=2."""
    json: Path | None = None
    """Also write the figures to this file."""


@dataclass(frozen=True)
class Reproduce:
    """Reproduce the paper: train, evaluate and test under several shields, then compare and report."""

    out: Path = Path("runs/reproduce")
    """Folder to write; one run folder per shield, summary.json, figures and report.html."""
    shields: tuple[str, ...] = ("none", "paper", "game")
    """Shields to compare."""
    pursuer: PursuerName = "nash"
    """Pursuer strategy."""
    episodes: int = 200
    """Training episodes per shield (the paper's 200)."""
    evaluation_episodes: int = 1000
    """Random episodes to measure each trained policy on."""
    seed: int = 0
    """Seed of everything random."""
    set: Overrides = ()
    """Scenario fields to change."""
    learner: Overrides = ()
    """Training options to change."""
    resume: bool = False
    """Continue in --out: finished parts are kept, an interrupted training goes on where it stopped."""
    json: Path | None = None
    """Also write the comparison to this file."""


@dataclass(frozen=True)
class Report:
    """Write the figures and the self-contained HTML report of one or several runs."""

    runs: Annotated[tuple[Path, ...], tyro.conf.Positional, tyro.conf.arg(metavar="RUN [RUN ...]")]
    """Run folders, or the folder of a reproduction."""
    out: Path | None = None
    """HTML file to write; report.html in the first folder by default."""


def parse_overrides(pairs: tuple[str, ...]) -> dict[str, Any]:
    """`("a=1", "b=[0, 1]", "c=text")` as values: JSON where it is JSON, else text.

    **Raises** `ValueError` for an argument without `=`.
    """
    values: dict[str, Any] = {}
    for pair in pairs:
        name, equals, text = pair.partition("=")
        if not equals or not name:
            raise ValueError(f"'{pair}' is not of the form NAME=VALUE")
        try:
            values[name] = json.loads(text)
        except json.JSONDecodeError:
            values[name] = text
    return values


def _write_json(path: Path | None, data: Any) -> None:
    if path is not None:
        from sidestep.learning.records import write_json

        path.parent.mkdir(parents=True, exist_ok=True)
        write_json(path, data)


def train(command: Train, console: Console) -> int:
    """Run `sidestep train`; returns the exit status."""
    from sidestep.learning import make_options, resume_settings
    from sidestep.learning import train as run_training
    from sidestep.world import load_scenario

    if command.resume:
        settings = resume_settings(command.out)
        settings["episodes"] = max(settings["episodes"], command.episodes)
    else:
        settings = {
            "scenario": load_scenario(command.scenario, **parse_overrides(command.set)),
            "shield": command.shield,
            "pursuer": command.pursuer,
            "seed": command.seed,
            "episodes": command.episodes,
            "options": make_options(**parse_overrides(command.learner)),
        }
    with TrainingBar(console, f"training, {settings['shield']} shield") as show:
        training = run_training(**settings, out=command.out, resume=command.resume, progress=show)
    console.print(training_table(training.summary))
    _write_json(command.json, training.summary)
    if training.interrupted:
        console.print(f"Interrupted. Continue with: sidestep train --out {command.out} --resume")
        return 130
    console.print(f"Policy and summary in {command.out}; next: sidestep evaluate {command.out}")
    return 0


def evaluate(command: Evaluate, console: Console) -> int:
    """Run `sidestep evaluate`; returns the exit status."""
    from sidestep.learning import load_policy
    from sidestep.learning.records import open_run
    from sidestep.trials import evaluate as run_evaluation
    from sidestep.world import load_scenario

    overrides = parse_overrides(command.set)
    policy: Any = command.run
    config: dict[str, Any] = {}
    if command.run != "goal-seeking":
        policy = load_policy(command.run)
        config = open_run(command.run) if Path(command.run).is_dir() else {}
    if command.scenario is None and config:
        scenario = load_scenario("paper", **{**config["scenario"], **overrides})
    else:
        scenario = load_scenario(command.scenario or "paper", **overrides)
    shield = command.shield or config.get("shield", "game")
    pursuer = command.pursuer or config.get("pursuer", "nash")
    with CountBar(console, f"episodes, {shield} shield, {pursuer} pursuer") as show:
        evaluation = run_evaluation(
            scenario, policy, shield, pursuer, command.episodes, command.seed, batch=command.batch,
            progress=show,
        )  # fmt: skip
    console.print(evaluation_table(evaluation))
    about = {"policy": command.run, "shield": shield, "pursuer": pursuer, "scenario": scenario.name}
    _write_json(command.json, {**evaluation.to_dict(), **about, "seed": command.seed})
    return 0


def reproduce(command: Reproduce, console: Console) -> int:
    """Run `sidestep reproduce`; returns the exit status."""
    from sidestep.learning import make_options
    from sidestep.learning.records import read_summary
    from sidestep.trials.reproduction import reproduce as run_study
    from sidestep.views import write_report
    from sidestep.world import load_scenario

    try:
        studies = run_study(
            command.out,
            scenario=load_scenario("paper", **parse_overrides(command.set)),
            shields=command.shields,
            pursuer=command.pursuer,
            seed=command.seed,
            episodes=command.episodes,
            evaluation_episodes=command.evaluation_episodes,
            options=make_options(**parse_overrides(command.learner)),
            resume=command.resume,
            training_progress=lambda shield: TrainingBar(console, f"training, {shield} shield"),
            count_progress=lambda label: CountBar(console, label),
        )
    except KeyboardInterrupt:
        console.print(f"Interrupted. Continue with: sidestep reproduce --out {command.out} --resume")
        return 130
    console.print(comparison_table(studies))
    report = write_report(
        [study.folder for study in studies],
        command.out / "report.html",
        command=f"sidestep reproduce --seed {command.seed}",
    )
    _write_json(command.json, read_summary(command.out))
    console.print(f"Report with figures: {report}")
    return 0


def comparison_table(studies: list[ShieldStudy]) -> Any:
    """The paper's figures beside ours, a column per shield."""
    from rich.table import Table

    from sidestep.trials.reproduction import PAPER, describe

    table = Table(
        "", "paper reports", *(f"{study.shield} shield" for study in studies), title="The paper and us"
    )

    def row(label: str, paper: str, values: list[str]) -> None:
        table.add_row(label, paper, *values)

    def bounded(figures: dict[str, Any], name: str) -> str:
        low, high = figures[f"{name}_rate_low"], figures[f"{name}_rate_high"]
        return f"{figures[f'{name}_rate']:.1%} ({low:.1%} to {high:.1%})"

    trainings = [study.training for study in studies]
    row("training: episodes", str(PAPER["episodes"]), [str(t["episodes"]) for t in trainings])
    row("training: safe episodes", str(PAPER["safe_episodes"]), [str(t["safe_episodes"]) for t in trainings])
    row("  captured / collided", "0 / 0", [f"{t['captured']} / {t['collided']}" for t in trainings])
    row(
        "  converged by episode",
        str(PAPER["converged_within"]),
        ["never" if t["converged_episode"] is None else str(t["converged_episode"]) for t in trainings],
    )
    row(
        "  return of the last 20",
        f"{PAPER['converged_return']:.0f}",
        [f"{t['final_return']:.0f}" for t in trainings],
    )
    for label, attribute in (("trained policy", "trained"), ("goal-seeking policy", "untrained")):
        results = [getattr(study, attribute) for study in studies]
        row(f"{label}, random starts", "-", [f"{r['episodes']} episodes" for r in results])
        for name in ("captured", "collided", "reached"):
            row(f"  {name} (95 % bounds)", "-", [bounded(r, name) for r in results])
    for label, attribute in (("trained policy", "scene_trained"), ("goal-seeking policy", "scene_untrained")):
        scenes = [describe(getattr(study, attribute)) for study in studies]
        row(
            f"test scene, {label}",
            PAPER["scene_outcome"] if attribute == "scene_trained" else "-",
            [f"{s['outcome'].replace('_', ' ')}, {s['seconds']:.1f} s" for s in scenes],
        )
    return table


def report(command: Report, console: Console) -> int:
    """Run `sidestep report`; returns the exit status."""
    from sidestep.learning.records import open_run
    from sidestep.views import write_report

    folders: list[Path] = []
    for folder in command.runs:
        study = open_run(folder).get("study")
        folders += [folder] if study is None else [folder / shield for shield in study]
    path = command.out or command.runs[0] / "report.html"
    console.print(f"Report with figures: {write_report(folders, path)}")
    return 0


def training_table(summary: dict[str, Any]) -> Any:
    """The figures of one training as a table."""
    from rich.table import Table

    table = Table(
        title=f"Training, {summary['shield']} shield, {summary['pursuer']} pursuer", show_header=False
    )
    for key in (
        "episodes", "safe_episodes", "captured", "collided", "reached", "timed_out", "converged_episode",
        "final_return", "min_pursuer_clearance", "min_obstacle_clearance", "intervention_rate",
        "infeasible_rate", "env_steps", "wall_seconds",
    ):  # fmt: skip
        value = summary[key]
        shown = "never" if value is None and key == "converged_episode" else value
        table.add_row(key.replace("_", " "), f"{shown:.4g}" if isinstance(shown, float) else str(shown))
    return table


def evaluation_table(evaluation: Evaluation) -> Any:
    """Counts and rates with their 95 % Wilson bounds."""
    from rich.table import Table

    figures = evaluation.to_dict()
    table = Table("outcome", "episodes", "share", "95 % bounds", title=f"{evaluation.episodes} episodes")
    for name in ("captured", "collided", "reached", "timed_out"):
        low, high = figures[f"{name}_rate_low"], figures[f"{name}_rate_high"]
        share = figures[f"{name}_rate"]
        table.add_row(name.replace("_", " "), str(figures[name]), f"{share:.2%}", f"{low:.2%} to {high:.2%}")
    median = figures["reach_time_median"]
    table.caption = (
        f"median time to reach {'-' if median is None else f'{median:.1f} s'}; "
        f"shield corrects {figures['intervention_rate']:.1%} of steps, cannot satisfy all rows in "
        f"{figures['infeasible_rate']:.2%}"
    )
    return table


class _Bar(abc.ABC):
    """A progress bar on the error stream, so that results alone go to standard output.

    A context manager that gives its `update`.
    """

    def __init__(self, console: Console, label: str):
        from rich.console import Console as RichConsole
        from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn

        self._progress = Progress(
            TextColumn("{task.description}"),
            BarColumn(bar_width=24),
            MofNCompleteColumn(),
            TextColumn("{task.fields[note]}"),
            TimeElapsedColumn(),
            console=RichConsole(stderr=True),
        )
        self._task = self._progress.add_task(label, total=None, note="compiling")

    def __enter__(self) -> Callable[..., None]:
        self._progress.__enter__()
        return self.update

    @abc.abstractmethod
    def update(self, *values: Any) -> None:
        """Show where the work is."""

    def __exit__(self, *error: Any) -> None:
        self._progress.__exit__(*error)


class TrainingBar(_Bar):
    """Episode, steps per second, mean return of the last 20 episodes, safe count."""

    def update(self, *values: Any) -> None:
        progress: Progress = values[0]
        note = f"{progress.steps_per_second:,.0f} steps/s  safe {progress.safe}"
        if progress.last is not None:
            note += f"  return {progress.last['return']:.0f} (mean of 20: {progress.mean_return:.0f})"
        self._progress.update(self._task, total=progress.episodes, completed=progress.episode, note=note)


class CountBar(_Bar):
    """Finished of all."""

    def update(self, *values: Any) -> None:
        finished, total = values
        self._progress.update(self._task, total=total, completed=finished, note="")


def main(arguments: list[str] | None = None) -> int:
    """Entry point of `sidestep`. Bad input ends with a message and exit status 2, Ctrl-C with 130."""
    command = tyro.cli(
        Annotated[Train, tyro.conf.subcommand("train")]
        | Annotated[Evaluate, tyro.conf.subcommand("evaluate")]
        | Annotated[Reproduce, tyro.conf.subcommand("reproduce")]
        | Annotated[Report, tyro.conf.subcommand("report")],
        prog="sidestep",
        description="Safe reinforcement learning for a robot that is being pursued.",
        args=arguments,
    )
    from rich.console import Console

    console = Console()
    run = {Train: train, Evaluate: evaluate, Reproduce: reproduce, Report: report}[type(command)]
    try:
        return run(command, console)  # type: ignore[arg-type]
    except ValueError as error:
        print(f"sidestep: {error}", file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        return 130


if __name__ == "__main__":
    sys.exit(main())
