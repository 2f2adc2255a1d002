"""A study in blocks of episodes: worked on by processes, and continued from what an earlier run wrote."""

import atexit
import json
import multiprocessing
import os
import signal
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from pathlib import Path
from typing import Any

from sidestep._compiled import thread_limits
from sidestep.store.lock import FolderInUseError, hold_files

_held = ExitStack()
atexit.register(_held.close)


def results(run_block: Callable[[Any], Any], jobs: list[Any], processes: int) -> Iterator[Any]:
    """`run_block` of every job, as they are done: here with one process, else in as many of one core each."""
    if processes == 1:
        yield from map(run_block, jobs)
        return
    os.environ.update(thread_limits(1))
    with multiprocessing.get_context("spawn").Pool(processes, _alone) as pool:
        yield from pool.imap_unordered(run_block, jobs)


def _alone() -> None:
    """A worker leaves Ctrl-C to its parent."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)


def earlier(path: Path, settings: dict[str, Any]) -> dict[str, Any]:
    """The report to go on with; empty if there is none. Until the program ends no other can begin one there.

    Ends the program if the report's settings were others, or another program is at work on it.
    """
    try:
        _held.enter_context(hold_files(path.with_name(f".{path.name}.lock")))
    except FolderInUseError as error:
        raise SystemExit(f"{path}: another study writes there ({error})") from None
    if not path.exists():
        return {}
    report = json.loads(path.read_text(encoding="utf-8"))
    if report["settings"] != settings:
        raise SystemExit(f"{path} was made with other settings, {report['settings']}")
    return report
