"""`sidestep twin`."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

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

    from sidestep.plants.ground import TwinEpisode


@dataclass(frozen=True)
class Twin:
    """Run a policy on the physics twin: motors, wheels, noise and delay instead of exact motion."""

    run: Annotated[str, tyro.conf.Positional, tyro.conf.arg(metavar="RUN|goal-seeking")] = "goal-seeking"
    """Run folder whose policy to use, or goal-seeking for the untrained one."""
    scenario: ScenarioName = "paper-test"
    """Preset or file."""
    shield: ShieldName = "joint"
    """Shield: none, paper, game or joint."""
    pursuer: PursuerName = "nash"
    """Pursuer strategy."""
    set: Overrides = ()
    """Scenario fields to change, such as capture_distance=0.15."""
    base: Literal["servo", "omniwheels"] = "servo"
    """Evader: planar joints with velocity servos, or three omniwheels with rollers."""
    sensors: Annotated[str, tyro.conf.arg(metavar="NAME")] = "motion-capture"
    """How poses are measured: perfect, motion-capture or odometry."""
    noise: Overrides = ()
    """Fields of the sensors to change, such as position_noise=0.005 delay=0.05."""
    actuation_delay: float = 0.0
    """Seconds from a command to its effect."""
    acceleration: float = 2.0
    """Limit of the evader's motors, m/s^2."""
    position_error: float | None = None
    """Error of relative positions that the shield allows for, m; from the sensors by default."""
    pursuer_sees: Literal["truth", "measurements"] = "truth"
    """What the pursuer decides from."""
    seeds: int = 1
    """Episodes, with the seeds from --seed on."""
    seed: int = 0
    """First seed, of starts and measurements."""
    steps: int | None = None
    """At most this many control periods; the scenario's episode_steps by default."""
    out: Path | None = None
    """Folder for the figure of the first episode beside the plain simulation, and its recording."""
    video: Path | None = None
    """Also render the first episode into this .mp4, .gif or .webp file."""
    speed: float = 2.0
    """How many times faster the video runs."""
    rate: int = 25
    """Pictures per second of the video."""
    width: int = 960
    """Width of the video in pixels; 16 by 9."""
    log: Path | None = None
    """Also write the first episode as an MCAP log of ROS 2 messages; never over a file that exists."""
    json: Path | None = None
    """Also write the figures to this file."""


def run(command: Twin, console: Console) -> int:
    """Run `sidestep twin`; returns the exit status."""
    with checked(command):
        return _run(command, console)


def _run(command: Twin, console: Console) -> int:
    from dataclasses import replace

    from sidestep.plants.ground import TwinOptions, make_sensors, settings_for, twin_episode, write_video
    from sidestep.robot import Onboard
    from sidestep.safety import Budget

    policy, scenario, _ = policy_and_scenario(command.run, command.scenario, command.set)
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
        budget = settings.budget
        budget = Budget(command.position_error, budget.heading_error, budget.delay, budget.tracking_error)
        settings = replace(settings, budget=budget)

    def prepare() -> Onboard:
        onboard = Onboard(scenario, command.shield, policy, settings)
        onboard.warm_up()
        return onboard

    def play(onboard: Onboard, seed: int) -> TwinEpisode:
        return twin_episode(onboard, command.pursuer, seed, options, command.steps)

    played = play_seeds(command, command.base, prepare, play, console)
    episode_table(played.figures, "episodes on the twin", console)
    report = {
        **setting(command, scenario, options),
        "budget": {
            name: float(getattr(settings.budget, name))
            for name in ("position_error", "heading_error", "delay", "tracking_error")
        },
        **outcome_counts(played.figures),
        "episodes_each": played.figures,
    }
    write_json_file(command.json, report)
    if played.interrupted:
        console.print(f"Interrupted: {len(played.figures)} of {command.seeds} episodes.", highlight=False)
        return 130
    first, about = played.first, about_of(command, "sidestep twin")
    if command.log is not None:
        from sidestep.bridges.logs import save_log

        save_log(
            first.trajectory, scenario, command.log, about=about | {"seed": first.seed},
            levels=first.levels, reactions=first.reactions,
        )  # fmt: skip
        console.print(f"Log: {command.log}", soft_wrap=True)
    if command.out is not None:
        draw_beside_simulation(
            command, policy, command.shield, first, command.out / "twin", about, console,
            twin_words=f"physics twin, {command.base}, {command.sensors}",
        )  # fmt: skip
    if command.video is not None:
        path = write_video(first, command.video, **video_options(command))
        console.print(f"Video: {path}", soft_wrap=True)
    return 0
