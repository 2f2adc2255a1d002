"""`sidestep twin`."""

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
    write_json_file,
)

if TYPE_CHECKING:
    from rich.console import Console

    from sidestep.bridges.twin import TwinEpisode


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
    """Also render the first episode into this MP4 file."""
    speed: float = 2.0
    """How many times faster the video runs."""
    log: Path | None = None
    """Also write the first episode as an MCAP log of ROS 2 messages; never over a file that exists."""
    json: Path | None = None
    """Also write the figures to this file."""


def run(command: Twin, console: Console) -> int:
    """Run `sidestep twin`; returns the exit status."""
    import warnings
    from dataclasses import replace

    from sidestep.bridges.onboard import Onboard
    from sidestep.bridges.twin import TwinOptions, make_sensors, settings_for, twin_episode, write_video
    from sidestep.learning import load_policy
    from sidestep.safety import Budget
    from sidestep.safety.budget import BudgetWarning
    from sidestep.world import load_scenario

    if command.seeds < 1:
        raise ValueError(f"seeds = {command.seeds}: at least 1 is needed")
    if not command.speed > 0.0:
        raise ValueError(f"speed = {command.speed}: it must be greater than 0")
    if command.log is not None and command.log.exists():
        raise ValueError(f"{command.log} exists already; give the log another name")
    scenario = load_scenario(command.scenario, **parse_overrides(command.set))
    scenario.check_built_in("the twin", "`sidestep fly` flies a quadrotor")
    policy: Any = command.run if command.run == "goal-seeking" else load_policy(command.run)
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
    figures: list[dict[str, Any]] = []
    first, interrupted = None, False
    with (
        warnings.catch_warnings(record=True) as warned,
        CountBar(console, f"{command.shield} shield, {command.pursuer}, {command.base}") as show,
    ):
        warnings.simplefilter("always", BudgetWarning)
        onboard = Onboard(scenario, command.shield, policy, settings)
        onboard.warm_up()
        try:
            for number in range(command.seeds):
                seed = command.seed + number
                episode = twin_episode(onboard, command.pursuer, seed, options, command.steps)
                first = first or episode
                figures.append(episode.to_dict())
                show(number + 1, command.seeds)
        except KeyboardInterrupt:
            interrupted = True
            if first is None:
                raise
    assert first is not None
    for text in dict.fromkeys(str(one.message) for one in warned):
        console.print(f"Warning: {text}.", highlight=False)
    episode_table(figures, "episodes on the twin", console)
    write_json_file(command.json, _report(command, scenario, options, settings, figures))
    if interrupted:
        console.print(f"Interrupted: {len(figures)} of {command.seeds} episodes.", highlight=False)
        return 130
    if command.log is not None:
        from sidestep.bridges.logs import save_log

        save_log(
            first.trajectory, scenario, command.log, about=_about(command) | {"seed": first.seed},
            levels=first.levels, reactions=first.reactions,
        )  # fmt: skip
        console.print(f"Log: {command.log}", soft_wrap=True)
    if command.out is not None:
        _draw(command, scenario, policy, first, command.out, console)
    if command.video is not None:
        path = write_video(first, command.video, speed=command.speed)
        console.print(f"Video: {path}", soft_wrap=True)
    return 0


def _draw(
    command: Twin, scenario: Any, policy: Any, episode: TwinEpisode, folder: Path, console: Console
) -> None:
    from sidestep.trials import rollout, save_trajectory
    from sidestep.views import twin_figure

    simulation = rollout(scenario, policy, command.shield, command.pursuer, episode.seed, steps=command.steps)
    folder.mkdir(parents=True, exist_ok=True)
    save_trajectory(folder / "twin.npz", episode.trajectory, scenario, _about(command))
    words = f"physics twin, {command.base}, {command.sensors}"
    png, pdf = twin_figure(
        scenario, simulation, episode.trajectory, folder / "twin", shield=command.shield, twin_words=words
    )
    console.print(f"Figure: {png} and {pdf}", soft_wrap=True)


def _about(command: Twin) -> dict[str, Any]:
    return {"shield": command.shield, "pursuer": command.pursuer, "source": "sidestep twin"}


def _report(
    command: Twin, scenario: Any, options: Any, settings: Any, figures: list[dict[str, Any]]
) -> dict[str, Any]:
    import importlib.metadata
    from dataclasses import asdict

    from sidestep.world import scenario_to_dict

    budget = {
        name: float(getattr(settings.budget, name))
        for name in ("position_error", "heading_error", "delay", "tracking_error")
    }
    return {
        "policy": command.run,
        "shield": command.shield,
        "pursuer": command.pursuer,
        "scenario": scenario_to_dict(scenario),
        "options": asdict(options),
        "budget": budget,
        "versions": {name: importlib.metadata.version(name) for name in ("sidestep", "mujoco", "jax")},
        **twin_counts(figures),
        "episodes_each": figures,
    }


def twin_counts(figures: list[dict[str, Any]]) -> dict[str, Any]:
    """Counts over episodes with 95 % bounds of the shares, and the least distances (m); None without one."""
    from sidestep.learning.records import OUTCOMES
    from sidestep.trials import wilson_interval

    counts: dict[str, Any] = {"episodes": len(figures)}
    for name in (*OUTCOMES, "cut"):
        count = sum(figure["outcome"] == name for figure in figures)
        low, high = wilson_interval(count, len(figures))
        counts |= {name: count, f"{name}_rate_low": low, f"{name}_rate_high": high}
    for name in ("least_pursuer_distance", "least_obstacle_distance"):
        counts[name] = min((one[name] for one in figures if one[name] is not None), default=None)
    return counts


def episode_table(figures: list[dict[str, Any]], what: str, console: Console) -> None:
    """A line for every episode, and the counts of all with 95 % bounds."""
    from rich.table import Table

    counts = twin_counts(figures)
    for figure in figures:
        least = [
            f", least distance to a{word} {figure[name]:.4f} m"
            for word, name in (
                (" pursuer", "least_pursuer_distance"),
                ("n obstacle", "least_obstacle_distance"),
            )
            if figure[name] is not None
        ]
        outcome = figure["outcome"].replace("_", " ")
        console.print(
            f"seed {figure['seed']}: {outcome} after {figure['duration']:.2f} s{''.join(least)}",
            highlight=False,
        )
    table = Table("outcome", "episodes", "95 % bounds", title=f"{counts['episodes']} {what}")
    for name in ("captured", "collided", "reached", "timed_out", "cut"):
        if name == "cut" and not counts["cut"]:
            continue
        low, high = counts[f"{name}_rate_low"], counts[f"{name}_rate_high"]
        table.add_row(name.replace("_", " "), str(counts[name]), f"{low:.2%} to {high:.2%}")
    console.print(table)
