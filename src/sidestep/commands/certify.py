"""`sidestep certify`."""

from __future__ import annotations

import math
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import tyro

from sidestep.commands.common import Overrides, ScenarioName, parse_overrides, write_json_file

if TYPE_CHECKING:
    from rich.console import Console

    from sidestep.safety.certificate import Certificate

_MAY_BE_ZERO = {"pursuer_half_axle": "half_axle", "control_period": "control_period"}
"""Scenario fields that no simulation can have at 0, but a certificate can."""


@dataclass(frozen=True)
class Certify:
    """Say what is guaranteed: is capture impossible, from where, how near, and what would change it."""

    scenario: ScenarioName = "paper"
    """Preset or file."""
    set: Overrides = ()
    """Scenario fields to change; pursuer_half_axle and control_period may be 0 here."""
    position_error: float = 0.0
    """Largest error of a measured position of the pursuer, m."""
    heading_error: float = 0.0
    """Largest error of a measured heading of the pursuer, rad."""
    delay: float = 0.0
    """Age of the measurements, s."""
    own_motion: bool = True
    """Whether the evader adds its own motion during the delay to what it measured."""
    tracking_error: float = 0.0
    """How far the velocity that the evader drives may be from the one that it was told, m/s."""
    walls: bool = False
    """The robots are in a bounded arena."""
    start: Annotated[str | None, tyro.conf.arg(metavar="X,Y")] = None
    """A start to ask about: the evader in the pursuer's frame, m (x ahead, y left)."""
    target_distance: float | None = None
    """A target's distance from the evader to ask about, m: is it reached before capture?"""
    shield: bool = True
    """Also compute what the game shield as shipped keeps."""
    strict: bool = False
    """Exit status 1 unless capture is excluded (and, if asked, the start is certified)."""
    json: Path | None = None
    """Also write the certificate to this file."""
    figure: Path | None = None
    """Also draw the sets in the pursuer's frame: PNG, and PDF beside it."""


def run(command: Certify, console: Console) -> int:
    """Run `sidestep certify`; returns the exit status."""
    from rich.console import Console as RichConsole

    from sidestep.safety.certificate import certify
    from sidestep.store.outputs import try_outputs
    from sidestep.world import load_scenario

    try_outputs(files=[command.json, *_figure_files(command)])
    overrides = parse_overrides(command.set)
    given = {
        argument: 0.0
        for field, argument in _MAY_BE_ZERO.items()
        if isinstance(overrides.get(field), (int, float))
        and not isinstance(overrides[field], bool)
        and overrides[field] == 0
    }
    fields = {name: value for name, value in overrides.items() if _MAY_BE_ZERO.get(name) not in given}
    scenario = load_scenario(command.scenario, **fields)
    start = None if command.start is None else _point(command.start)
    with RichConsole(stderr=True).status("certifying") as status:
        certificate = certify(
            scenario,
            position_error=command.position_error,
            heading_error=command.heading_error,
            delay=command.delay,
            own_motion_predicted=command.own_motion,
            tracking_error=command.tracking_error,
            walls=command.walls,
            start=start,
            target_distance=command.target_distance,
            half_axle=given.get("half_axle"),
            control_period=given.get("control_period"),
            check_shield=command.shield,
            progress=lambda what: status.update(f"certifying: {what}"),
        )
    _print(certificate, console)
    write_json_file(command.json, certificate.to_dict())
    if command.figure is not None:
        from sidestep.views import certificate_figure

        png, pdf = certificate_figure(certificate, command.figure)
        console.print(f"Figure: {png} and {pdf}", soft_wrap=True)
    sys.stdout.flush()
    certified = certificate.guaranteed and (
        certificate.start_margin is None or certificate.start_margin >= 0.0
    )
    return 1 if command.strict and not certified else 0


def _figure_files(command: Certify) -> tuple[Path, ...]:
    if command.figure is None:
        return ()
    from sidestep.views.style import figure_files

    return figure_files(command.figure)


def _point(text: str) -> tuple[float, float]:
    try:
        x, y = (float(part) for part in text.split(","))
    except ValueError:
        raise ValueError(f"start = {text!r}: it must be two numbers X,Y in the pursuer's frame, m") from None
    return x, y


def _length(value: float) -> str:
    return "no limit" if math.isinf(value) else f"{value:.6g} m"


def _print(certificate: Certificate, console: Console) -> None:
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
    if certificate.nearest_changes:
        console.print(_changes_table(certificate))
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
        "tracking": "velocity driven, not told",
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


def _changes_table(certificate: Certificate) -> Any:
    from rich.table import Table

    table = Table("change only", "from", "to", title="Nearest changes that make it hold")
    for change in certificate.nearest_changes:
        needed = "no value does" if change.needed is None else f"{change.needed:.6g} {change.unit}"
        table.add_row(change.parameter, f"{change.now:.6g} {change.unit}", needed)
    return table
