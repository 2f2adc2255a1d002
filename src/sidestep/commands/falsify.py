"""`sidestep falsify`."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import tyro

from sidestep._bounds import DURATION, EPISODES, SEED, SIDE_BY_SIDE, bounded
from sidestep._program import command as command_line
from sidestep.commands.common import (
    CountBar,
    Overrides,
    PolicyOption,
    ShieldName,
    given,
    going_on,
    resume_words,
    say,
    scenario_from,
    scenario_of_run,
    settings_from,
    stood_still,
    unless_given,
    write_json_file,
)
from sidestep.commands.video import NO_VIDEO, VideoOptions, check_options, write_video

if TYPE_CHECKING:
    from rich.console import Console

    from sidestep.trials.falsification import Falsification, Progress


@dataclass(frozen=True)
class Falsify:
    """Search for a pursuer and a start that break a shield; keep counterexamples for replay."""

    shield: ShieldName = unless_given("joint")
    """Shield to attack."""
    policy: PolicyOption = unless_given("goal-seeking")
    """Run folder whose policy steers the evader, pretrained, or goal-seeking for the untrained one."""
    out: Annotated[Path | None, tyro.conf.arg(metavar="FOLDER")] = None
    """Folder to write, never overwritten silently; runs/falsify-SHIELD by default."""
    scenario: Annotated[str | None, tyro.conf.arg(metavar="NAME|FILE")] = None
    """Preset (paper, paper-test, paper-0.10, paper-0.15) or a TOML or JSON file; the policy's own scenario,
    or paper, by default."""
    set: Overrides = ()
    """Scenario fields to change, such as evader_speed=0.18 obstacle_count=0."""
    goal: str = unless_given("both")
    """What counts: capture, collision or both."""
    attacks: Annotated[tuple[str, ...], tyro.conf.arg(metavar="[NAME ...]")] = ()
    """Attacks: pursuers, bang-bang, herder, sideswipe, cross-entropy, edge, learned; all by default."""
    minutes: float | None = bounded(None, DURATION)
    """Duration of the search; 3 unless --episodes is given. With --resume in addition to the time so far; the
    rest of the stored time if neither is given."""
    episodes: int | None = bounded(None, EPISODES)
    """Episodes after which each attack ends; with --resume the new total."""
    seconds: float = bounded(unless_given(60.0), DURATION)
    """Longest episode, in simulated seconds."""
    batch: int = bounded(unless_given(256), SIDE_BY_SIDE)
    """Episodes or plans at once; fewer make rounds shorter with a slow shield."""
    most: int = bounded(unless_given(5), least=1)
    """Counterexamples to keep per attack and outcome (more if they go deeper, or break no assumption)."""
    seed: int = bounded(unless_given(0), SEED)
    """Seed of everything random."""
    resume: bool = False
    """Resume the search in --out with its stored settings. Other options must agree with those."""
    replay: Annotated[Path | None, tyro.conf.arg(metavar="FILE")] = None
    """Replay this counterexample, check that it ends the same, and draw it. No search."""
    json: Path | None = None
    """Also write the figures to this file."""
    film: VideoOptions = NO_VIDEO


def run(command: Falsify, console: Console) -> int:
    """Run `sidestep falsify`; returns the exit status."""
    from sidestep.store.outputs import try_outputs

    check_options(command.film)
    if command.film.video is not None and command.replay is None:
        raise ValueError("--video shows one counterexample: give it with --replay")
    out = command.out or Path("runs") / f"falsify-{command.shield}"
    if command.replay is not None:
        out = command.out or command.replay.parent
    try_outputs(files=[command.json], new=[command.film.video], folders=[out])
    if command.replay is not None:
        return _replay(command, console)
    from sidestep.store.runs import writing

    with going_on(console, out, *resume_words("falsify", out, command.json)):
        with writing(out, resume=command.resume):
            found = _search(command, out, console)
        if found.interrupted:
            raise KeyboardInterrupt
    if found.had_ended:
        longer = command_line("falsify", "--out", out, "--resume", "--minutes", 3)
        say(console, f"{out}: the search had already used its time or episodes. To search longer: {longer}")
    if found.counterexamples:
        first = command_line("falsify", "--replay", found.counterexamples[0])
        say(console, f"{len(found.counterexamples)} in {out}; next: {first}")
    return 1 if found.inside else 0


def _search(command: Falsify, out: Path, console: Console) -> Falsification:
    """Run the search, print its table and draw its figures."""
    from sidestep.trials.falsification import (
        ATTACKS,
        Plan,
        certified_clearance,
        check_plan,
        falsify,
        search_settings,
    )

    stored = search_settings(out) if command.resume else None
    settings = settings_from(command, "shield", "policy", stored=stored)
    scenario = settings["scenario"] = _scenario(command, settings.get("scenario"))
    names = ("seed", "goal", "attacks", "batch", "seconds", "most")
    if stored is None:
        asked = settings_from(command, *names)
        plan = Plan(**{**asked, "attacks": command.attacks or ATTACKS})
        check_plan(scenario, plan, command.minutes, command.episodes)
        # This takes seconds.
        plan = replace(plan, guaranteed_clearance=certified_clearance(scenario, settings["shield"]))
    else:
        plan = replace(stored["plan"], **given(command, *names))
    with SearchBar(console) as show:
        found = falsify(
            **{**settings, "plan": plan},
            out=out,
            minutes=command.minutes,
            episodes=command.episodes,
            resume=command.resume,
            progress=show,
        )
    console.print(attack_table(found))
    for line in findings(found):
        console.print(line, highlight=False)
    write_json_file(command.json, found.summary)
    _draw_all(found, console)
    return found


def _scenario(command: Falsify, stored: Any) -> Any:
    """As `scenario_from` for a search that is resumed, else as `scenario_of_run` of the policy."""
    if stored is not None:
        return scenario_from(command, stored)
    run = None if command.policy == "goal-seeking" else command.policy
    return scenario_of_run(run, command.scenario, command.set)[0]


class SearchBar:
    """Attack, episodes, steps per second, least clearances and counterexamples, on the error stream."""

    def __init__(self, console: Console):
        from rich.console import Console as RichConsole
        from rich.progress import BarColumn, TextColumn, TimeElapsedColumn
        from rich.progress import Progress as RichProgress

        self._bar = RichProgress(
            TextColumn("{task.description}"),
            BarColumn(bar_width=16),
            TextColumn("{task.fields[note]}"),
            TimeElapsedColumn(),
            console=RichConsole(stderr=True),
        )
        self._task = self._bar.add_task("falsify", total=None, note="compiling")

    def __enter__(self) -> Any:
        self._bar.__enter__()
        return self.update

    def update(self, progress: Progress) -> None:
        """Show the progress."""
        tally = progress.tally
        speed = tally.control_periods / max(tally.seconds, 1e-9)
        least = min(each.pursuer_clearance for each in progress.tallies.values())
        note = (
            f"{tally.episodes} episodes  {speed:,.0f} steps/s  least clearance {_millimetres(least)}  "
            f"found {progress.counterexamples}"
        )
        done = None if progress.budget is None else min(progress.seconds, progress.budget)
        self._bar.update(
            self._task, description=progress.attack, total=progress.budget, completed=done, note=note
        )

    def __exit__(self, *error: Any) -> None:
        self._bar.__exit__(*error)


def _millimetres(metres: float | None) -> str:
    from math import isfinite

    if metres is None or not isfinite(metres):
        return "-"
    return f"{1e3 * metres:.3g} mm" if abs(metres) < 1.0 else f"{metres:.3g} m"


def attack_table(found: Falsification) -> Any:
    """The results of each attack."""
    from rich.box import SIMPLE_HEAD
    from rich.table import Table

    summary = found.summary
    title = f"Attacks on the shield {summary['shield']}"
    table = Table(box=SIMPLE_HEAD, title=title, pad_edge=False, collapse_padding=True)
    table.add_column("attack", no_wrap=True)
    for name in ("episodes", "caught", "hit", "pursuer", "margin", "obstacle", "kept"):
        table.add_column(name, justify="right", no_wrap=True)
    for name, tally in summary["attacks"].items():
        counts = [str(tally[count]) for count in ("episodes", "captured", "collided")]
        least = [tally[which] for which in ("pursuer_clearance", "margin", "obstacle_clearance")]
        shown = ["-" if metres is None else f"{1e3 * metres:.3g}" for metres in least]
        table.add_row(name, *counts, *shown, str(tally["kept"]))
    table.caption = (
        "captured, collided; in mm the least clearance from the pursuer, margin to its capture set and "
        "clearance from an obstacle; "
        f"{summary['control_periods']:,} control periods in {summary['seconds']:.0f} s, "
        f"seed {summary['seed']}, goal {summary['goal']}"
    )
    return table


def findings(found: Falsification) -> list[str]:
    """The counterexamples by broken assumption, in words."""
    from sidestep.trials.falsification import ASSUMPTIONS

    summary = found.summary
    lines = []
    if summary["pursuer_invalid"]:
        lines.append(f"Warning: {stood_still(summary['pursuer_invalid'])}.")
    if not summary["counterexamples"]:
        return [*lines, f"No counterexample in {summary['episodes']} episodes."]
    lines += [f"First counterexample after {summary['first_seconds']:.1f} s, compiling included."]
    for name, count in summary["by_assumption"].items():
        if name in ASSUMPTIONS:
            lines.append(f"  {count} broke the assumption that {ASSUMPTIONS[name]}")
        else:
            lines.append(f"  {count} broke no assumption: theory or code is wrong")
    return lines


def _draw_all(found: Falsification, console: Console) -> None:
    """Draw the counterexamples that have no figure yet."""
    from sidestep.trials.falsification import read_counterexample, replay

    missing = [
        path
        for path in found.counterexamples
        if not (found.folder / "figures" / f"{path.stem}.png").is_file()
    ]
    if not missing:
        return
    with CountBar(console, "figures") as show:
        for number, path in enumerate(missing, start=1):
            counterexample = read_counterexample(path)
            played = replay(counterexample)
            draw(counterexample, played, found.folder / "figures" / path.stem)
            show(number, len(missing))


def draw(counterexample: Any, played: Any, path: Path) -> Path:
    """Draw a replayed counterexample; returns the PNG."""
    from sidestep.trials.falsification import ASSUMPTIONS
    from sidestep.views.counterexample_figure import counterexample_figure

    about = counterexample.about
    broken = ASSUMPTIONS.get(about["assumption"], "")
    words = f"Broken: {broken}" if broken else "No assumption was broken"
    png, _ = counterexample_figure(
        played.scenario, played.trajectory, path, shield=about["shield"], words=words
    )
    return png


def _replay(command: Falsify, console: Console) -> int:
    from sidestep.trials.falsification import ASSUMPTIONS, read_counterexample, replay

    assert command.replay is not None
    counterexample = read_counterexample(command.replay)
    about = counterexample.about
    policy = None if command.policy == "goal-seeking" else command.policy
    played = replay(counterexample, policy=policy)
    trajectory = played.trajectory
    outcome = f"{about['outcome'].replace('_', ' ')} after {about['time']:.2f} s"
    console.print(
        f"Shield {about['shield']}, policy {about['policy']['name']}, found by {about['attack']} "
        f"(seed {about['seed']}): {outcome}",
        highlight=False,
    )
    if played.exact:
        console.print("Played again: the same, to the last bit.")
    elif played.same:
        console.print("Played again: the same outcome in the same period; the last digits differ.")
    else:
        seconds = trajectory.length * float(played.scenario.control_period)
        console.print(f"Played again: NOT the same: {trajectory.outcome} after {seconds:.2f} s.")
    console.print(
        f"Least clearance from the pursuer {_millimetres(about['pursuer_clearance'])}, "
        f"from an obstacle {_millimetres(about['obstacle_clearance'])}.",
        highlight=False,
    )
    if about["assumption"] is None:
        console.print(f"It broke no assumption of the shield: {about['words']}.", highlight=False)
    else:
        broken = ASSUMPTIONS.get(about["assumption"], about["assumption"])
        console.print(f"Assumption broken: {broken}. Here {about['words']}.", highlight=False)
    folder = command.out or command.replay.parent
    console.print(f"Figure: {draw(counterexample, played, folder / command.replay.stem)}", highlight=False)
    write_video(command.film, played.scenario, trajectory, about["shield"], console)
    facts = {**about, "same": played.same, "exact": played.exact}
    write_json_file(command.json, facts)
    return 0 if played.same else 1
