"""Lock a folder so that one process at a time writes in it; others learn which one.

The lock is the operating system's, on the file `.lock` in the folder, and ends with the process. `.lock.json`
names the holder. Its modification time is updated while that process lives, which shows whether a holder on
another host is alive where locks do not work across a network file system.
"""

from __future__ import annotations

import json
import os
import socket
import threading
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager, suppress
from datetime import datetime
from pathlib import Path
from typing import Any

from filelock import FileLock, Timeout

from sidestep.store.files import PROBE

LOCK = ".lock"
_NOTE = ".json"
_POLL_SECONDS = 0.2
_SIGN_SECONDS = 10.0
_SILENT_SECONDS = 60.0
"""Time (s) without an update after which a holder on another host counts as dead."""

_held: dict[str, tuple[int, int]] = {}
"""Process and thread that hold a lock file, by the file's real path."""


class FolderInUseError(ValueError):
    """Another process writes in the folder; the message says which, on which host and since when."""


def is_vacant(entry: Path) -> bool:
    """Whether this is only what locks and tests of outputs leave: a lock file, or a folder with nothing
    else."""
    if entry.name.startswith(PROBE):
        return True
    if entry.is_dir() and not entry.is_symlink():
        return all(is_vacant(each) for each in entry.iterdir())
    return entry.name in (LOCK, LOCK + _NOTE)


@contextmanager
def hold(*folders: str | Path, wait: bool = False) -> Iterator[None]:
    """A context that locks these folders against other processes and threads that call `hold`.

    Missing folders are created, and removed again if they stay empty. The thread that holds a folder may hold
    it again inside the context.

    **Arguments:** `wait` for the holder instead of raising.

    **Raises** `FolderInUseError` when another process or thread holds one of them, `ValueError` when one
    cannot be written in.
    """
    with hold_files(*(Path(folder) / LOCK for folder in folders), wait=wait):
        yield


@contextmanager
def hold_files(*files: str | Path, wait: bool = False) -> Iterator[None]:
    """As `hold`, for lock files given by name."""
    ended = threading.Event()
    with ExitStack() as stack:
        notes = [
            note for file in files if (note := stack.enter_context(_taken(Path(file), wait))) is not None
        ]
        if notes:
            threading.Thread(target=_show_life, args=(notes, ended), daemon=True).start()
            stack.callback(ended.set)
        yield


@contextmanager
def _taken(file: Path, wait: bool) -> Iterator[Path | None]:
    """Hold one lock file; yields the path of its note, None if this thread holds it already."""
    name, me = os.path.realpath(file), (os.getpid(), threading.get_ident())
    if _held.get(name) == me:
        yield None
        return
    note = file.with_name(file.name + _NOTE)
    made = [folder for folder in (file.parent, *file.parent.parents) if not folder.exists()]
    lock = FileLock(file)
    try:
        file.parent.mkdir(parents=True, exist_ok=True)
        lock.acquire(timeout=-1 if wait else 0, poll_interval=_POLL_SECONDS)
        try:
            while (holder := _alive_elsewhere(file, note)) is not None:
                if not wait:
                    raise FolderInUseError(_who(file, holder))
                time.sleep(_POLL_SECONDS)
            note.write_text(json.dumps(_about_this_process()) + "\n", encoding="utf-8")
        except BaseException:
            lock.release()
            raise
    except Timeout:
        raise FolderInUseError(_who(file, _read(note))) from None
    except (OSError, NotImplementedError) as error:
        reason = getattr(error, "strerror", None) or error
        raise ValueError(f"cannot write in {file.parent}: {reason}; choose another folder") from None
    _held[name] = me
    try:
        yield note
    finally:
        # A forked process inherits this entry, but not the lock.
        if os.getpid() == me[0]:
            del _held[name]
            note.unlink(missing_ok=True)
            _take_away(made, file)
            lock.release()


def _take_away(made: list[Path], file: Path) -> None:
    """Remove the folders that were created for the lock, if they are empty."""
    with suppress(OSError):
        if made and list(file.parent.iterdir()) == [file]:
            file.unlink()
        for folder in made:
            folder.rmdir()


def _about_this_process() -> dict[str, Any]:
    since = datetime.now().astimezone().isoformat(sep=" ", timespec="seconds")
    return {"process": os.getpid(), "host": socket.gethostname(), "since": since}


def _read(note: Path) -> dict[str, Any]:
    """The content of a note; empty if it is missing or being written."""
    try:
        about = json.loads(note.read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return {}
    return about if isinstance(about, dict) and {"process", "host", "since"} <= about.keys() else {}


def _alive_elsewhere(file: Path, note: Path) -> dict[str, Any] | None:
    """A live holder on another host, of which this host's lock may not know; None if there is none."""
    holder = _read(note)
    if not holder or holder["host"] == socket.gethostname():
        return None
    try:
        # Both times are those of the file system, because the hosts' clocks may differ.
        os.utime(file)
        silent = file.stat().st_mtime - note.stat().st_mtime
    except FileNotFoundError:
        return None
    return holder | {"silent": silent} if silent < _SILENT_SECONDS else None


def _who(file: Path, holder: dict[str, Any]) -> str:
    folder = file.parent
    if not holder:
        return f"{folder} is in use by another process; wait until it ends, or choose another folder"
    host = holder["host"]
    place = f"this host, {host}," if host == socket.gethostname() else host
    words = f"{folder} is in use by process {holder['process']} on {place} since {holder['since']}"
    if "silent" in holder:
        return (
            f"{words}; its last sign of life was {max(0.0, holder['silent']):.0f} s ago. If it was killed, "
            f"try again in {_SILENT_SECONDS:.0f} s; if not, wait until it ends, or choose another folder"
        )
    return f"{words}; wait until it ends, or choose another folder"


def _show_life(notes: list[Path], ended: threading.Event) -> None:
    while not ended.wait(_SIGN_SECONDS):
        for note in notes:
            with suppress(OSError):
                os.utime(note)
