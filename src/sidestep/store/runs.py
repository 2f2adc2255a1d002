"""The run folder. It is readable after a kill at any time.

`config.json`, `metrics.jsonl` (one line per episode), `summary.json`, `checkpoints/`, `figures/`,
`report.html`.
"""

import json
import os
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, contextmanager, nullcontext
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from sidestep.store import files
from sidestep.store.files import (
    UnreadableError,
    append_bytes,
    json_safe,
    make_folder,
    read_json,
    sweep,
    write_bytes,
    write_json,
)
from sidestep.store.lock import LOCK, FolderInUseError, hold, is_vacant

OUTCOMES = ("captured", "collided", "reached", "timed_out")
"""The outcomes of an episode; exclusive, the first that applies."""

CONVERGENCE_WINDOW = 20
"""Number of episodes over which returns are averaged to detect convergence."""
CONVERGENCE_RETURN = 940.0
"""Mean return that counts as converged: with +1000 for the target, at least 19 of 20 reached."""

_CONFIG, _METRICS, _SUMMARY = "config.json", "metrics.jsonl", "summary.json"
_KINDS = {"run": "training", "study": "reproduction", "falsification": "search for counterexamples"}


NOT_BEGUN = "leave out --resume to start one there"
"""Advice for --resume in a folder without a run."""


class RunError(ValueError):
    """A run folder that cannot be used; the message says what to do instead."""


def _read(path: Path) -> Any:
    """Read a JSON file of a run. **Raises** `RunError` when it is missing or invalid."""
    try:
        return read_json(path)
    except UnreadableError as error:
        missing = "" if path.exists() else f": {path.parent} is no run folder, or its run never started"
        raise RunError(f"{error}{missing}") from None


@contextmanager
def writing(folder: str | Path, *inner: str, resume: bool = False) -> Iterator[None]:
    """Lock a run folder, and the folders of these names in it, while it is written; see `hold`.

    **Raises** `RunError`, before anything is changed, when a new folder is occupied or there is nothing to
    resume; `FolderInUseError` when another process writes there.
    """
    folder = Path(folder)
    if resume:
        open_run(folder, otherwise=NOT_BEGUN)
    else:
        _refuse_occupied(folder)
    with hold(folder, *(folder / name for name in inner)):
        sweep(folder)
        yield


def held_if_run(folder: str | Path) -> AbstractContextManager[None]:
    """Lock the folder if it holds a run, to add files to it; see `hold`."""
    return hold(folder) if (Path(folder) / _CONFIG).is_file() else nullcontext()


def create_run(folder: str | Path, config: Mapping[str, Any]) -> Path:
    """Create a run folder with `config.json` and empty `checkpoints/` and `figures/`.

    **Raises** `RunError` when `folder` is not empty: nothing is overwritten silently.
    """
    folder = Path(folder)
    _refuse_occupied(folder)
    for name in ("checkpoints", "figures"):
        make_folder(folder / name)
    write_json(folder / _CONFIG, config)
    return folder


def _refuse_occupied(folder: Path) -> None:
    if folder.exists() and not folder.is_dir():
        raise RunError(f"{folder} is a file, not a folder; choose another --out")
    if not folder.is_dir() or all(map(_is_left_by_a_kill, folder.iterdir())):
        return
    if (folder / LOCK).exists():
        try:
            with hold(folder):
                pass
        except FolderInUseError:
            raise
        except ValueError:
            pass  # Not writable; report the occupied folder instead.
    what = "a run" if (folder / _CONFIG).exists() else "files"
    raise RunError(
        f"{folder} already holds {what}, which would be overwritten; continue a run with --resume, "
        "or choose another --out"
    )


def _is_left_by_a_kill(entry: Path) -> bool:
    """Whether this remains from a `create_run` killed before `config.json` was written."""
    return is_vacant(entry) or (entry.name.startswith(f".{_CONFIG}.") and entry.suffix == ".tmp")


def open_run(folder: str | Path, kind: str | None = None, *, otherwise: str = "") -> dict[str, Any]:
    """The configuration of an existing run.

    **Arguments:** `kind` required: `run` (a training), `study` or `falsification`; any if None. `otherwise`,
    advice for the error message.

    **Raises** `RunError` when `folder` holds no run, or one of another kind.
    """
    folder, advice = Path(folder), f"; {otherwise}" if otherwise else ""
    if not (folder / _CONFIG).is_file():
        what = f"holds no run (no {_CONFIG})" if folder.exists() else "does not exist"
        raise RunError(f"{folder} {what}{advice}")
    config = _read(folder / _CONFIG)
    if kind is not None and (found := _kind_of(config)) != kind:
        raise RunError(f"{folder} holds no {_KINDS[kind]} but a {_KINDS[found]}{advice}")
    return config


