"""What `sidestep twin` and `sidestep fly` share: options, episodes, figures and files."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import nullcontext
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from sidestep import _interrupts
from sidestep._bounds import EPISODES, SEED, SPEED_UP, bounded
from sidestep.commands.common import (
    CountBar,
    Overrides,
    PolicyName,
    PursuerName,
    ScenarioName,
    ShieldName,
    policy_and_scenario,
    stood_still,
    write_json_file,
)

if TYPE_CHECKING:
    from rich.console import Console

    from sidestep.plants import PlantEpisode


@dataclass(frozen=True)
class PhysicsCommand:
    """Options of a command that plays episodes in a physics simulator."""

    run: PolicyName = "goal-seeking"
    """Run folder whose policy to use, pretrained, or goal-seeking for the untrained one."""
    scenario: ScenarioName = "paper-test"
    """Preset or file."""
    shield: ShieldName = "joint"
    """Shield: none, paper, game or joint."""
    pursuer: PursuerName = "nash"
    """Pursuer strategy."""
    set: Overrides = ()
    """Scenario fields to change, such as capture_distance=0.15."""
    noise: Overrides = ()
    """Fields of the sensors to change, such as position_noise=0.005 delay=0.05."""
    pursuer_sees: Literal["truth", "measurements"] = "truth"
    """What the pursuer decides from: the true world, or the evader's measurements."""
    seeds: int = bounded(1, EPISODES)
    """Episodes, with the seeds from --seed on."""
    seed: int = bounded(0, SEED)
    """First seed, of starts and measurements."""
    steps: int | None = bounded(None, least=1, whole=True)
    """Largest number of control periods; the scenario's episode_steps by default."""
    out: Path | None = None
    """Folder for a figure that compares the first episode with the simulation, and for its recording."""
    video: Path | None = None
    """Also render the first episode into this .mp4, .gif or .webp file."""
    speed: float = bounded(2.0, SPEED_UP)
    """Speed of the video as a factor on real time."""
    rate: int = bounded(25, least=1, most=120)
    """Pictures per second of the video."""
    width: int = bounded(960, least=64, most=1920, unit="pixels")
    """Width of the video in pixels; 16 by 9."""
    json: Path | None = None
    """Also write the figures to this file."""


@dataclass(frozen=True)
class Plan:
    """What is specific to a command.

    - `prepare()` returns the player that decides for the robot, `play(player, seed)` plays an episode
    - `robots` that move, with their `options`; `report`, further entries of the report
    - `episodes`, the word for them in messages, and `key`, in the report
    - `stem` and `looks` of the figure, whose simulation uses `shield_of(player)`
    - `counts` summarises the episodes' figures, `say` prints the summary
    """

    prepare: Callable[[], Any]
    play: Callable[[Any, int], PlantEpisode]
    robots: str
    options: Any
    report: dict[str, Any]
    episodes: str
    key: str
    stem: str
    looks: dict[str, Any]
    shield_of: Callable[[Any], Any]
    counts: Callable[[list[dict[str, Any]]], dict[str, Any]]
    say: Callable[[dict[str, Any]], None] = lambda counts: None


def run_on_plant(
    command: PhysicsCommand, source: str, plan_of: Callable[[Any, Any], Plan], console: Console
) -> int:
    """Run the plan of `plan_of(policy, scenario)`; returns the exit status. `source` is stored in recordings.

    Amounts are checked first; the output folder is locked during the run.
    """
    from sidestep.store.lock import hold

    check_amounts(command)
    with nullcontext() if command.out is None else hold(command.out):
        policy, scenario, _ = policy_and_scenario(command.run, command.scenario, command.set)
        plan = plan_of(policy, scenario)
        player, first, figures, interrupted = play_seeds(command, plan, console)
        counts = plan.counts(figures)
        episode_table(figures, counts, plan.episodes, console)
        plan.say(counts)
        report = {**setting(command, scenario, plan.options), **plan.report, **counts, plan.key: figures}
        write_json_file(command.json, report)
        if interrupted:
            words = plan.episodes.split()[0]
            console.print(f"Interrupted: {len(figures)} of {command.seeds} {words}.", highlight=False)
            return 130
        about = {"shield": command.shield, "pursuer": command.pursuer, "source": source}
        if log := getattr(command, "log", None):
            from sidestep.bridges.logs import save_log

            save_log(
                first.trajectory, scenario, log, about=about | {"seed": first.seed},
                levels=first.levels, reactions=first.reactions,
            )  # fmt: skip
            console.print(f"Log: {log}", soft_wrap=True)
        if command.out is not None:
            from sidestep.loop import rollout, save_trajectory
            from sidestep.views import twin_figure

            stem, shield = command.out / plan.stem, plan.shield_of(player)
            simulation = rollout(scenario, policy, shield, command.pursuer, first.seed, steps=command.steps)
            save_trajectory(stem.with_suffix(".npz"), first.trajectory, scenario, about)
            png, pdf = twin_figure(
                scenario, simulation, first.trajectory, stem, shield=command.shield, **plan.looks
            )
            console.print(f"Figure: {png} and {pdf}", soft_wrap=True)
        if command.video is not None:
            from sidestep.plants.video import write_video

            size = (round(command.width * 9 / 32) * 2, command.width)
            path = write_video(first, command.video, rate=command.rate, speed=command.speed, size=size)
            console.print(f"Video: {path}", soft_wrap=True)
        return 0


