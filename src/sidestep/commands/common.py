"""What the commands share: argument types, NAME=VALUE settings, JSON output and progress bars."""

from __future__ import annotations

import abc
import json
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, ClassVar, TypeVar, cast

import tyro

from sidestep import _interrupts
from sidestep._program import command as command_line
from sidestep.store.files import OutputError

if TYPE_CHECKING:
    from rich.console import Console

    from sidestep.learning import Progress, TrainingOptions
    from sidestep.world import Scenario

Overrides = Annotated[tuple[str, ...], tyro.conf.arg(metavar="[NAME=VALUE ...]")]
PolicyOption = Annotated[str, tyro.conf.arg(metavar="RUN|pretrained|goal-seeking")]
PolicyName = Annotated[PolicyOption, tyro.conf.Positional]
PursuerName = Annotated[str, tyro.conf.arg(metavar="NAME")]
ShieldName = Annotated[str, tyro.conf.arg(metavar="NAME")]
ScenarioName = Annotated[str, tyro.conf.arg(metavar="NAME|FILE")]
T = TypeVar("T")


class _NotGiven:
    """Marks the default of an option, to distinguish it from a given value."""


def unless_given(value: T) -> T:
    """`value` as a default that `given` can distinguish from the same value on the command line."""
    kind: Any = type("Default", (_NotGiven, type(value)), {})
    return cast(T, kind(value))


def given(command: Any, *names: str) -> dict[str, Any]:
    """Those of these options that are on the command line, as plain values."""
    values = {name: getattr(command, name) for name in names}
    return {
        name: value
        for name, value in values.items()
        if not isinstance(value, _NotGiven) and value is not None and value != ()
    }


def settings_from(command: Any, *names: str, stored: Mapping[str, Any] | None = None) -> dict[str, Any]:
    """The values of these options. For a resumed run they are those of its folder (`stored`), unless given on
    the command line."""
    if stored is None:
        return {name: getattr(command, name) for name in names}
    return {**stored, **given(command, *names)}


def scenario_from(command: Any, stored: Scenario | None = None) -> Scenario:
    """The scenario of `--scenario` (if there is such an option) and `--set`, based on a resumed run's."""
    from sidestep.world import load_scenario, scenario_to_dict

    changes = scenario_overrides(command.set)
    named = getattr(command, "scenario", None)
    if stored is None or (named is not None and not isinstance(named, _NotGiven)):
        return load_scenario(named or "paper", **changes)
    return load_scenario("paper", **{**scenario_to_dict(stored), **changes})


def options_from(command: Any, stored: TrainingOptions | None = None) -> TrainingOptions:
    """The training options of `--learner`, based on a resumed run's."""
    from sidestep.learning import make_options, options_to_dict

    return make_options(
        **{**({} if stored is None else options_to_dict(stored)), **parse_overrides(command.learner)}
    )


def resume_words(name: str, folder: Path, json: Path | None) -> list[object]:
    """The words after `sidestep` that resume the run in a folder."""
    return [name, "--out", folder, "--resume", *([] if json is None else ["--json", json])]


def say(console: Console, text: str) -> None:
    """Print a line without wrapping, so that commands in it can be pasted, and without colours."""
    console.print(text, highlight=False, markup=False, soft_wrap=True)


def parse_overrides(pairs: tuple[str, ...]) -> dict[str, Any]:
    """The values of `("a=1", "b=[0, 1]", "c=text")`: JSON if valid, else text.

    **Raises** `ValueError` for an argument without `=`.
    """
    values: dict[str, Any] = {}
    for pair in pairs:
        name, equals, text = pair.partition("=")
        if not equals or not name:
            raise ValueError(f"'{pair}' is not of the form NAME=VALUE")
        try:
            values[name] = json.loads(text)
        except json.JSONDecodeError:
            values[name] = text
    return values


def scenario_overrides(pairs: tuple[str, ...], *, zero: bool = False) -> dict[str, Any]:
    """`parse_overrides` of scenario fields with aliases resolved (see `without_aliases`), so that they can be
    merged with stored fields."""
    from sidestep.world import without_aliases

    return without_aliases(parse_overrides(pairs), zero=zero)


def policy_and_scenario(
    run: str, scenario: str | None, overrides: tuple[str, ...]
) -> tuple[Any, Scenario, dict[str, Any]]:
    """The policy of `run` (a folder, a policy file, pretrained, goal-seeking or planner), and as
    `scenario_of_run`."""
    if run in ("goal-seeking", "planner"):
        return run, *scenario_of_run(None, scenario, overrides)
    from sidestep.learning import PRETRAINED, load_policy

    if run != PRETRAINED and not Path(run).exists():
        raise ValueError(f"{run} does not exist; name a run folder, a policy.npz, pretrained or goal-seeking")
    return load_policy(run), *scenario_of_run(run, scenario, overrides)