def _kind_of(config: Mapping[str, Any]) -> str:
    return str(config.get("kind", "study" if "study" in config else "run"))


def refuse_changes(
    folder: str | Path, stored: Mapping[str, Any], asked: Mapping[str, Any], names: Iterable[str]
) -> None:
    """Compare the settings `asked` with those `stored` in `folder`.

    **Raises** `RunError` with the first of `names` that differs, and both values.
    """
    for name in names:
        was, now = json_safe(stored.get(name)), json_safe(asked.get(name))
        if was == now:
            continue
        what = name
        if isinstance(was, Mapping) and isinstance(now, Mapping):
            entry = next(key for key in [*was, *now] if was.get(key) != now.get(key))
            what, was, now = f"{name}, {entry}", was.get(entry), now.get(entry)
        raise RunError(
            f"{folder} was begun with other settings: {what} = {was!r}, not {now!r}; resume without changing "
            "it, or start anew with another --out"
        )


def read_metrics(folder: str | Path) -> list[dict[str, Any]]:
    """The episodes of a run in order, or the rounds of a search; empty without metrics.

    A last line cut off by a kill is ignored. **Raises** `RunError` naming any other line that cannot be read,
    or has the wrong number.
    """
    path = Path(folder) / _METRICS
    if not path.exists():
        return []
    *lines, _cut = path.read_bytes().split(b"\n")
    metrics: list[dict[str, Any]] = []
    counts: dict[str, int] = {}
    for number, line in enumerate(lines, start=1):
        try:
            entry = json.loads(line)
        except (json.JSONDecodeError, UnicodeDecodeError):
            entry = None
        if not isinstance(entry, dict):
            raise RunError(f"line {number} of {path} is not a JSON object; the file was damaged or edited")
        _check_next(entry, counts, f"line {number} of {path}")
        metrics.append(entry)
    return metrics


def _check_next(entry: Mapping[str, Any], counts: dict[str, int], where: str) -> None:
    """**Raises** `RunError` unless this is the next episode of a training, or the next round of an attack."""
    if "episode" in entry:
        series, what, number, first = "episode", "episode", entry["episode"], 1
    elif "round" in entry:
        series, what, number, first = (
            str(entry.get("attack")),
            f"{entry.get('attack')} round",
            entry["round"],
            0,
        )
    else:
        return
    expected = counts.get(series, first)
    if number != expected:
        raise RunError(
            f"{where} is {what} {number} where {what} {expected} belongs: two programs wrote the file at the "
            "same time, or it was edited. Figures from it would be wrong. Restore the file, or start again "
            "with another --out: the same seed gives the same numbers"
        )
    counts[series] = expected + 1


def append_metrics(folder: str | Path, episodes: Iterable[Mapping[str, Any]]) -> None:
    """Append one line per episode and sync to disk; a last line cut off by a kill is removed first."""
    path = Path(folder) / _METRICS
    text = "".join(json.dumps(json_safe(episode), allow_nan=False) + "\n" for episode in episodes)
    with files.writing(path), open(path, "ab+") as file:
        end = _end_of_last_line(file)
        if end < file.seek(0, os.SEEK_END):
            file.truncate(end)
    append_bytes(path, text.encode(), sync=True)


def _end_of_last_line(file: Any) -> int:
    """Position after the last line feed, searched backwards for speed."""
    position = file.seek(0, os.SEEK_END)
    while position > 0:
        start = max(0, position - 4096)
        file.seek(start)
        found = file.read(position - start).rfind(b"\n")
        if found >= 0:
            return start + found + 1
        position = start
    return 0


def truncate_metrics(folder: str | Path, episodes: int) -> None:
    """Keep the first `episodes` lines, to resume from a checkpoint older than the metrics.

    **Raises** `RunError` when there are fewer lines.
    """
    path = Path(folder) / _METRICS
    *lines, _cut = path.read_bytes().split(b"\n") if path.exists() else [b""]
    if len(lines) < episodes:
        raise RunError(f"{path} has {len(lines)} episodes, but the checkpoint was written after {episodes}")
    write_bytes(path, b"".join(line + b"\n" for line in lines[:episodes]))


def moving_mean(values: ArrayLike, window: int = CONVERGENCE_WINDOW) -> np.ndarray:
    """Mean of the last `window` values at each position; NaN at the first `window` - 1 positions."""
    series = np.asarray(values, dtype=float)
    means = np.full(series.shape, np.nan)
    if len(series) >= window:
        means[window - 1 :] = np.lib.stride_tricks.sliding_window_view(series, window).mean(axis=-1)
    return means


def converged_episode(returns: ArrayLike) -> int | None:
    """The first episode, from 1, at which the mean return of the last 20 episodes is at least 940; None if
    there is none."""
    closed = np.flatnonzero(moving_mean(returns) >= CONVERGENCE_RETURN)
    return int(closed[0]) + 1 if len(closed) else None


