"""`sidestep fly`."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import tyro

from sidestep.commands.common import (
    Overrides,
    PursuerName,
    ScenarioName,
    ShieldName,
    parse_overrides,
    policy_and_scenario,
    write_json_file,
)
from sidestep.commands.physics import (
    about_of,
    checked,
    draw_beside_simulation,
    episode_table,
    outcome_counts,
    play_seeds,
    setting,
    video_options,
)

if TYPE_CHECKING:
    from rich.console import Console

    from sidestep.plants.air import FlightEpisode


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
    with checked(command):
        return _run(command, console)


def _run(command: Fly, console: Console) -> int:
    from sidestep.plants.air import ROOM_SENSORS, FlightOptions, Pilot, certificate_of, fly, write_video
    from sidestep.plants.ground import changed_sensors

    policy, scenario, _ = policy_and_scenario(command.run, command.scenario, command.set)
    options = FlightOptions(
        sensors=changed_sensors(ROOM_SENSORS, parse_overrides(command.noise)),
        tracking_error=command.tracking_error,
        wind=command.wind,
        pursuer_sees=command.pursuer_sees,
    )

    def prepare() -> Pilot:
        pilot = Pilot(scenario, policy, command.shield, options)
        pilot.onboard.warm_up()
        return pilot

    def play(pilot: Pilot, seed: int) -> FlightEpisode:
        return fly(pilot, command.pursuer, seed, command.steps, certificate=certificate)

    certificate = certificate_of(scenario, options, check_shield=False)
    played = play_seeds(command, "quadrotor", prepare, play, console)
    counts = flight_counts(played.figures)
    episode_table(played.figures, "flights", console)
    _say(counts, certificate, console)
    report = {
        **setting(command, scenario, options),
        **_promised(options, certificate),
        **counts,
        "flights": played.figures,
    }
    write_json_file(command.json, report)
    if played.interrupted:
        console.print(f"Interrupted: {len(played.figures)} of {command.seeds} flights.", highlight=False)
        return 130
    if command.out is not None:
        draw_beside_simulation(
            command, policy, played.player.shield, played.first, command.out / "flight",
            about_of(command, "sidestep fly"), console, twin_words="quadrotor in MuJoCo", near=_NEAR,
        )  # fmt: skip
    if command.video is not None:
        path = write_video(played.first, command.video, **video_options(command))
        console.print(f"Video: {path}", soft_wrap=True)
    return 0


def flight_counts(figures: list[dict[str, Any]]) -> dict[str, Any]:
    """As `outcome_counts`, with how many flights kept within the certificate's assumptions, and how many of
    those were lost."""
    inside = [figure for figure in figures if figure["within_assumptions"]]
    return outcome_counts(figures) | {
        "within_assumptions": len(inside),
        "lost_within_assumptions": sum(one["outcome"] in ("captured", "collided") for one in inside),
        "infeasible_periods": sum(figure["infeasible_periods"] for figure in figures),
        "tracking_error_max": max(figure["tracking_error_max"] for figure in figures),
        "periods_not_normal": sum(figure["periods_not_normal"] for figure in figures),
    }


def _promised(options: Any, certificate: Any) -> dict[str, Any]:
    from sidestep.plants.air import errors_of

    return {
        "budget": errors_of(options),
        "certificate": {
            "guaranteed": certificate.guaranteed,
            "guaranteed_clearance": certificate.guaranteed_clearance,
            "capture_distance": certificate.situation.capture_distance,
            "parts": certificate.budget,
            "stands_for": certificate.situation.stands_for,
        },
    }


def _say(counts: dict[str, Any], certificate: Any, console: Console) -> None:
    if certificate.guaranteed:
        kept = certificate.guaranteed_clearance - certificate.situation.capture_distance
        console.print(
            f"Capture is excluded by the certificate, with {1e3 * kept:.0f} mm to spare. Within its "
            f"assumptions: {counts['within_assumptions']} of {counts['episodes']} flights, of which "
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
