"""`sidestep report`."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import tyro

from sidestep._bounds import bounded
from sidestep.commands.common import CountBar
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
    """HTML file to write; report.html in the first folder, or beside the episode, by default. Its figures go
    into figures/ beside it, or NAME-figures/ for NAME.html."""
    episodes: int = bounded(100, least=0, most=10**8)
    """Random episodes to run with a policy without a survey: for the histograms, the map of interventions and
    the worst episodes. They are kept in its folder. 0 for none."""
    film: VideoOptions = NO_VIDEO


def run(command: Report, console: Console) -> int:
    """Run `sidestep report`; returns the exit status."""
    from sidestep.store.files import OutputError
    from sidestep.store.outputs import try_outputs
    from sidestep.store.runs import held_if_run
    from sidestep.views import write_report

    if not command.runs:
        raise ValueError("a report needs at least one run folder, or an episode")
    check_options(command.film)
    if any(path.suffix in (".mcap", ".npz") for path in command.runs):
        return _report_episode(command, console)
    if command.film.video is not None:
        raise ValueError("--video shows one episode: give its log or recording instead of a run")
    folders = _run_folders(command.runs, console)
    path = command.out or command.runs[0] / "report.html"
    _refuse_other_files(path)
    figures = path.with_name("figures" if path.stem == "report" else f"{path.stem}-figures")
    try_outputs(files=[path], folders=[figures])
    unseen = [folder for folder in folders if command.episodes and _is_unseen(folder)]
    try:
        try_outputs(folders=unseen)
    except OutputError as error:
        raise error.and_kept("Its episodes are to be kept there; --episodes 0 reports without any") from error
    with held_if_run(path.parent):
        for folder in unseen:
            _look_closer(folder, command.episodes, console)
        written = write_report(folders, path, figures=figures)
    console.print(f"Report with figures: {written}", highlight=False)
    return 0


def _run_folders(paths: tuple[Path, ...], console: Console) -> list[Path]:
    """The run folders, including those of a reproduction. **Raises** `RunError` for a duplicate."""
    from sidestep.store.files import read_json
    from sidestep.store.runs import RunError

    folders: list[Path] = []
    for path in paths:
        if not (path / "config.json").is_file():
            raise RunError(f"{path} holds no run (no config.json)")
        study = read_json(path / "config.json").get("study")
        begun = [path] if study is None else [path / shield for shield in study]
        missing = [folder for folder in begun if not (folder / "config.json").is_file()]
        if len(missing) == len(begun):
            raise RunError(f"{path} holds no run yet: its study has not begun to train")
        if missing:
            names = ", ".join(folder.name for folder in missing)
            console.print(f"Not trained yet in {path}: {names}", highlight=False)
        folders += [folder for folder in begun if folder not in missing]
    places = [folder.resolve() for folder in folders]
    for folder, place in zip(folders, places, strict=True):
        if places.count(place) > 1:
            raise RunError(f"{folder} is given twice; its episodes would count double")
    return folders


def _refuse_other_files(path: Path) -> None:
    """**Raises** `ValueError` for an existing file that is not a report."""
    if path.is_file():
        with path.open("rb") as file:
            if b"<title>sidestep" not in file.read(1000):
                raise ValueError(f"{path} exists already and is no report; give --out another name")


def _is_unseen(folder: Path) -> bool:
    """Whether a run has a policy, but no recorded episode with it."""
    from sidestep.trials import load_survey

    return (folder / "policy.npz").exists() and load_survey(folder) is None


def _look_closer(folder: Path, episodes: int, console: Console) -> None:
    """Survey a run's policy on random episodes, and keep the survey in its folder."""
    from sidestep.store.files import read_json
    from sidestep.store.lock import hold
    from sidestep.trials import save_survey, survey_run

    config = read_json(folder / "config.json")
    try:
        with hold(folder), CountBar(console, f"{config['shield']} shield, {episodes} episodes") as show:
            survey = survey_run(folder, episodes, progress=show)
            save_survey(folder, survey)
    except (KeyError, ValueError) as error:
        # A custom shield or pursuer is stored by its name only, and cannot be restored.
        console.print(f"No episodes run for {folder}: {error}", highlight=False)


def _report_episode(command: Report, console: Console) -> int:
    from sidestep.store.outputs import try_outputs
    from sidestep.views import write_episode_report

    path, *others = command.runs
    if others:
        raise ValueError("a report is of runs or of one episode")
    out = command.out or path.with_suffix(".html")
    _refuse_other_files(out)
    try_outputs(files=[out], new=[command.film.video], folders=[out.with_name("figures")])
    scenario, trajectory, about, notes = _read_episode(path)
    title = f"{'Log' if path.suffix == '.mcap' else 'Recording'} {path.stem}"
    written = write_episode_report(scenario, trajectory, out, title=title, about=about, notes=notes)
    for note in notes:
        console.print(f"Not in the log: {note}.", highlight=False)
    console.print(f"Report with figure: {written}", highlight=False)
    write_video(command.film, scenario, trajectory, str(about.get("shield", "")), console)
    return 0


def _read_episode(path: Path) -> tuple[Any, Any, Mapping[str, Any], Sequence[str]]:
    """Scenario, trajectory, metadata, and notes on reconstructed data."""
    if path.suffix == ".mcap":
        from sidestep.bridges.logs import load_log

        log = load_log(path)
        return log.scenario, log.trajectory, log.about, log.rebuilt
    from sidestep.loop import load_episode
    from sidestep.store.runs import open_run
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
