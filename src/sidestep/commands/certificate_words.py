"""The output of `sidestep certify`: robots, verdict, budget, helpful changes, and all claims."""

from __future__ import annotations

import math
from collections.abc import Collection, Sequence
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from rich.console import Console

    from sidestep.safety.certificate.certificate import Certificate
    from sidestep.safety.certificate.nearest_changes import Change
    from sidestep.safety.certificate.situation import Situation
    from sidestep.world import KnownRobot


def print_known_robots(console: Console) -> None:
    """Print every robot of `known_robots.toml`: its numbers in the model, its figures and their sources."""
    from rich.markup import escape
    from rich.table import Table

    from sidestep.world import known_robots

    robots = known_robots().values()
    table = Table("name", "role", "speed, m/s", "b, m", "radius, m")
    for robot in robots:
        half = f"{robot.half_axle:g}" if robot.role == "pursuer" else ""
        table.add_row(robot.name, robot.role, f"{robot.speed:.4g}", half, f"{robot.radius:g}")
    table.caption = "speed: V of a pursuer's wheel rims, v_e of an evader in every direction"
    console.print(table)
    figures = [figure for robot in robots for figure in robot.figures.values()]
    sources = list({source["title"]: source for figure in figures for source in figure["sources"]}.values())
    for robot in robots:
        console.print(f"[bold]{robot.name}[/bold]  {escape(robot.title)}", highlight=False)
        console.print(f"  {escape(robot.reason)}", highlight=False)
        for name, figure in robot.figures.items():
            numbers = ", ".join(str(sources.index(source) + 1) for source in figure["sources"])
            how = f": {figure['how']}" if "how" in figure else ""
            console.print(escape(f"  {name} {figure['value']:g} [{numbers}]{how}"), highlight=False)
        console.print(f"  Not known: {escape(robot.unknown)}", highlight=False)
    console.print("[bold]Sources[/bold], and the parts used")
    for number, source in enumerate(sources, 1):
        text = f"[{number}] {source['title']}\n    {source['address']}\n    {source['read']}"
        console.print(escape(text), highlight=False, soft_wrap=True)


def _model_words(robot: KnownRobot) -> str:
    size = f"radius {robot.radius:g} m"
    if robot.role == "evader":
        return f"evader: v_e = {robot.speed:.4g} m/s, {size}"
    return f"pursuer: V = {robot.speed:.4g} m/s, b = {robot.half_axle:g} m, {size}"


def print_robots(
    situation: Situation,
    pursuer: str | None,
    evader: str | None,
    overrides: Collection[str],
    console: Console,
) -> None:
    """Print the numbers of the chosen robots in the model, and what --set changed; nothing without robots."""
    from rich.markup import escape

    from sidestep.world import known_robots

    robots = [known_robots()[name] for name in (pursuer, evader) if name is not None]
    for robot in robots:
        text = f"{robot.title}, {_model_words(robot)} ({robot.reason})."
        replaced = [name for name in robot.fields if name in overrides]
        if replaced:
            text += f" Replaced by --set: {', '.join(replaced)}."
        console.print(escape(f"{text} Not known: {robot.unknown}"), highlight=False)
    if not robots:
        return
    console.print(
        "These numbers are conservative: if the figures are right, guarantees hold for the robots; if there "
        "is no guarantee, the robots may still be better than the model.",
        highlight=False,
    )
    distance = _length(situation.capture_distance)
    radii = " + ".join(f"{robot.radius:g} m" for robot in robots)
    if "capture_distance" in overrides:
        text = f"Capture distance {distance} from --set, between centres (radii: {radii})."
    elif len(robots) == 2:
        text = f"Capture distance {distance}, between centres: contact, the sum of the radii {radii}."
    else:
        text = (
            f"Capture distance {distance} is the scenario's, between centres; for contact set it to the sum "
            f"of both radii ({radii} of this one)."
        )
    console.print(text, highlight=False)


def _length(value: float) -> str:
    return "no limit" if math.isinf(value) else f"{value:.6g} m"