def check_amounts(command: PhysicsCommand) -> None:
    """**Raises** `ValueError` for an invalid number of seeds or an invalid output."""
    from sidestep._arrays import whole_number

    whole_number("seeds", command.seeds, most=2**32 - command.seed)
    if command.width % 2:
        raise ValueError(f"width = {command.width}: it must be an even number of pixels")
    if command.video is not None:
        from sidestep.views.video_files import check_video

        check_video(command.video)
    from sidestep.store.outputs import try_outputs

    log = getattr(command, "log", None)
    try_outputs(files=[command.json, command.video], new=[log], folders=[command.out])


@_interrupts.held()
def play_seeds(
    command: PhysicsCommand, plan: Plan, console: Console
) -> tuple[Any, Any, list[dict[str, Any]], bool]:
    """Play all seeds. Returns the player, the first episode, the figures of all, and whether it was
    interrupted.

    Prints the warnings of the shield's budget once. After Ctrl-C the episodes played so far are returned, if
    there are any.
    """
    import warnings

    from sidestep.safety.barriers.budget import BudgetWarning

    figures: list[dict[str, Any]] = []
    first, interrupted = None, False
    with (
        warnings.catch_warnings(record=True) as warned,
        CountBar(console, f"{command.shield} shield, {command.pursuer}, {plan.robots}") as show,
    ):
        warnings.simplefilter("always", BudgetWarning)
        player = plan.prepare()
        try:
            for number in range(command.seeds):
                _interrupts.check()
                episode = plan.play(player, command.seed + number)
                first = first or episode
                figures.append(episode.to_dict())
                show(number + 1, command.seeds)
        except KeyboardInterrupt:
            interrupted = True
            if first is None:
                raise
    for text in dict.fromkeys(str(one.message) for one in warned):
        console.print(f"Warning: {text}.", highlight=False)
    return player, first, figures, interrupted


def setting(command: PhysicsCommand, scenario: Any, options: Any) -> dict[str, Any]:
    """The settings, for the report."""
    import importlib.metadata
    from dataclasses import asdict

    from sidestep.world import scenario_to_dict

    return {
        "policy": command.run,
        "shield": command.shield,
        "pursuer": command.pursuer,
        "scenario": scenario_to_dict(scenario),
        "options": asdict(options),
        "versions": {name: importlib.metadata.version(name) for name in ("sidestep", "mujoco", "jax")},
    }


def outcome_counts(figures: list[dict[str, Any]]) -> dict[str, Any]:
    """Counts of outcomes with 95 % bounds of the shares, and the least distances (m); None without a
    robot."""
    from sidestep.store.runs import OUTCOMES
    from sidestep.trials import wilson_interval

    counts: dict[str, Any] = {"episodes": len(figures)}
    for name in (*OUTCOMES, "cut"):
        count = sum(figure["outcome"] == name for figure in figures)
        low, high = wilson_interval(count, len(figures))
        counts |= {name: count, f"{name}_rate_low": low, f"{name}_rate_high": high}
    for name in ("least_pursuer_distance", "least_obstacle_distance"):
        counts[name] = min((one[name] for one in figures if one[name] is not None), default=None)
    return counts


def episode_table(figures: list[dict[str, Any]], counts: dict[str, Any], what: str, console: Console) -> None:
    """Print a line per episode, and the counts with 95 % bounds."""
    from rich.table import Table

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
    still = sum(figure["pursuer_invalid"] for figure in figures)
    if still:
        console.print(f"Warning: {stood_still(still)}.", highlight=False)
