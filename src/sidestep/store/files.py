"""Write files whole or not at all, with clear errors."""

from __future__ import annotations

import errno
import json
import math
import os
import re
import shutil
import stat
import sys
import tempfile
import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

import numpy as np

from sidestep import _interrupts

_FULL = (errno.ENOSPC, errno.EDQUOT)
_STREAMS = {"/dev/stdin": 0, "/dev/stdout": 1, "/dev/stderr": 2}
_DESCRIPTOR = re.compile(r"/(?:dev|proc/self)/fd/(\d+)")
PROBE = ".sidestep-"
"""Prefix of the folders in which `try_outputs` tests writing; the process id follows."""
_RESULT = re.compile(r"[0-9a-f]{32}")
_OLD_SECONDS = 3600.0


class OutputError(ValueError):
    """A file or folder that cannot be written; the message says which and why.

    **Attributes:** `path` of the file or folder; `full` whether the disk or a quota is full.
    """

    def __init__(self, path: str | Path, words: str, *, full: bool = False):
        super().__init__(words)
        self.path, self.full = Path(path), full

    def __reduce__(self) -> tuple[Any, ...]:
        # Campaigns pass it between processes.
        return _output_error, (self.path, str(self), self.full)

    def and_kept(self, words: str) -> OutputError:
        """The same error, whose message also says what is kept and how to continue."""
        more = OutputError(self.path, f"{self}. {words}", full=self.full)
        more.__cause__ = self.__cause__
        return more


def _output_error(path: Path, words: str, full: bool) -> OutputError:
    return OutputError(path, words, full=full)


class UnreadableError(ValueError):
    """A file that cannot be read, or has another format."""


def json_safe(value: Any) -> Any:
    """`value` as JSON values: arrays become lists, non-finite numbers become None."""
    if isinstance(value, Mapping):
        return {str(key): json_safe(item) for key, item in value.items()}
    if isinstance(value, (str, bool)) or value is None:
        return value
    if isinstance(value, (list, tuple)):
        return [json_safe(item) for item in value]
    if isinstance(value, Path):
        return str(value)
    array = np.asarray(value)
    if array.ndim > 0:
        return [json_safe(item) for item in array]
    number = array.item()
    return None if isinstance(number, float) and not math.isfinite(number) else number


@contextmanager
def writing(path: str | Path, needed: int | None = None) -> Iterator[None]:
    """Turns an `OSError` of the context into a message about `path`.

    **Arguments:** `needed` bytes in total, if known.

    **Raises** `OutputError` for an `OSError`.
    """
    try:
        yield
    except OSError as error:
        full = error.errno in _FULL or (error.errno is None and free_bytes(path) == 0)
        amount = [f"{size_words(needed)} needed"] if full and needed is not None else []
        if error.errno == errno.ENOSPC and not is_stream(path):
            amount.append(f"{size_words(free_bytes(path))} free")
        reason = error.strerror or str(error) or type(error).__name__
        # Some libraries pass only the number, with the text "Errno 28".
        reason = os.strerror(error.errno) if error.errno is not None and "rrno" in reason else reason
        words = f"{path} could not be written: {reason[0].lower()}{reason[1:]}"
        if amount:
            words += f" ({', '.join(amount)})"
        raise OutputError(path, words, full=full) from error


def free_bytes(path: str | Path) -> int:
    """Free bytes on the disk of `path`, which need not exist; 0 if unknown."""
    folder = Path(path).absolute()
    while not folder.exists() and folder != folder.parent:
        folder = folder.parent
    try:
        return shutil.disk_usage(folder).free
    except OSError:
        return 0


def size_words(count: int) -> str:
    """A number of bytes with a suitable unit."""
    for unit, size in (("GB", 1e9), ("MB", 1e6), ("kB", 1e3)):
        if count >= size:
            return f"{count / size:.1f} {unit}"
    return f"{count} bytes"


def make_folder(folder: str | Path) -> Path:
    """Create a folder and its parents. **Raises** `OutputError` if that fails."""
    folder = Path(folder)
    with writing(folder):
        folder.mkdir(parents=True, exist_ok=True)
    return folder


def is_stream(path: str | Path) -> bool:
    """Whether this is a pipe or a device, such as /dev/stdout, which is written to and not replaced."""
    if descriptor_of(path) is not None:
        return True
    try:
        kind = os.stat(path).st_mode
    except (OSError, ValueError):
        return False
    return not stat.S_ISREG(kind) and not stat.S_ISDIR(kind)


def descriptor_of(path: str | Path) -> int | None:
    """The file descriptor of a path such as /dev/stdout or /dev/fd/3; None for other paths."""
    text = str(path)
    found = _DESCRIPTOR.fullmatch(text)
    return int(found.group(1)) if found else _STREAMS.get(text)