def print_certificate(certificate: Certificate, console: Console) -> None:
    """Print the verdict first, then its reasons."""
    from rich.markup import escape

    situation = certificate.situation
    verdict = "[bold]GUARANTEED[/bold]" if certificate.guaranteed else "[bold]NOT GUARANTEED[/bold]"
    console.print(f"{verdict}: {escape(certificate.reason)}.")
    console.print(
        f"Capture distance {_length(situation.capture_distance)}, largest that can be escaped "
        f"{_length(certificate.largest_capture_distance)}; guaranteed clearance "
        f"{_length(certificate.guaranteed_clearance)}"
        + ("." if math.isinf(certificate.margin) else f" ({1e3 * certificate.margin:+.3f} mm).")
    )
    if math.isfinite(certificate.largest_capture_distance):
        console.print(_budget_table(certificate))
    if certificate.start_set is not None:
        start = certificate.start_set
        console.print(
            f"Certified starts{'' if certificate.guaranteed else ' for that clearance'}: measured outside "
            f"the disc of {_length(start.level)} with tips at +-{_length(start.tip)} on the pursuer's axis."
        )
    if certificate.start is not None:
        console.print(_start_words(certificate))
    _print_changes(certificate, console)
    for claim in certificate.claims:
        console.print(f"[bold]{claim.kind}[/bold]  {escape(claim.text)}")


def _start_words(certificate: Certificate) -> str:
    margin = certificate.start_margin
    if margin is None:
        return f"Start {certificate.start}: no start can be certified."
    state = "certified" if margin >= 0.0 and certificate.guaranteed else "not certified"
    if margin >= 0.0 and not certificate.guaranteed:
        state += f" for the capture distance, but for {_length(certificate.guaranteed_clearance)}"
    return f"Start {certificate.start}: {state}; {1e3 * margin:+.3f} mm outside the set to stay out of."


def _budget_table(certificate: Certificate) -> Any:
    from rich.table import Table

    words = {
        "position": "position error",
        "heading": "heading error, b rho per rad",
        "delay": "delay, v_e per s",
        "sampling": "sampling, delta(T)",
        "tracking": "velocity driven, off its command",
        "sides": "telling the sides of the pursuer's axis apart",
    }
    table = Table("added to the capture distance", "mm", title="Budget")
    for name, text in words.items():
        table.add_row(text, f"{1e3 * certificate.budget[name]:.4f}")
    required, limit = certificate.budget["required"], certificate.largest_capture_distance
    table.add_row("together", f"{1e3 * certificate.budget['total']:.4f}")
    relation = "within" if required <= limit else "more than"
    table.caption = f"l' = {required:.6g} m, {relation} l_max = {limit:.6g} m"
    return table


def _print_changes(certificate: Certificate, console: Console) -> None:
    changes = certificate.nearest_changes
    if not changes:
        return
    useful = [change for change in changes if change.needed is not None]
    if useful:
        console.print(_changes_table(useful, certificate))
    failing = [change for change in changes if change.needed is None]
    zero = [change.parameter for change in failing if change.now == 0.0]
    others = [change.parameter for change in failing if change.now != 0.0]
    words = [f"No value alone is enough of: {', '.join(others)}."] if others else []
    words += [f"Already 0: {', '.join(zero)}."] if zero else []
    console.print(" ".join(words), highlight=False)


def _changes_table(useful: Sequence[Change], certificate: Certificate) -> Any:
    from rich.table import Table

    table = Table("change", "from", "to", "by", "whose", title="Nearest changes that make it hold")
    mine = [change for change in useful if change.mine]
    for change in mine:
        table.add_row(*_cells([change]), end_section=change is mine[-1])
    for pair in certificate.nearest_pairs:
        table.add_row(*_cells(pair.changes), end_section=True)
    for change in useful:
        if not change.mine:
            table.add_row(*_cells([change]), style="dim")
    table.caption = "Say what you can change with --mine, of evader, sensing, task, pursuer."
    return table


def _cells(changes: Sequence[Change]) -> list[str]:
    columns = [
        (f"{'+ ' if i else ''}{change.parameter}", *_values(change), _by(change), _whose(change))
        for i, change in enumerate(changes)
    ]
    return ["\n".join(column) for column in zip(*columns, strict=True)]


def _values(change: Change) -> tuple[str, str]:
    return f"{change.now:.6g} {change.unit}", f"{change.needed:.6g} {change.unit}"


def _by(change: Change) -> str:
    if change.needed is None or change.now == 0.0:
        return ""
    ratio = change.needed / change.now
    return f"x {ratio:.3g}" if ratio >= 10.0 else f"{100.0 * (ratio - 1.0):+.3g} %"


def _whose(change: Change) -> str:
    return change.whose if change.mine else "not yours"
