"""Running sections and writing down what they measured: one JSON file, tables, figures."""

from __future__ import annotations

import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import machine
from sidestep._compiled import cores
from speed.children import run_case
from speed.sections import SECTIONS, section
from speed.timing import tail_exponent


def run_section(name: str, quick: bool, say: Callable[[str], None]) -> dict[str, Any]:
    """Every case of a section, one after the other, with where and when; `say` is told of each as it ends."""
    module, begun = section(name), time.time()
    load = machine.load()
    if load is not None and load > 0.5 * cores():
        say(f"something else runs here (load {load:.1f}): figures suffer")
    measured = []
    for case in module.cases(quick):
        figures = run_case(case)
        measured.append(figures)
        threads = "1 thread" if case.threads == 1 else f"{case.threads} threads"
        say(f"{case.name}, {threads}: {in_a_line(figures)}")
    return {
        "what": SECTIONS[name],
        "quick": quick,
        "when": time.strftime("%Y-%m-%dT%H:%M:%SZ", time.gmtime(begun)),
        "seconds": round(time.time() - begun, 1),
        "load_before": load,
        "machine": machine.machine(),
        "versions": machine.versions(),
        "cases": measured,
        "summary": module.summary(measured),
    }


def in_a_line(figures: dict[str, Any]) -> str:
    """The case's figures, briefly."""
    for key in ("missing", "error"):
        if key in figures:
            return f"{key}: {figures[key]}"
    parts = []
    if "throughput" in figures:
        parts.append(f"{number(figures['throughput']['value'])} {figures['throughput']['unit']}")
    if "latency" in figures:
        one = figures["latency"]
        parts.append(
            f"p50 {number(one['p50'])}, p99 {number(one['p99'])}, worst {number(one['worst'])} {one['unit']}"
        )
    if "gflops" in figures:
        parts.append(f"{figures['gflops']:.0f} GFLOP/s")
    if "points" in figures:
        points = figures["points"]
        last = points[-1]
        power = tail_exponent([p["size"] for p in points], [p["seconds"] for p in points])
        parts.append(f"{len(figures['points'])} sizes to {last['size']:,}")
        parts.append("no exponent" if power is None else f"exponent {power:.2f}")
    if "cold_seconds" in figures:
        parts.append(f"cold {figures['cold_seconds']:.1f} s, warm {figures['warm_seconds']:.1f} s")
    return "; ".join(parts)


def number(value: float) -> str:
    """Three digits, thousands separated."""
    return f"{value:,.0f}" if abs(value) >= 100 else f"{value:.3g}"


def load_results(path: Path | None) -> dict[str, Any]:
    """What an earlier run wrote, or nothing yet. **Raises** `ValueError` for another kind of file."""
    if path is None or not path.exists():
        return {"sections": {}}
    from sidestep.store.files import read_json

    results = read_json(path)
    if not isinstance(results, dict) or not isinstance(results.get("sections"), dict):
        raise ValueError(f"{path}: not a file that benchmarks/bench.py has written; it is left as it is")
    return results


def save_section(path: Path | None, results: dict[str, Any]) -> None:
    """Write all sections to `path`, if there is one."""
    if path is not None:
        from sidestep.store.files import write_json

        write_json(path, results)


HEADER = ("", "threads", "per second", "p50", "p99", "worst", "compiling, s", "memory, MiB")


def rows(measured: dict[str, Any]) -> list[tuple[str, ...]]:
    """One row of `HEADER` per case that has such figures."""
    lines = []
    for one in measured["cases"]:
        settings = one["settings"]
        name = one["name"] + (f", {settings['rows']} rows" if "calls" in settings else "")
        name += f", {settings['calls']}" if "calls" in settings else ""
        if "missing" in one or "error" in one:
            lines.append((name, str(one["threads"]), one.get("missing") or one["error"], "", "", "", "", ""))
            continue
        timed = one.get("latency")
        spread = (
            [f"{number(timed[key])} {timed['unit']}" for key in ("p50", "p99", "worst")]
            if timed
            else ["-"] * 3
        )
        rate = one.get("throughput")
        per_second = f"{number(rate['value'])} {rate['unit'].removesuffix('/s')}" if rate else "-"
        compiling = one.get("compile_seconds")
        lines.append(
            (
                name,
                str(one["threads"]),
                in_a_line(one) if not timed and not rate else per_second,
                *spread,
                f"{compiling:.1f}" if compiling else "-",
                f"{one['peak_memory_mib']:.0f}",
            )
        )
    return lines


def summary_lines(summary: dict[str, Any], indent: str = "") -> list[str]:
    """A section's summary for people: one figure a line."""
    lines = []
    for name, value in summary.items():
        words = name.replace("_", " ")
        if isinstance(value, dict):
            lines += [f"{indent}{words}:", *summary_lines(value, indent + "  ")]
        else:
            shown = number(value) if isinstance(value, (int, float)) else str(value)
            lines.append(f"{indent}{words}: {shown}")
    return lines


def markdown(results: dict[str, Any]) -> str:
    """All sections as Markdown tables, each with its machine and versions."""
    parts = []
    for name in SECTIONS:
        if name not in results["sections"]:
            continue
        one = results["sections"][name]
        about = one["machine"]
        present = {key: value for key, value in one["versions"].items() if value}
        parts.append(
            f"**{name}**: {one['what']}. {about['processor']}, {about['cores']} cores, {one['when'][:10]}, "
            f"load before {one['load_before']}, {one['seconds']:.0f} s.\n\n"
            + _rows_of_markdown([HEADER, tuple("---" for _ in HEADER), *rows(one)])
            + f"\n\nVersions: {', '.join(f'{key} {value}' for key, value in present.items())}."
        )
    return "\n\n".join(parts) + "\n"


def _rows_of_markdown(lines: list[tuple[str, ...]]) -> str:
    return "\n".join("| " + " | ".join(cell.replace("|", "\\|") for cell in line) + " |" for line in lines)


def draw(results: dict[str, Any], folder: Path) -> list[Path]:
    """Figures and `bench.md` in `folder`; their paths. **Raises** `ValueError` if there are no results."""
    if not results["sections"]:
        raise ValueError(f"nothing has been measured, so there is nothing to draw into {folder}")
    from sidestep.store.files import write_bytes
    from speed.figures import draw_all

    paths = draw_all(results, folder)
    write_bytes(folder / "bench.md", markdown(results).encode())
    return [*paths, folder / "bench.md"]
