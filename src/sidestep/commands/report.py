"""`sidestep report`."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import tyro

from sidestep.commands.video import NO_VIDEO, VideoOptions, check_options, write_video

if TYPE_CHECKING:
    from rich.console import Console


@dataclass(frozen=True)
class Report:
    """Write the figures and the self-contained HTML report of one or several runs, or of one episode."""

    runs: Annotated[tuple[Path, ...], tyro.conf.Positional, tyro.conf.arg(metavar="RUN [RUN ...]|EPISODE")]
    """Run folders, or the folder of a reproduction; or one episode: an MCAP log, or the .npz recording of the
    live page, of the twin or in a run folder."""
    out: Path | None = None
    """HTML file to write; report.html in the first folder, or beside the episode, by default."""
    film: VideoOptions = NO_VIDEO


def run(command: Report, console: Console) -> int:
    """Run `sidestep report`; returns the exit status."""
    from sidestep.learning.records import open_run
    from sidestep.views import write_report

    check_options(command.film)
    if any(path.suffix in (".mcap", ".npz") for path in command.runs):
        return _report_episode(command, console)
    if command.film.video is not None:
        raise ValueError("--video shows one episode: give its log or recording instead of a run")
    folders: list[Path] = []
    for folder in command.runs:
        study = open_run(folder).get("study")
        folders += [folder] if study is None else [folder / shield for shield in study]
    path = command.out or command.runs[0] / "report.html"
    console.print(f"Report with figures: {write_report(folders, path)}")
    return 0


def _report_episode(command: Report, console: Console) -> int:
    from sidestep.views import write_episode_report

    path, *others = command.runs
    if others:
        raise ValueError("a report is of runs or of one episode")
    scenario, trajectory, about, notes = _read_episode(path)
    out = command.out or path.with_suffix(".html")
    title = f"{'Log' if path.suffix == '.mcap' else 'Recording'} {path.stem}"
    written = write_episode_report(scenario, trajectory, out, title=title, about=about, notes=notes)
    for note in notes:
        console.print(f"Not in the log: {note}.", highlight=False)
    console.print(f"Report with figure: {written}", highlight=False)
    write_video(command.film, scenario, trajectory, str(about.get("shield", "")), console)
    return 0


def _read_episode(path: Path) -> tuple[Any, Any, Mapping[str, Any], Sequence[str]]:
    """Scenario, trajectory, what is said of them, and what had to be worked out."""
    if path.suffix == ".mcap":
        from sidestep.bridges.logs import load_log

        log = load_log(path)
        return log.scenario, log.trajectory, log.about, log.rebuilt
    from sidestep.learning.records import open_run
    from sidestep.trials import load_episode
    from sidestep.world import load_scenario

    if not path.is_file():
        raise ValueError(f"there is no recording {path}")
    try:
        episode = load_episode(path)
    except ValueError as error:
        raise ValueError(f"{error} (a counterexample is shown by sidestep falsify --replay)") from error
    if episode.scenario is not None:
        return episode.scenario, episode.trajectory, episode.about, ()
    if not (path.parent / "config.json").is_file():
        raise ValueError(f"{path} does not say in which scenario it was recorded, and lies in no run folder")
    config = open_run(path.parent)
    about = {name: config[name] for name in ("shield", "pursuer", "seed") if name in config}
    return load_scenario("paper", **config["scenario"]), episode.trajectory, about, ()
