"""What `sidestep twin` and `sidestep fly` share: episodes in a physics simulator, one seed after another."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager, nullcontext
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from sidestep import _interrupts
from sidestep.commands.common import CountBar, stood_still

if TYPE_CHECKING:
    from rich.console import Console

    from sidestep.commands.fly import Fly
    from sidestep.commands.twin import Twin
    from sidestep.plants import PlantEpisode


@dataclass(frozen=True)
class Played:
    """`player` who decided for the robot, `first` episode, `figures` of all, and whether it was `interrupted`
    before the last."""

    player: Any
    first: Any
    figures: list[dict[str, Any]]
    interrupted: bool


def check_amounts(command: Twin | Fly) -> None:
    """**Raises** `ValueError` for a number of seeds, or an output, that there cannot be."""
    from sidestep._arrays import seed_number, whole_number

    seed_number(command.seed)
    whole_number("seeds", command.seeds, most=2**32 - command.seed)
    if command.steps is not None:
        whole_number("steps", command.steps)
    if not command.speed > 0.0:
        raise ValueError(f"speed = {command.speed}: it must be greater than 0")
    if command.rate < 1 or not 64 <= command.width <= 1920 or command.width % 2:
        raise ValueError(
            f"rate = {command.rate}, width = {command.width}: the rate must be at least 1, the width an even "
            "number from 64 to 1920"
        )
    if command.video is not None:
        from sidestep.views.video_files import check_video

        check_video(command.video)
    from sidestep.store.outputs import try_outputs

    log = getattr(command, "log", None)
    try_outputs(files=[command.json, command.video], new=[log], folders=[command.out])


@contextmanager
def checked(command: Twin | Fly) -> Iterator[None]:
    """While this lasts, the folder that the command writes is held; its amounts are checked before."""
    from sidestep.store.lock import hold

    check_amounts(command)
    with nullcontext() if command.out is None else hold(command.out):
        yield


def video_options(command: Twin | Fly) -> dict[str, Any]:
    """Speed, rate and size of the video, as `write_video` takes them."""
    size = (round(command.width * 9 / 32) * 2, command.width)
    return {"speed": command.speed, "rate": command.rate, "size": size}


@_interrupts.held()
def play_seeds(
    command: Twin | Fly,
    robots: str,
    prepare: Callable[[], Any],
    play: Callable[[Any, int], PlantEpisode],
    console: Console,
) -> Played:
    """`play(player, seed)` for all the command's seeds, with the player that `prepare()` makes.

    Says once what its shield's budget is warned of. After Ctrl-C what was played counts, if anything was.
    """
    import warnings

    from sidestep.safety.barriers.budget import BudgetWarning

    figures: list[dict[str, Any]] = []
    first, interrupted = None, False
    with (
        warnings.catch_warnings(record=True) as warned,
        CountBar(console, f"{command.shield} shield, {command.pursuer}, {robots}") as show,
    ):
        warnings.simplefilter("always", BudgetWarning)
        player = prepare()
        try:
            for number in range(command.seeds):
                _interrupts.check()
                episode = play(player, command.seed + number)
                first = first or episode
                figures.append(episode.to_dict())
                show(number + 1, command.seeds)
        except KeyboardInterrupt:
            interrupted = True
            if first is None:
                raise
    for text in dict.fromkeys(str(one.message) for one in warned):
        console.print(f"Warning: {text}.", highlight=False)
    return Played(player, first, figures, interrupted)


def setting(command: Twin | Fly, scenario: Any, options: Any) -> dict[str, Any]:
    """What was run, for the report."""
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


def draw_beside_simulation(
    command: Twin | Fly,
    policy: Any,
    shield: Any,
    episode: PlantEpisode,
    stem: Path,
    about: dict[str, Any],
    console: Console,
    **looks: Any,
) -> None:
    """`stem`.npz, a recording of the episode, and `stem`.png and .pdf, the plain simulation beside it."""
    from sidestep.loop import rollout, save_trajectory
    from sidestep.views import twin_figure

    scenario = episode.scenario
    simulation = rollout(scenario, policy, shield, command.pursuer, episode.seed, steps=command.steps)
    save_trajectory(stem.with_suffix(".npz"), episode.trajectory, scenario, about)
    png, pdf = twin_figure(scenario, simulation, episode.trajectory, stem, shield=command.shield, **looks)
    console.print(f"Figure: {png} and {pdf}", soft_wrap=True)


def about_of(command: Twin | Fly, source: str) -> dict[str, Any]:
    """What recordings say of where they come from."""
    return {"shield": command.shield, "pursuer": command.pursuer, "source": source}


def outcome_counts(figures: list[dict[str, Any]]) -> dict[str, Any]:
    """Counts over episodes with 95 % bounds of the shares, and the least distances (m); None without one."""
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


def episode_table(figures: list[dict[str, Any]], what: str, console: Console) -> None:
    """A line for every episode, and the counts of all with 95 % bounds."""
    from rich.table import Table

    counts = outcome_counts(figures)
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