def longest_convergence(returns: ArrayLike) -> tuple[int, int] | None:
    """First and last episode, from 1, of the longest stretch in which all 20-episode means are at least 940.

    The mean may fall below 940 after the first convergence. Of several equally long stretches the first; None
    if no mean is that high.
    """
    stretches = _convergences(returns)
    return max(stretches, key=lambda stretch: stretch[1] - stretch[0]) if stretches else None


def stays_converged_from(returns: ArrayLike) -> int | None:
    """The episode, from 1, from which on all 20-episode means are at least 940; None if there is none."""
    stretches, last = _convergences(returns), np.size(returns)
    return stretches[-1][0] if stretches and stretches[-1][1] == last else None


def _convergences(returns: ArrayLike) -> list[tuple[int, int]]:
    """First and last episode of every stretch with 20-episode means of at least 940, in order."""
    reached = moving_mean(returns) >= CONVERGENCE_RETURN
    edges = np.flatnonzero(np.diff(np.concatenate([[False], reached, [False]]).astype(int)))
    return [(int(begin) + 1, int(end)) for begin, end in edges.reshape(-1, 2)]


def summarise(
    metrics: Sequence[Mapping[str, Any]], *, wall_seconds: float | int, **about: Any
) -> dict[str, Any]:
    """The content of a run's `summary.json`, from its episodes.

    **Arguments:** `metrics` from `read_metrics`; `about`: `scenario`, `shield`, `pursuer`, `seed`, `version`,
    added unchanged.

    **Returns**

    - the counts per outcome, and `safe_episodes` (neither captured nor collided)
    - `env_steps`: control periods simulated
    - `converged_episode`, `converged_stays_from` and `converged_longest`, see the functions
      `converged_episode`, `stays_converged_from`, `longest_convergence`
    - `final_return`: mean return of the last 20 episodes, of all if fewer
    - the least clearances, m
    - `intervention_rate`, `infeasible_rate`, `invalid_rate`: shares of control periods in which the shield
      corrected the action, could not satisfy its rows, got non-finite input
    - `mean_correction` over all control periods, m/s
    - `pursuer_invalid`: control periods in which a pursuer's wheel speeds were not finite and it stood still

    Entries that need an episode are null without one. `invalid_rate` and `pursuer_invalid` are null if an
    earlier version, which did not count those periods, recorded an episode.
    """
    counts = {name: sum(episode["outcome"] == name for episode in metrics) for name in OUTCOMES}
    if sum(counts.values()) != len(metrics):
        unknown = sorted({str(episode["outcome"]) for episode in metrics} - set(OUTCOMES))
        raise RunError(f"unknown episode outcomes {unknown}; known: {', '.join(OUTCOMES)}")
    returns = [float(episode["return"]) for episode in metrics]
    steps = sum(int(episode["steps"]) for episode in metrics)

    def smallest(key: str) -> float | None:
        values = [float(episode[key]) for episode in metrics if episode.get(key) is not None]
        return min(values) if values else None

    def total(key: str) -> int | None:
        return sum(int(line[key]) for line in metrics) if all(key in line for line in metrics) else None

    def share(key: str) -> float | None:
        count = total(key)
        return count / steps if steps and count is not None else None

    # `mean_correction` of an episode is the mean over its periods.
    correction = sum(float(episode["mean_correction"]) * int(episode["steps"]) for episode in metrics)
    return json_safe(
        {
            "episodes": len(metrics),
            "safe_episodes": len(metrics) - counts["captured"] - counts["collided"],
            **counts,
            "env_steps": metrics[-1].get("env_steps", steps) if metrics else 0,
            "wall_seconds": wall_seconds,
            "converged_episode": converged_episode(returns),
            "converged_stays_from": stays_converged_from(returns),
            "converged_longest": longest_convergence(returns),
            "final_return": float(np.mean(returns[-CONVERGENCE_WINDOW:])) if returns else None,
            "min_pursuer_clearance": smallest("min_pursuer_clearance"),
            "min_obstacle_clearance": smallest("min_obstacle_clearance"),
            "intervention_rate": share("interventions"),
            "infeasible_rate": share("infeasible"),
            "invalid_rate": share("invalid"),
            "pursuer_invalid": total("pursuer_invalid"),
            "mean_correction": correction / steps if steps else None,
            **about,
        }
    )


def write_summary(folder: str | Path, summary: Mapping[str, Any]) -> None:
    """Write `summary.json` of a run."""
    write_json(Path(folder) / _SUMMARY, summary)


def read_summary(folder: str | Path) -> dict[str, Any]:
    """`summary.json` of a run. **Raises** `RunError` when it has none yet."""
    return _read(Path(folder) / _SUMMARY)
