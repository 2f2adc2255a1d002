"""`sidestep report`."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro

if TYPE_CHECKING:
    from rich.console import Console


@dataclass(frozen=True)
class Report:
    """Write the figures and the self-contained HTML report of one or several runs, or of one log."""

    runs: Annotated[tuple[Path, ...], tyro.conf.Positional, tyro.conf.arg(metavar="RUN [RUN ...]|LOG")]
    """Run folders, or the folder of a reproduction; or an MCAP log of one episode."""
    out: Path | None = None
    """HTML file to write; report.html in the first folder, or beside the log, by default."""


def run(command: Report, console: Console) -> int:
    """Run `sidestep report`; returns the exit status."""
    from sidestep.learning.records import open_run
    from sidestep.views import write_report

    if any(path.suffix == ".mcap" for path in command.runs):
        return _report_log(command, console)
    folders: list[Path] = []
    for folder in command.runs:
        study = open_run(folder).get("study")
        folders += [folder] if study is None else [folder / shield for shield in study]
    path = command.out or command.runs[0] / "report.html"
    console.print(f"Report with figures: {write_report(folders, path)}")
    return 0


def _report_log(command: Report, console: Console) -> int:
    from sidestep.bridges.logs import load_log
    from sidestep.views import write_episode_report

    path, *others = command.runs
    if others:
        raise ValueError("a report is of runs or of one log")
    log = load_log(path)
    out = command.out or path.with_suffix(".html")
    written = write_episode_report(
        log.scenario, log.trajectory, out, title=f"Log {path.stem}", about=log.about, notes=log.rebuilt
    )
    for note in log.rebuilt:
        console.print(f"Not in the log: {note}.", highlight=False)
    console.print(f"Report with figure: {written}", highlight=False)
    return 0
