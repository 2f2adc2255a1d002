"""`sidestep reproduce`."""

from __future__ import annotations

import shlex
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import tyro

from sidestep._program import command as command_of
from sidestep.commands.common import (
    CountBar,
    Overrides,
    PursuerName,
    TrainingBar,
    advised,
    parse_overrides,
    write_json_file,
)

if TYPE_CHECKING:
    from rich.console import Console

    from sidestep.views.comparison import Section


@dataclass(frozen=True)
class Reproduce:
    """Reproduce the paper: train, evaluate and test under each shield, then compare and report."""

    out: Path = Path("runs/reproduce")
    """Folder to write; one run folder per shield, summary.json, comparison.md, figures and report.html."""
    shields: Annotated[tuple[str, ...], tyro.conf.arg(metavar="[NAME ...]")] = (
        "none",
        "paper",
        "game",
        "joint",
    )
    """Shields to compare: none, paper, game and joint."""
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
    from sidestep.store.files import OutputError, write_bytes
    from sidestep.store.outputs import try_outputs
    from sidestep.trials.reproduction import reproduce as run_study
    from sidestep.views import comparison_sections, markdown_tables, write_report
    from sidestep.world import load_scenario

    try_outputs(files=[command.json], folders=[command.out])
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
            training_progress=lambda shield: TrainingBar(console, f"training, {shield}"),
            count_progress=lambda label: CountBar(console, label),
        )
    except KeyboardInterrupt:
        console.print(f"Interrupted. Continue with: sidestep reproduce --out {command.out} --resume")
        return 130
    except OutputError as error:
        advice = advised(error, command.out, "reproduce", "--out", command.out, "--resume")
        raise advice from error.__cause__
    summary = read_summary(command.out)
    sections = comparison_sections(summary)
    console.print("Columns: what the paper reports, then our measurements under each shield.\n")
    for table in comparison_tables(sections):
        console.print(table)
        console.print()
    write_bytes(command.out / "comparison.md", markdown_tables(sections).encode())
    report = write_report(
        [study.folder for study in studies],
        command.out / "report.html",
        command=command_line(command),
    )
    write_json_file(command.json, summary)
    console.print(f"Report with figures: {report}")
    return 0


def comparison_tables(sections: list[Section]) -> Iterator[Any]:
    """The paper's figures beside ours as tables of one layout; four shields fit into 80 columns."""
    from rich.box import SIMPLE_HEAD
    from rich.table import Table

    for section in sections:
        table = Table(
            title=section.title, title_justify="left", title_style="bold", box=SIMPLE_HEAD, show_edge=False,
            pad_edge=False, padding=(0, 1, 0, 0),
        )  # fmt: skip
        table.add_column("", min_width=23, no_wrap=True)
        for index, name in enumerate(section.columns):
            table.add_column(name, justify="right", min_width=8 if index == 0 else 9, no_wrap=True)
        for label, cells in section.rows:
            table.add_row(label, *cells, style="dim" if label.startswith(" ") else "")
        yield table


def command_line(command: Reproduce) -> str:
    """What to paste to run the study again, beside the folder of this one: that is never written over."""
    parts = [command_of("reproduce", "--out", f"{command.out}-again")]
    plain = Reproduce()
    for name in ("shields", "pursuer", "episodes", "evaluation_episodes", "set", "learner"):
        value = getattr(command, name)
        if value != getattr(plain, name):
            words = value if isinstance(value, tuple) else (str(value),)
            parts.append(f"--{name.replace('_', '-')} {' '.join(shlex.quote(word) for word in words)}")
    return " ".join([*parts, f"--seed {command.seed}"])
