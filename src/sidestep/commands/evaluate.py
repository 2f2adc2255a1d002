"""`sidestep evaluate`."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import tyro

from sidestep._bounds import EPISODES, SEED, SIDE_BY_SIDE, bounded
from sidestep.commands.common import (
    CountBar,
    Overrides,
    PolicyName,
    policy_and_scenario,
    stood_still,
    write_json_file,
)
from sidestep.commands.video import NO_VIDEO, VideoOptions, check_options, write_video

if TYPE_CHECKING:
    from rich.console import Console

    from sidestep.trials import Evaluation


@dataclass(frozen=True)
class Evaluate:
    """Measure a policy with a shield against a pursuer over random episodes, with 95 % bounds."""

    run: PolicyName = "goal-seeking"
    """Run folder whose policy to evaluate, pretrained, goal-seeking for the untrained one, or planner for one
    that knows the pursuer's strategy."""
    scenario: Annotated[str | None, tyro.conf.arg(metavar="NAME|FILE")] = None
    """Preset or file; the run's own scenario, or paper, by default."""
    shield: Annotated[str | None, tyro.conf.arg(metavar="NAME")] = None
    """Shield: none, paper, game or joint; the run's own, or joint, by default."""
    pursuer: Annotated[str | None, tyro.conf.arg(metavar="NAME")] = None
    """Pursuer strategy, hunter or the run folder of another trained one, or several joined by +; by default
    the run's own, or nash."""
    episodes: int = bounded(1000, EPISODES)
    """Episodes to measure."""
    seed: int = bounded(0, SEED)
    """Seed of starts, targets and random pursuers."""
    planner: bool = False
    """Also compare with the planner, which knows the pursuer's strategy; 100 episodes take half a minute."""
    batch: int = bounded(512, SIDE_BY_SIDE)
    """Episodes that run at once."""
    set: Overrides = ()
    """Scenario fields to change, such as evader_speed=0.18 obstacle_count=2."""
    json: Path | None = None
    """Also write the figures to this file."""
    log: Path | None = None
    """Also write one episode as an MCAP log of ROS 2 messages; never overwrites a file."""
    log_episode: int = bounded(0, least=0)
    """The number of the episode for --log."""
    video_episode: Annotated[str, tyro.conf.arg(metavar="NUMBER|worst")] = "0"
    """The episode for --video: its number, or worst for the one with the least clearance."""
    film: VideoOptions = NO_VIDEO


def run(command: Evaluate, console: Console) -> int:
    """Run `sidestep evaluate`; returns the exit status."""
    from sidestep.learning import load_pursuer
    from sidestep.loop import episode_key, rollout
    from sidestep.store.outputs import try_outputs
    from sidestep.trials import take_yardsticks

    check_options(command.film)
    try_outputs(files=[command.json], new=[command.log, command.film.video])
    policy, scenario, config = policy_and_scenario(command.run, command.scenario, command.set)
    if command.log_episode >= command.episodes:
        raise ValueError(
            f"log_episode = {command.log_episode}: it must be the number of an episode, 0 to "
            f"{command.episodes - 1}"
        )
    if command.video_episode != "worst" and not _is_number(command.video_episode, command.episodes):
        raise ValueError(
            f"video_episode = {command.video_episode}: it must be worst or the number of an episode, 0 to "
            f"{command.episodes - 1}"
        )
    shield = command.shield or config.get("shield", "joint")
    pursuer = command.pursuer or config.get("pursuer", "nash")
    strategy = load_pursuer(pursuer)
    yardsticks = take_yardsticks(
        scenario, policy, shield, strategy, command.episodes, command.seed, planner=command.planner,
        batch=command.batch, count_progress=lambda name: CountBar(console, f"{name}, {shield}, {pursuer}"),
    )  # fmt: skip
    evaluation, compared = yardsticks.evaluation, yardsticks.to_dict()
    console.print(evaluation_table(evaluation))
    console.print(time_table(evaluation.to_dict(), compared))
    about = {"policy": command.run, "shield": shield, "pursuer": pursuer, "scenario": scenario.name}
    figures = {**evaluation.to_dict(), "yardsticks": compared}
    write_json_file(command.json, {**figures, **about, "seed": command.seed})
    if command.log is not None:
        about = {**about, "seed": command.seed, "episode": command.log_episode, "source": "simulation"}
        _write_log(command, scenario, policy, strategy, about, console)
    if command.film.video is not None:
        number = _chosen(command.video_episode, evaluation)
        trajectory = rollout(scenario, policy, shield, strategy, episode_key(command.seed, number))
        write_video(command.film, scenario, trajectory, shield, console, f"episode {number}")
    return 0


