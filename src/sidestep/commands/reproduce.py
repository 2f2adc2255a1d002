"""`sidestep reproduce`."""

from __future__ import annotations

import json
import shlex
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import tyro

from sidestep._bounds import EPISODES, SEED, bounded
from sidestep._program import command as command_of
from sidestep.commands.common import (
    CountBar,
    Overrides,
    PursuerName,
    TrainingBar,
    going_on,
    options_from,
    resume_words,
    scenario_from,
    settings_from,
    unless_given,
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
    shields: Annotated[tuple[str, ...], tyro.conf.arg(metavar="[NAME ...]")] = unless_given(
        ("none", "paper", "game", "joint")
    )
    """Shields to compare: none, paper, game and joint."""
    pursuer: PursuerName = unless_given("nash")
    """Pursuer strategy."""
    episodes: int = bounded(unless_given(200), EPISODES)
    """Training episodes per shield (the paper's 200)."""
    evaluation_episodes: int = bounded(unless_given(1000), EPISODES)
    """Random episodes on which each trained policy is measured."""
    seed: int = bounded(unless_given(0), SEED)
    """Seed of everything random."""
    set: Overrides = ()
    """Scenario fields to change."""
    learner: Overrides = ()
    """Training options to change."""
    resume: bool = False
    """Resume in --out with the stored settings: finished parts are kept, an interrupted training continues.
    Other options must agree with those, including --episodes."""
    json: Path | None = None
    """Also write the comparison to this file."""


def run(command: Reproduce, console: Console) -> int:
    """Run `sidestep reproduce`; returns the exit status."""
    from sidestep.store.outputs import try_outputs
    from sidestep.store.runs import writing

    try_outputs(files=[command.json], folders=[command.out])
    resume = command.resume and (command.out / "config.json").is_file()
    going = going_on(console, command.out, *resume_words("reproduce", command.out, command.json))
    with going, writing(command.out, resume=resume):
        _study(command, resume, console)
    return 0


def _study(command: Reproduce, resume: bool, console: Console) -> None:
    """Run the study, print its tables and write its report."""
    from sidestep.store.files import write_bytes
    from sidestep.store.runs import read_summary
    from sidestep.trials.reproduction import reproduce as run_study
    from sidestep.trials.reproduction import study_settings
    from sidestep.views import comparison_sections, markdown_tables, write_report

    stored = study_settings(command.out) if resume else None
    settings = settings_from(
        command, "shields", "pursuer", "seed", "episodes", "evaluation_episodes", stored=stored
    )
    settings["scenario"] = scenario_from(command, settings.get("scenario"))
    settings["options"] = options_from(command, settings.get("options"))
    studies = run_study(
        command.out,
        **settings,
        resume=resume,
        training_progress=lambda shield: TrainingBar(console, f"training, {shield}"),
        count_progress=lambda label: CountBar(console, label),
    )
    summary = read_summary(command.out)
    sections = comparison_sections(summary)
    console.print("Columns: the paper's results, then the measurements with each shield.\n")
    for table in comparison_tables(sections):
        console.print(table)
        console.print()
    write_bytes(command.out / "comparison.md", markdown_tables(sections).encode())
    report = write_report(
        [study.folder for study in studies],
        command.out / "report.html",
        command=command_line(_as_begun(command, settings) if resume else command),
    )
    write_json_file(command.json, summary)
    console.print(f"Report with figures: {report}")


def comparison_tables(sections: list[Section]) -> Iterator[Any]:
    """The sections as tables of equal layout; four shields fit into 80 columns."""
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


def _as_begun(command: Reproduce, settings: Mapping[str, Any]) -> Reproduce:
    """The command with the stored settings of the resumed study."""
    from sidestep.learning import make_options, options_to_dict
    from sidestep.world import load_scenario, scenario_to_dict

    def changed(values: Mapping[str, Any], plain: Mapping[str, Any]) -> tuple[str, ...]:
        return tuple(f"{name}={json.dumps(value)}" for name, value in values.items() if value != plain[name])

    return replace(
        command,
        set=changed(scenario_to_dict(settings["scenario"]), scenario_to_dict(load_scenario("paper"))),
        learner=changed(options_to_dict(settings["options"]), options_to_dict(make_options())),
        **{name: value for name, value in settings.items() if name not in ("scenario", "options")},
    )


def command_line(command: Reproduce) -> str:
    """The command line that runs the study again, in another folder."""
    parts = [command_of("reproduce", "--out", f"{command.out}-again")]
    plain = Reproduce()
    for name in ("shields", "pursuer", "episodes", "evaluation_episodes", "set", "learner"):
        value = getattr(command, name)
        if value != getattr(plain, name):
            words = value if isinstance(value, tuple) else (str(value),)
            parts.append(f"--{name.replace('_', '-')} {' '.join(shlex.quote(word) for word in words)}")
    return " ".join([*parts, f"--seed {command.seed}"])
