"""`sidestep twin`."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import tyro

from sidestep._bounds import ACCELERATION, DELAY, DISTANCE, bounded
from sidestep.commands.common import parse_overrides
from sidestep.commands.physics import PhysicsCommand, Plan, outcome_counts, run_on_plant

if TYPE_CHECKING:
    from rich.console import Console

    from sidestep.plants.ground import TwinEpisode
    from sidestep.robot import Onboard

_BUDGET = ("position_error", "heading_error", "delay", "tracking_error")


@dataclass(frozen=True)
class Twin(PhysicsCommand):
    """Run a policy on the physics twin: motors, wheels, noise and delay instead of exact motion."""

    base: Literal["servo", "omniwheels"] = "servo"
    """Evader: planar joints with velocity servos, or three omniwheels with rollers."""
    sensors: Annotated[str, tyro.conf.arg(metavar="NAME")] = "motion-capture"
    """How poses are measured: perfect, motion-capture or odometry."""
    actuation_delay: float = bounded(0.0, DELAY)
    """Time from a command to its effect, s."""
    acceleration: float = bounded(2.0, ACCELERATION)
    """Limit of the evader's motors, m/s^2."""
    position_error: float | None = bounded(None, DISTANCE)
    """Error of relative positions in the shield's budget, m; by default from the sensors."""
    log: Path | None = None
    """Also write the first episode as an MCAP log of ROS 2 messages; never overwrites a file."""


def run(command: Twin, console: Console) -> int:
    """Run `sidestep twin`; returns the exit status."""
    return run_on_plant(command, "sidestep twin", lambda *given: _plan(command, *given), console)


def _plan(command: Twin, policy: Any, scenario: Any) -> Plan:
    from sidestep.plants.ground import TwinOptions, make_sensors, settings_for, twin_episode
    from sidestep.robot import Onboard

    scenario.check_built_in("the twin", "`sidestep fly` flies a quadrotor")
    options = TwinOptions(
        base=command.base,
        sensors=make_sensors(command.sensors, parse_overrides(command.noise)),
        actuation_delay=command.actuation_delay,
        acceleration=command.acceleration,
        pursuer_sees=command.pursuer_sees,
    )
    settings = settings_for(options)
    if command.position_error is not None:
        settings = replace(settings, budget=replace(settings.budget, position_error=command.position_error))

    def prepare() -> Onboard:
        onboard = Onboard(scenario, command.shield, policy, settings)
        onboard.warm_up()
        return onboard

    def play(onboard: Onboard, seed: int) -> TwinEpisode:
        return twin_episode(onboard, command.pursuer, seed, options, command.steps)

    return Plan(
        prepare=prepare,
        play=play,
        robots=command.base,
        options=options,
        report={"budget": {name: float(getattr(settings.budget, name)) for name in _BUDGET}},
        episodes="episodes on the twin",
        key="episodes_each",
        stem="twin",
        looks={"twin_words": f"physics twin, {command.base}, {command.sensors}"},
        shield_of=lambda onboard: command.shield,
        counts=outcome_counts,
    )
