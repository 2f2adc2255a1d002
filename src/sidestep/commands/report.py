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
    """Write the figures and the self-contained HTML report of one or several runs."""

    runs: Annotated[tuple[Path, ...], tyro.conf.Positional, tyro.conf.arg(metavar="RUN [RUN ...]")]
    """Run folders, or the folder of a reproduction."""
    out: Path | None = None
    """HTML file to write; report.html in the first folder by default."""


def run(command: Report, console: Console) -> int:
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
