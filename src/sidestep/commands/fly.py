"""`sidestep fly`."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import tyro

from sidestep.commands.common import (
    CountBar,
    Overrides,
    PursuerName,
    ScenarioName,
    ShieldName,
    parse_overrides,
    policy_and_scenario,
    write_json_file,
)
from sidestep.commands.twin import episode_table, twin_counts

if TYPE_CHECKING:
    from rich.console import Console


_NEAR = 2.0


@dataclass(frozen=True)
class Fly:
    """Fly a policy on a quadrotor in a physics simulator, hunted by an aircraft: rotors, noise and delay."""

    run: Annotated[str, tyro.conf.Positional, tyro.conf.arg(metavar="RUN|goal-seeking")] = "goal-seeking"
    """Run folder whose policy to use (sidestep train --scenario quadrotor makes one), or goal-seeking for
    the untrained one."""
    scenario: ScenarioName = "quadrotor-test"
    """Preset (quadrotor, quadrotor-test) or a file with a quadrotor in it."""
    shield: ShieldName = "joint"
    """Shield: none, paper, game or joint."""
    pursuer: PursuerName = "chauffeur"
    """Pursuer strategy."""
    set: Overrides = ()
    """Scenario fields to change, such as capture_distance=0.2."""
    noise: Overrides = ()
    """Fields of the sensors to change, such as position_noise=0.002 delay=0.02."""
    tracking_error: float = 0.04
    """How far the quadrotor may be from the motion asked of it, m: the shield allows for it."""
    wind: tuple[float, float] = (0.0, 0.0)
    """Wind along x and y, m/s."""
    pursuer_sees: Literal["truth", "measurements"] = "truth"
    """What the pursuer decides from."""
    seeds: int = 1
    """Flights, with the seeds from --seed on."""
    seed: int = 0
    """First seed, of starts and measurements."""
    steps: int | None = None
    """At most this many control periods; the scenario's episode_steps by default."""
    out: Path | None = None
    """Folder for the figure of the first flight beside the plain simulation, and its recording."""
    video: Path | None = None
    """Also render the first flight into this .mp4, .gif or .webp file."""
    speed: float = 1.0
    """How many times faster the video runs."""
    rate: int = 25
    """Pictures per second of the video."""
    width: int = 960
    """Width of the video in pixels; 16 by 9."""
    json: Path | None = None
    """Also write the figures to this file."""


def run(command: Fly, console: Console) -> int:
    """Run `sidestep fly`; returns the exit status."""
    import warnings

    from sidestep.bridges.flight import ROOM_SENSORS, FlightOptions, Pilot, certificate_of, fly, write_video
    from sidestep.bridges.twin import changed_sensors
    from sidestep.safety.budget import BudgetWarning

    if command.seeds < 1:
        raise ValueError(f"seeds = {command.seeds}: at least 1 is needed")
    if command.rate < 1 or not 64 <= command.width <= 1920 or command.width % 2:
        raise ValueError(
            f"rate = {command.rate}, width = {command.width}: the rate must be at least 1, the width an even "
            "number from 64 to 1920"
        )
    if not command.speed > 0.0:
        raise ValueError(f"speed = {command.speed}: it must be greater than 0")
    policy, scenario, _ = policy_and_scenario(command.run, command.scenario, command.set)
    options = FlightOptions(
        sensors=changed_sensors(ROOM_SENSORS, parse_overrides(command.noise)),
        tracking_error=command.tracking_error,
        wind=command.wind,
        pursuer_sees=command.pursuer_sees,
    )
    figures: list[dict[str, Any]] = []
    first, interrupted = None, False
    with (
        warnings.catch_warnings(record=True) as warned,
        CountBar(console, f"{command.shield} shield, {command.pursuer}, quadrotor") as show,
    ):
        warnings.simplefilter("always", BudgetWarning)
        pilot = Pilot(scenario, policy, command.shield, options)
        certificate = certificate_of(scenario, options, check_shield=False)
        pilot.onboard.warm_up()
        try:
            for number in range(command.seeds):
                flight = fly(
                    pilot, command.pursuer, command.seed + number, command.steps, certificate=certificate
                )
                first = first or flight
                figures.append(flight.to_dict())
                show(number + 1, command.seeds)
        except KeyboardInterrupt:
            interrupted = True
            if first is None:
                raise
    assert first is not None
    for text in dict.fromkeys(str(one.message) for one in warned):
        console.print(f"Warning: {text}.", highlight=False)
    _print(figures, certificate, scenario, console)
    report = {
        "policy": command.run,
        "shield": command.shield,
        "pursuer": command.pursuer,
        **_setting(scenario, options, certificate),
        **flight_counts(figures),
        "flights": figures,
    }
    write_json_file(command.json, report)
    if interrupted:
        console.print(f"Interrupted: {len(figures)} of {command.seeds} flights.", highlight=False)
        return 130
    if command.out is not None:
        _draw(command, scenario, policy, pilot.shield, first, command.out, console)
    if command.video is not None:
        size = (round(command.width * 9 / 32) * 2, command.width)
        path = write_video(first, command.video, speed=command.speed, rate=command.rate, size=size)
        console.print(f"Video: {path}", soft_wrap=True)
    return 0