def _is_number(text: str, episodes: int) -> bool:
    return text.isascii() and text.isdigit() and int(text) < episodes


def _chosen(episode: str, evaluation: Evaluation) -> int:
    """The number of an episode; for `worst` that of the least clearance."""
    if episode != "worst":
        return int(episode)
    import numpy as np

    return int(np.argmin(np.minimum(evaluation.min_pursuer_clearance, evaluation.min_obstacle_clearance)))


def _write_log(
    command: Evaluate, scenario: Any, policy: Any, strategy: Any, about: dict[str, Any], console: Console
) -> None:
    """Replay one of the measured episodes and log it."""
    from sidestep.bridges.logs import save_log
    from sidestep.loop import episode_key, rollout

    assert command.log is not None
    key = episode_key(command.seed, command.log_episode)
    trajectory = rollout(scenario, policy, about["shield"], strategy, key)
    save_log(trajectory, scenario, command.log, about=about)
    console.print(
        f"Log of episode {command.log_episode} ({trajectory.outcome.replace('_', ' ')}): {command.log}",
        highlight=False,
    )


def evaluation_table(evaluation: Evaluation) -> Any:
    """Counts and rates with their 95 % Wilson bounds."""
    from rich.table import Table

    figures = evaluation.to_dict()
    table = Table("outcome", "episodes", "share", "95 % bounds", title=f"{evaluation.episodes} episodes")
    for name in ("captured", "collided", "reached", "timed_out"):
        low, high = figures[f"{name}_rate_low"], figures[f"{name}_rate_high"]
        share = figures[f"{name}_rate"]
        table.add_row(name.replace("_", " "), str(figures[name]), f"{share:.2%}", f"{low:.2%} to {high:.2%}")
    median = figures["reach_time_median"]
    table.caption = (
        f"median time to reach {'-' if median is None else f'{median:.1f} s'}; "
        f"shield corrects {figures['intervention_rate']:.1%} of steps, cannot satisfy all rows in "
        f"{figures['infeasible_rate']:.2%}"
    )
    if figures["invalid_rate"]:
        table.caption += f", was given numbers that are not finite in {figures['invalid_rate']:.2%}"
    if figures["pursuer_invalid"]:
        table.caption += "; " + stood_still(figures["pursuer_invalid"], figures["pursuer_invalid_episodes"])
    return table


def time_table(figures: dict[str, Any], compared: dict[str, Any]) -> Any:
    """Times to the target of the policy (`Evaluation.to_dict`) and of the others (`Yardsticks.to_dict`)."""
    from rich.table import Table

    limit, straight = figures["time_limit"], figures["straight_time_mean"]
    times = [name for name in figures["reached_by"] if float(name) <= limit]
    others = {name: other for name, other in compared.items() if name != "share_of_planner"}
    table = Table("time to the target", "mean", *(f"within {time} s" for time in times), title="Same starts")
    for name, one in {"this policy": figures, **others}.items():
        shares = [f"{one['reached_by'][time]:.0%}" for time in times]
        table.add_row(name, f"{one['time_mean']:.1f} s", *shares)
    table.add_row("straight, alone", f"{straight:.1f} s")
    sentences = [f"An episode that does not reach the target counts {limit:g} s."]
    for name, other in others.items():
        mean, low, high = (other["difference"][part] for part in ("estimate", "low", "high"))
        sentences.append(
            f"Mean difference to {name}, start by start: {mean:+.1f} s ({low:+.1f} to {high:+.1f}, 95 % "
            f"bootstrap), {other['ratio']:.2f} of its time."
        )
    share = compared["share_of_planner"]
    if share is not None:
        sentences.append(
            f"That is {share['estimate']:.0%} ({share['low']:.0%} to {share['high']:.0%}) of the way from "
            "goal-seeking to the planner."
        )
    table.caption = " ".join(sentences)
    return table
