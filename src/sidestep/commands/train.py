"""`sidestep train`."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from sidestep._bounds import EPISODES, SEED, bounded
from sidestep._program import command as command_line
from sidestep.commands.common import (
    Overrides,
    PolicyOption,
    PursuerName,
    ScenarioName,
    ShieldName,
    TrainingBar,
    going_on,
    options_from,
    parse_overrides,
    resume_words,
    say,
    scenario_from,
    settings_from,
    stood_still,
    unless_given,
    write_json_file,
)

if TYPE_CHECKING:
    from rich.console import Console


@dataclass(frozen=True)
class Train:
    """Train a policy with TD3 behind a shield, or a pursuer against a policy."""

    out: Path
    """Run folder to write; never overwritten silently."""
    scenario: ScenarioName = unless_given("paper")
    """Preset (paper, paper-test, paper-0.10, paper-0.15, quadrotor, quadrotor-test) or a TOML or JSON
    file."""
    shield: ShieldName = unless_given("joint")
    """Shield during training: none, paper, game or joint."""
    pursuer: PursuerName = unless_given("nash")
    """Pursuer: nash, turn-then-drive, turn-while-driving, pure-pursuit, interceptor, random, still; mixed,
    one after another; chauffeur for robots that cannot turn on the spot; hunter, a trained one; the run
    folder of another; or several joined by +, such as mixed+hunter."""
    episodes: int = bounded(unless_given(200), EPISODES)
    """Training episodes; with --resume the new total, if larger."""
    seed: int = bounded(unless_given(0), SEED)
    """Seed of everything random; the same seed gives the same run on the same machine."""
    set: Overrides = ()
    """Scenario fields to change, such as evader_speed=0.18 obstacle_count=2."""
    learner: Overrides = ()
    """Training options to change, such as discount=0.98 updates_per_decision=3."""
    warm_start: Path | None = None
    """Run folder whose networks the training begins with, such as one behind a cheaper shield."""
    against: PolicyOption | None = None
    """Train a pursuer instead, against an evader that drives by this policy behind the shield; --pursuer then
    drives the guided worlds."""
    vary: Overrides = ()
    """Scenario fields that every episode draws anew, such as capture_distance=[0.1,0.2] obstacle_count=[0,5];
    see the documentation for which."""
    resume: bool = False
    """Resume the run in --out, bit for bit, with its stored settings. Other options must agree with those."""
    json: Path | None = None
    """Also write the summary to this file."""


def run(command: Train, console: Console) -> int:
    """Run `sidestep train`; returns the exit status."""
    from sidestep.learning import resume_settings
    from sidestep.learning import train as run_training
    from sidestep.store.outputs import try_outputs

    try_outputs(files=[command.json], folders=[command.out])
    going = going_on(console, command.out, *resume_words("train", command.out, command.json))
    with going:
        stored = resume_settings(command.out) if command.resume else None
        settings = settings_from(
            command, "shield", "pursuer", "seed", "episodes", "warm_start", "against", stored=stored
        )
        settings["vary"] = parse_overrides(command.vary) or settings.get("vary")
        settings["scenario"] = scenario_from(command, settings.get("scenario"))
        settings["options"] = options_from(command, settings.get("options"))
        with TrainingBar(console, f"training, {settings['shield']}") as show:
            training = run_training(**settings, out=command.out, resume=command.resume, progress=show)
        console.print(training_table(training.summary))
        write_json_file(command.json, training.summary)
        if training.interrupted:
            raise KeyboardInterrupt
    if training.had_ended:
        more = command_line("train", "--out", command.out, "--resume", "--episodes", 2 * settings["episodes"])
        say(console, f"{command.out} had its {settings['episodes']} episodes already. To train on: {more}")
        return 0
    if settings["against"] is None:
        what, words = "Policy", ["evaluate", command.out]
    else:
        what, words = "Pursuer", ["evaluate", settings["against"], "--pursuer", command.out]
    say(console, f"{what} and summary in {command.out}; next: {command_line(*words)}")
    return 0


def training_table(summary: dict[str, Any]) -> Any:
    """The results of one training as a table."""
    from rich.table import Table

    table = Table(
        title=f"Training, {summary['shield']} shield, {summary['pursuer']} pursuer", show_header=False
    )
    for key in (
        "episodes", "safe_episodes", "captured", "collided", "reached", "timed_out", "converged_episode",
        "converged_stays_from", "final_return", "min_pursuer_clearance", "min_obstacle_clearance",
        "intervention_rate", "mean_correction", "infeasible_rate", "invalid_rate", "env_steps",
        "wall_seconds",
    ):  # fmt: skip
        value = summary[key]
        shown = "never" if value is None and key.startswith("converged") else value
        table.add_row(key.replace("_", " "), f"{shown:.4g}" if isinstance(shown, float) else str(shown))
    if summary["pursuer_invalid"]:
        table.caption = f"Warning: {stood_still(summary['pursuer_invalid'])}"
    return table
