"""`sidestep reproduce`."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from sidestep.commands.common import (
    CountBar,
    Overrides,
    PursuerName,
    TrainingBar,
    parse_overrides,
    write_json_file,
)

if TYPE_CHECKING:
    from rich.console import Console

    from sidestep.trials.reproduction import ShieldStudy


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


def run(command: Reproduce, console: Console) -> int:
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
    write_json_file(command.json, read_summary(command.out))
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
