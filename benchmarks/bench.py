"""How fast is it, beside the peers that are installed? Run nothing else meanwhile.

python benchmarks/bench.py --json FILE --figures FOLDER
python benchmarks/bench.py filter joint --quick
"""

from __future__ import annotations

import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import tyro

from sidestep.store.outputs import try_outputs
from speed.report import draw, load_results, run_section, save_section, summary_lines
from speed.sections import SECTIONS, section


@dataclass(frozen=True)
class Bench:
    """Measure how fast this is, beside the peers that are installed. Run nothing else meanwhile."""

    sections: Annotated[tuple[str, ...], tyro.conf.Positional, tyro.conf.arg(metavar="[SECTION ...]")] = ()
    """Any of learning, many_worlds, filter, simulation, joint, decision, roofline, scaling, gpu, startup;
    all by default."""
    json: Annotated[Path | None, tyro.conf.arg(aliases=["--out"])] = None
    """Write the figures to this file; sections in it that do not run now stay as they are."""
    figures: Path | None = None
    """Draw figures of everything in --json into this folder; the tables lie beside them as bench.md."""
    quick: bool = False
    """Tiny amounts that show only that everything runs."""
    draw_only: bool = False
    """Run nothing: draw --figures from what the --json file holds."""


def run(command: Bench) -> int:
    """Measure and draw; returns 1 if a case ended with an error."""
    names = command.sections or tuple(SECTIONS)
    for name in names:
        section(name)  # a wrong name ends it before anything is measured
    if command.draw_only and (command.json is None or command.figures is None):
        raise ValueError("--draw-only needs --json FILE, which is read, and --figures FOLDER")
    try_outputs(files=[None if command.draw_only else command.json], folders=[command.figures])
    results: dict[str, Any] = load_results(command.json)
    failed = False
    for name in () if command.draw_only else names:
        print(f"{name}: {SECTIONS[name]}", flush=True)
        measured = run_section(name, command.quick, lambda line: print(f"  {line}", flush=True))
        results.setdefault("sections", {})[name] = measured
        # Section by section: what has been measured survives an interruption.
        save_section(command.json, results)
        print("\n".join(summary_lines(measured["summary"], "  ")), flush=True)
        failed = failed or any("error" in case for case in measured["cases"])
    if command.figures is not None:
        for path in draw(results, command.figures):
            print(path)
    return 1 if failed else 0


def main(arguments: list[str] | None = None) -> int:
    """Bad input ends with a message and exit status 2, Ctrl-C with 130."""
    command = tyro.cli(Bench, prog="bench.py", args=arguments)
    try:
        return run(command)
    except ValueError as error:
        print(f"bench.py: {error}", file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        return 130


if __name__ == "__main__":
    sys.exit(main())
