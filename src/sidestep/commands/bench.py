"""`sidestep bench`."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import tyro

if TYPE_CHECKING:
    from rich.console import Console


@dataclass(frozen=True)
class Bench:
    """Measure how fast this is, beside the peers that are installed. Run nothing else meanwhile."""

    sections: Annotated[tuple[str, ...], tyro.conf.Positional, tyro.conf.arg(metavar="[SECTION ...]")] = ()
    """Any of learning, filter, simulation, joint, roofline, scaling, gpu, startup; all by default."""
    json: Annotated[Path | None, tyro.conf.arg(aliases=["--out"])] = None
    """Write the figures to this file; sections in it that do not run now stay as they are."""
    figures: Path | None = None
    """Draw figures of everything in --json into this folder; the tables lie beside them as bench.md."""
    quick: bool = False
    """Tiny amounts that show only that everything runs."""
    draw_only: bool = False
    """Run nothing: draw --figures from what the --json file holds."""


def run(command: Bench, console: Console) -> int:
    """Run `sidestep bench`; returns the exit status."""
    from sidestep.bench.report import draw, load_results, run_section, save_section, summary_lines
    from sidestep.bench.sections import SECTIONS, section
    from sidestep.store.outputs import try_outputs

    names = command.sections or tuple(SECTIONS)
    for name in names:
        section(name)  # a wrong name ends it before anything is measured
    if command.draw_only and (command.json is None or command.figures is None):
        raise ValueError("--draw-only needs --json FILE, which is read, and --figures FOLDER")
    try_outputs(files=[None if command.draw_only else command.json], folders=[command.figures])
    results: dict[str, Any] = load_results(command.json)
    failed = False
    for name in () if command.draw_only else names:
        console.print(f"[bold]{name}[/bold]: {SECTIONS[name]}")
        measured = run_section(name, command.quick, lambda line: console.print(f"  {line}", highlight=False))
        results.setdefault("sections", {})[name] = measured
        # Section by section: what has been measured survives an interruption.
        save_section(command.json, results)
        console.print("\n".join(summary_lines(measured["summary"], "  ")), highlight=False)
        failed = failed or any("error" in case for case in measured["cases"])
    if command.figures is not None:
        for path in draw(results, command.figures):
            console.print(f"{path}", highlight=False)
    return 1 if failed else 0
