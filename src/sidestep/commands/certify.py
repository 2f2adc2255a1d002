"""`sidestep certify`."""

from __future__ import annotations

import sys
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import tyro

from sidestep._bounds import DELAY, DISTANCE, HEADING_ERROR, TRACKING_ERROR, bounded
from sidestep.commands.certificate_words import print_certificate, print_known_robots, print_robots
from sidestep.commands.common import Overrides, ScenarioName, scenario_overrides, write_json_file

if TYPE_CHECKING:
    from rich.console import Console

RobotName = Annotated[str | None, tyro.conf.arg(metavar="NAME")]

_MAY_BE_ZERO = {"pursuer_half_axle": "half_axle", "control_period": "control_period"}
"""Scenario fields that may be 0 in a certificate, but not in a simulation."""


@dataclass(frozen=True)
class Certify:
    """Print what is guaranteed: whether capture is excluded, from which starts, and what would change it."""

    scenario: ScenarioName = "paper"
    """Preset or file."""
    pursuer: RobotName = None
    """A pursuer on sale, see --robots: sets its speed and half axle."""
    evader: RobotName = None
    """An evader on sale: sets its speed. With both, the capture distance is the sum of their radii."""
    set: Overrides = ()
    """Scenario fields to change; pursuer_half_axle and control_period may be 0 here. wheel_separation may
    replace pursuer_half_axle, and is twice as large."""
    position_error: float = bounded(0.0, DISTANCE)
    """Largest error of a measured position of the pursuer, m."""
    heading_error: float = bounded(0.0, HEADING_ERROR)
    """Largest error of a measured heading of the pursuer, rad."""
    delay: float = bounded(0.0, DELAY)
    """Age of the measurements, s."""
    own_motion: bool = True
    """Whether the evader accounts for its own motion during the delay."""
    tracking_error: float = bounded(0.0, TRACKING_ERROR)
    """Largest error of the evader's velocity with respect to its command, m/s."""
    walls: bool = False
    """The robots are in a bounded arena."""
    start: Annotated[str | None, tyro.conf.arg(metavar="X,Y")] = None
    """A start to check: the evader in the pursuer's frame, m (x ahead, y left)."""
    target_distance: float | None = bounded(None, DISTANCE)
    """Check whether a target at this distance from the evader, m, is reached before capture."""
    mine: tuple[Literal["evader", "sensing", "task", "pursuer"], ...] = ("evader", "sensing", "task")
    """What you can change: listed first among the helpful changes, and also tried in pairs. sensing: the
    control period, errors and delay; task: the capture distance."""
    shield: bool = True
    """Also compute the clearance that the game shield keeps without a budget."""
    obstacles: bool = False
    """Also compute what can be kept from obstacles beside the pursuer. Takes minutes where no clearance table
    for these robots comes with sidestep."""
    obstacle: Annotated[str | None, tyro.conf.arg(metavar="X,Y")] = None
    """An obstacle to check with --start: its centre in the pursuer's frame, m. Implies --obstacles."""
    search_drift: bool = False
    """Also search for the fastest drift of an obstacle that can be kept, for minutes. Implies --obstacles."""
    strict: bool = False
    """Exit status 1 unless capture is excluded (and, if asked, the start is certified)."""
    json: Path | None = None
    """Also write the certificate to this file."""
    figure: Path | None = None
    """Also draw the sets in the pursuer's frame: PNG, and PDF beside it."""
    robots: bool = False
    """Only list the robots for --pursuer and --evader, with their figures and sources."""


def run(command: Certify, console: Console) -> int:
    """Run `sidestep certify`; returns the exit status."""
    if command.robots:
        print_known_robots(console)
        return 0
    from rich.console import Console as RichConsole

    from sidestep.safety.certificate import certify
    from sidestep.store.outputs import try_outputs
    from sidestep.world import load_scenario, robot_fields

    # The figure is drawn last; check first whether it can be written.
    try_outputs(files=[command.json, *_figure_files(command)])
    overrides = scenario_overrides(command.set, zero=True)
    given = {
        argument: 0.0
        for field, argument in _MAY_BE_ZERO.items()
        if isinstance(overrides.get(field), (int, float))
        and not isinstance(overrides[field], bool)
        and overrides[field] == 0
    }
    fields = {name: value for name, value in overrides.items() if _MAY_BE_ZERO.get(name) not in given}
    robots = robot_fields(command.pursuer, command.evader)
    scenario = load_scenario(command.scenario, **{**robots, **fields})
    start = None if command.start is None else _point("start", command.start)
    obstacle = None if command.obstacle is None else _point("obstacle", command.obstacle)
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
            obstacles=command.obstacles,
            obstacle=obstacle,
            search_drift=command.search_drift,
            mine=command.mine,
            progress=lambda what: status.update(f"certifying: {what}"),
        )
    print_robots(certificate.situation, command.pursuer, command.evader, overrides, console)
    print_certificate(certificate, console)
    named = {"pursuer": command.pursuer, "evader": command.evader}
    write_json_file(command.json, {**certificate.to_dict(), "robots": named})
    if command.figure is not None:
        from sidestep.views import certificate_figure

        png, pdf = certificate_figure(certificate, command.figure)
        console.print(f"Figure: {png} and {pdf}", soft_wrap=True)
        if certificate.obstacles is not None:
            from sidestep.safety.clearance import table_for
            from sidestep.views import obstacle_figure

            png, pdf = obstacle_figure(table_for(scenario), _beside(command.figure))
            console.print(f"Obstacles: {png} and {pdf}", soft_wrap=True)
    sys.stdout.flush()
    certified = certificate.guaranteed and (
        certificate.start_margin is None or certificate.start_margin >= 0.0
    )
    return 1 if command.strict and not certified else 0


def _figure_files(command: Certify) -> tuple[Path, ...]:
    if command.figure is None:
        return ()
    from sidestep.views.style import figure_files

    more = command.obstacles or command.search_drift or command.obstacle is not None
    return (*figure_files(command.figure), *(figure_files(_beside(command.figure)) if more else ()))


def _beside(figure: Path) -> Path:
    """The path of the second figure, of obstacles."""
    return figure.with_name(f"{figure.stem}-obstacles{figure.suffix}")


def _point(name: str, text: str) -> tuple[float, float]:
    try:
        x, y = (float(part) for part in text.split(","))
    except ValueError:
        raise ValueError(f"{name} = {text!r}: it must be two numbers X,Y in the pursuer's frame, m") from None
    return x, y