def flight_counts(figures: list[dict[str, Any]]) -> dict[str, Any]:
    """As `twin_counts`, with how many flights kept within the certificate's assumptions, and how many of
    those were lost."""
    inside = [figure for figure in figures if figure["within_assumptions"]]
    return twin_counts(figures) | {
        "within_assumptions": len(inside),
        "lost_within_assumptions": sum(one["outcome"] in ("captured", "collided") for one in inside),
        "infeasible_periods": sum(figure["infeasible_periods"] for figure in figures),
        "tracking_error_max": max(figure["tracking_error_max"] for figure in figures),
        "periods_not_normal": sum(figure["periods_not_normal"] for figure in figures),
    }


def _setting(scenario: Any, options: Any, certificate: Any) -> dict[str, Any]:
    import importlib.metadata
    from dataclasses import asdict

    from sidestep.bridges.flight import errors_of
    from sidestep.world import scenario_to_dict

    return {
        "scenario": scenario_to_dict(scenario),
        "options": asdict(options),
        "budget": errors_of(options),
        "certificate": {
            "guaranteed": certificate.guaranteed,
            "guaranteed_clearance": certificate.guaranteed_clearance,
            "capture_distance": certificate.situation.capture_distance,
            "parts": certificate.budget,
            "stands_for": certificate.situation.stands_for,
        },
        "versions": {name: importlib.metadata.version(name) for name in ("sidestep", "mujoco", "jax")},
    }


def _print(figures: list[dict[str, Any]], certificate: Any, scenario: Any, console: Console) -> None:
    episode_table(figures, "flights", console)
    counts = flight_counts(figures)
    if certificate.guaranteed:
        kept = certificate.guaranteed_clearance - certificate.situation.capture_distance
        console.print(
            f"Capture is excluded by the certificate, with {1e3 * kept:.0f} mm to spare. Within its "
            f"assumptions: {counts['within_assumptions']} of {len(figures)} flights, of which "
            f"{counts['lost_within_assumptions']} were captured or collided.",
            highlight=False,
        )
    else:
        console.print(f"Nothing is guaranteed: {certificate.reason}.", highlight=False)
    console.print(
        f"At most {1e3 * counts['tracking_error_max']:.1f} mm from the motion asked for; "
        f"{counts['infeasible_periods']} periods in which not every row could be kept.",
        highlight=False,
    )


def _draw(
    command: Fly, scenario: Any, policy: Any, shield: Any, flight: Any, folder: Path, console: Console
) -> None:
    from sidestep.trials import rollout, save_trajectory
    from sidestep.views import twin_figure

    simulation = rollout(scenario, policy, shield, command.pursuer, flight.seed, steps=command.steps)
    folder.mkdir(parents=True, exist_ok=True)
    about = {"shield": command.shield, "pursuer": command.pursuer, "source": "sidestep fly"}
    save_trajectory(folder / "flight.npz", flight.trajectory, scenario, about)
    png, pdf = twin_figure(
        scenario, simulation, flight.trajectory, folder / "flight", shield=command.shield,
        twin_words="quadrotor in MuJoCo", near=_NEAR,
    )  # fmt: skip
    console.print(f"Figure: {png} and {pdf}", soft_wrap=True)