def scenario_of_run(
    run: str | None, scenario: str | None, overrides: tuple[str, ...]
) -> tuple[Scenario, dict[str, Any]]:
    """The scenario for a policy (`scenario` if given, else that of the run folder, else paper), and the
    configuration in the run folder. What the policy observes is that of its training, unless changed."""
    from sidestep.learning import PRETRAINED, PRETRAINED_SCENARIO
    from sidestep.store.runs import open_run
    from sidestep.world import load_scenario

    changes = scenario_overrides(overrides)
    config = open_run(run) if run not in (None, PRETRAINED) and Path(run).is_dir() else {}
    if scenario is None and config:
        return load_scenario("paper", **{**config["scenario"], **changes}), config
    stored = PRETRAINED_SCENARIO if run == PRETRAINED else config.get("scenario", {})
    seen = {name: stored[name] for name in ("frame", "observation") if name in stored}
    return load_scenario(scenario or "paper", **{**seen, **changes}), config


@contextmanager
def going_on(console: Console, folder: Path, *words: object) -> Iterator[None]:
    """Print how to continue (`words` after `sidestep`) when Ctrl-C or a full disk ends the work inside."""

    def farewell() -> str:
        if not _begun(folder):
            return f"Interrupted before anything was written in {folder}."
        return f"Interrupted. Continue with: {command_line(*words)}"

    with _interrupts.before_leaving(lambda: _interrupts.say(farewell())):
        try:
            yield
        except KeyboardInterrupt:
            say(console, farewell())
            raise
        except OutputError as error:
            if not _begun(folder):
                raise
            first = "With more room there" if error.full else "When that is fixed"
            raise error.and_kept(f"{first}, continue with: {command_line(*words)}") from error.__cause__


def _begun(folder: Path) -> bool:
    return any((folder / name).is_file() for name in ("config.json", "campaign.json"))


def stood_still(periods: int, episodes: int | None = None) -> str:
    """The warning that a pursuer's wheel speeds were not finite in this many control periods."""
    where = "" if episodes is None else f" of {episodes} episodes"
    return (
        f"the pursuer's wheel speeds were not finite in {periods} control periods{where}, and it stood "
        "still: episodes without a capture then prove nothing"
    )


def write_json_file(path: Path | None, data: Any) -> None:
    """Write `data` to `path` if that is not None; missing folders are created."""
    if path is not None:
        from sidestep.store.files import write_json

        write_json(path, data)


class _Bar(abc.ABC):
    """A progress bar on the error stream, so that only results go to standard output.

    A context manager that returns `update`. The bar is drawn only in terminals of `bar_from_width` columns or
    more.
    """

    bar_from_width: ClassVar[int] = 80
    first_note: ClassVar[str] = "compiling"

    def __init__(self, console: Console, label: str):
        from rich.console import Console as RichConsole
        from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn

        screen = RichConsole(stderr=True)
        # In a narrow terminal the text needs the room of the bar.
        bar = [BarColumn(bar_width=24)] if screen.width >= self.bar_from_width else []
        self._progress = Progress(
            TextColumn("{task.description}"),
            *bar,
            MofNCompleteColumn(),
            TextColumn("{task.fields[note]}"),
            TimeElapsedColumn(),
            console=screen,
        )
        self._task = self._progress.add_task(label, total=None, note=self.first_note)

    def __enter__(self) -> Callable[..., None]:
        self._progress.__enter__()
        return self.update

    @abc.abstractmethod
    def update(self, *values: Any) -> None:
        """Show the progress."""

    def __exit__(self, *error: Any) -> None:
        self._progress.__exit__(*error)


class TrainingBar(_Bar):
    """Episode, steps per second, safe count, return of the last episode, mean of the last 20."""

    bar_from_width = 110

    def update(self, *values: Any) -> None:
        progress: Progress = values[0]
        note = f"{progress.steps_per_second:,.0f} steps/s  safe {progress.safe}"
        if progress.last is not None:
            note += f"  return {progress.last['return']:.0f}, mean {progress.mean_return:.0f}"
        self._progress.update(self._task, total=progress.episodes, completed=progress.episode, note=note)


class CountBar(_Bar):
    """Number finished of all."""

    def update(self, *values: Any) -> None:
        finished, total = values
        self._progress.update(self._task, total=total, completed=finished, note="")


class CampaignBar(_Bar):
    """Number finished of all, and a note on the workers."""

    first_note = "starting workers"

    def update(self, *values: Any) -> None:
        finished, total, note = values
        self._progress.update(self._task, total=total, completed=finished, note=note)
