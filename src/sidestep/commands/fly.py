"""`sidestep fly`."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from sidestep._bounds import DISTANCE, SPEED_UP, WIND, bounded
from sidestep.commands.common import PursuerName, ScenarioName, parse_overrides
from sidestep.commands.physics import PhysicsCommand, Plan, outcome_counts, run_on_plant

if TYPE_CHECKING:
    from rich.console import Console

    from sidestep.plants.air import FlightEpisode, Pilot

_NEAR = 2.0


@dataclass(frozen=True)
class Fly(PhysicsCommand):
    """Fly a policy on a quadrotor in a physics simulator, pursued by an aircraft."""

    scenario: ScenarioName = "quadrotor-test"
    """Preset (quadrotor, quadrotor-test) or a file with a quadrotor; sidestep train --scenario quadrotor
    trains a policy for it."""
    pursuer: PursuerName = "chauffeur"
    """Pursuer strategy."""
    speed: float = bounded(1.0, SPEED_UP)
    """Speed of the video as a factor on real time."""
    tracking_error: float = bounded(0.04, DISTANCE)
    """Bound of the quadrotor's distance from its reference motion, m; part of the shield's budget."""
    wind: tuple[float, float] = bounded((0.0, 0.0), WIND)
    """Wind along x and y, m/s."""


def run(command: Fly, console: Console) -> int:
    """Run `sidestep fly`; returns the exit status."""
    return run_on_plant(command, "sidestep fly", lambda *given: _plan(command, console, *given), console)


def _plan(command: Fly, console: Console, policy: Any, scenario: Any) -> Plan:
    from sidestep.plants.air import ROOM_SENSORS, FlightOptions, Pilot, certificate_of, errors_of, fly
    from sidestep.plants.sensors import changed_sensors

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
    promised = {
        "guaranteed": certificate.guaranteed,
        "guaranteed_clearance": certificate.guaranteed_clearance,
        "capture_distance": certificate.situation.capture_distance,
        "parts": certificate.budget,
        "stands_for": certificate.situation.stands_for,
    }
    return Plan(
        prepare=prepare,
        play=play,
        counts=flight_counts,
        say=lambda counts: _say(counts, certificate, console),
        robots="quadrotor",
        options=options,
        report={"budget": errors_of(options), "certificate": promised},
        episodes="flights",
        key="flights",
        stem="flight",
        looks={"twin_words": "quadrotor in MuJoCo", "near": _NEAR},
        shield_of=lambda pilot: pilot.shield,
    )


def flight_counts(figures: list[dict[str, Any]]) -> dict[str, Any]:
    """`outcome_counts`, with the number of flights within the certificate's assumptions, and how many of
    those were lost."""
    inside = [figure for figure in figures if figure["within_assumptions"]]
    return outcome_counts(figures) | {
        "within_assumptions": len(inside),
        "lost_within_assumptions": sum(one["outcome"] in ("captured", "collided") for one in inside),
        "infeasible_periods": sum(figure["infeasible_periods"] for figure in figures),
        "tracking_error_max": max(figure["tracking_error_max"] for figure in figures),
        "periods_not_normal": sum(figure["periods_not_normal"] for figure in figures),
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
        f"Largest distance from the reference motion: {1e3 * counts['tracking_error_max']:.1f} mm; "
        f"{counts['infeasible_periods']} periods in which not every row could be kept.",
        highlight=False,
    )