@contextmanager
def whole_file(path: str | Path, needed: int | None = None) -> Iterator[Path]:
    """Write a file whole or not at all: yields a temporary path, whose file replaces `path` at the end.

    The file is synced, renamed to `path`, and the folder synced, so that a reader, or a restart after a kill,
    sees the old file or the new one. After an error `path` is unchanged. Missing folders are created; a link
    is followed. A pipe or a device gets the whole content at the end.

    **Arguments:** `needed` bytes, if known, for the message.

    **Raises** `OutputError` for an `OSError`.
    """
    if is_stream(path):
        with _into_stream(Path(path)) as beside:
            yield beside
        return
    with writing(path, needed):
        place = Path(os.path.realpath(path))
        place.parent.mkdir(parents=True, exist_ok=True)
        beside = place.with_name(f".{place.name}.{os.getpid()}.tmp")
        try:
            # Until it is renamed: to sync it takes long enough for a Ctrl-C to come.
            with _interrupts.before_leaving(lambda: beside.unlink(missing_ok=True)):
                yield beside
                with open(beside, "rb+") as file:
                    os.fsync(file.fileno())
                os.replace(beside, place)
        except BaseException as error:
            with suppress(OSError):
                beside.unlink(missing_ok=True)
            if isinstance(error, OutputError) and error.path == beside:
                # Report the name that the user gave.
                raise OutputError(
                    path, str(error).replace(str(beside), str(path)), full=error.full
                ) from error
            raise
        sync_folder(place.parent)


@contextmanager
def _into_stream(path: Path) -> Iterator[Path]:
    with tempfile.TemporaryDirectory() as folder:
        beside = Path(folder) / path.name
        yield beside
        content = beside.read_bytes()
    descriptor = descriptor_of(path)
    if descriptor in (1, 2):
        # Flush earlier output first.
        (sys.stdout if descriptor == 1 else sys.stderr).flush()
    with writing(path, len(content)), open(path if descriptor is None else os.dup(descriptor), "wb") as file:
        file.write(content)


def sweep(folder: str | Path, *, below: bool = True) -> None:
    """Remove temporary files of killed `whole_file` and `try_outputs` in a folder, and `below` it.

    A file that names a process is removed if that process has ended. A campaign's temporary result, which
    ends in 32 hexadecimal digits because its worker may be on another host, is removed after an hour.
    """
    # Unlike `rglob`, `os.walk` skips a folder that disappears during the walk.
    for inside, folders, names in os.walk(folder):
        for name in names:
            path = Path(inside, name)
            if name.startswith(".") and path.suffix == ".tmp" and _is_left(path, path.stem.split(".")[-1]):
                path.unlink(missing_ok=True)
        for name in folders:
            probe = Path(inside, name)
            if name.startswith(PROBE) and _is_left(probe, name.removeprefix(PROBE).split("-")[0]):
                shutil.rmtree(probe, ignore_errors=True)
        if not below:
            return


def _is_left(path: Path, writer: str) -> bool:
    if _RESULT.fullmatch(writer) is None:
        return writer.isdigit() and not _runs(int(writer))
    try:
        return time.time() - path.stat().st_mtime > _OLD_SECONDS
    except FileNotFoundError:
        return False


def _runs(process: int) -> bool:
    try:
        os.kill(process, 0)
    except ProcessLookupError:
        return False
    except (PermissionError, OverflowError):
        return True
    return True


def write_bytes(path: str | Path, content: bytes) -> None:
    """Write a file whole or not at all, see `whole_file`."""
    with whole_file(path, len(content)) as beside:
        beside.write_bytes(content)


def append_bytes(path: str | Path, content: bytes, *, sync: bool = False) -> None:
    """Append to a file in one unbuffered write: after an error nothing of it is there.

    **Raises** `OutputError` for an `OSError`.
    """
    with writing(path, len(content)), open(path, "ab", buffering=0) as file:
        before = file.seek(0, os.SEEK_END)
        try:
            rest = memoryview(content)
            while rest:
                rest = rest[file.write(rest) :]
            if sync:
                os.fsync(file.fileno())
        except OSError:
            file.truncate(before)
            raise


def sync_folder(folder: Path) -> None:
    """Sync a folder's entries to disk, if the system supports that."""
    if os.name != "posix":
        return
    descriptor = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def write_json(path: str | Path, data: Any) -> None:
    """Write `data` as JSON, whole or not at all; non-finite numbers become null."""
    text = json.dumps(json_safe(data), indent=2, allow_nan=False)
    write_bytes(path, (text + "\n").encode())


def read_json(path: str | Path) -> Any:
    """Read a JSON file. **Raises** `UnreadableError` when it is missing or invalid."""
    path = Path(path)
    try:
        return json.loads(path.read_text(encoding="utf-8"))
    except FileNotFoundError:
        raise UnreadableError(f"{path} does not exist") from None
    except OSError as error:
        raise UnreadableError(f"{path} cannot be read: {error.strerror}") from error
    except (json.JSONDecodeError, UnicodeDecodeError) as error:
        raise UnreadableError(
            f"{path} is not readable JSON ({error}); restore it or start another run"
        ) from None
