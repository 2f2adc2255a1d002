"""How does a file get onto the disk whole or not at all, and what is said when it cannot?"""

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
"""How the name of a folder begins in which `try_outputs` tries to write; the process comes next."""
_RESULT = re.compile(r"[0-9a-f]{32}")
_OLD_SECONDS = 3600.0


class OutputError(ValueError):
    """A file or folder that cannot be written; the message says what, where and why.

    **Attributes:** `path` of the file or folder; `full` whether the disk, or a quota, is full.
    """

    def __init__(self, path: str | Path, words: str, *, full: bool = False):
        super().__init__(words)
        self.path, self.full = Path(path), full

    def __reduce__(self) -> tuple[Any, ...]:
        # Campaigns hand it from one process to another.
        return _output_error, (self.path, str(self), self.full)

    def and_kept(self, words: str) -> OutputError:
        """The same error, which also says what is kept and how to go on."""
        more = OutputError(self.path, f"{self}. {words}", full=self.full)
        more.__cause__ = self.__cause__
        return more


def _output_error(path: Path, words: str, full: bool) -> OutputError:
    return OutputError(path, words, full=full)


class UnreadableError(ValueError):
    """A file that cannot be read as what it should be."""


def json_safe(value: Any) -> Any:
    """`value` as plain JSON: arrays become lists, numbers that are not finite become null."""
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
    """Turns what the system refuses meanwhile into one sentence about `path`.

    **Arguments:** `needed` bytes for all of it, if that is known.

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
        # Libraries that hand the number over alone say no more than "Errno 28".
        reason = os.strerror(error.errno) if error.errno is not None and "rrno" in reason else reason
        words = f"{path} could not be written: {reason[0].lower()}{reason[1:]}"
        if amount:
            words += f" ({', '.join(amount)})"
        raise OutputError(path, words, full=full) from error


def free_bytes(path: str | Path) -> int:
    """Bytes that are free where `path` lies, or is to lie; 0 where that cannot be found out."""
    folder = Path(path).absolute()
    while not folder.exists() and folder != folder.parent:
        folder = folder.parent
    try:
        return shutil.disk_usage(folder).free
    except OSError:
        return 0


def size_words(count: int) -> str:
    """A number of bytes for people."""
    for unit, size in (("GB", 1e9), ("MB", 1e6), ("kB", 1e3)):
        if count >= size:
            return f"{count / size:.1f} {unit}"
    return f"{count} bytes"


def make_folder(folder: str | Path) -> Path:
    """A folder, and those on the way to it. **Raises** `OutputError` where there can be none."""
    folder = Path(folder)
    with writing(folder):
        folder.mkdir(parents=True, exist_ok=True)
    return folder


def is_stream(path: str | Path) -> bool:
    """Whether this is a pipe or a device, such as /dev/stdout: written into, and not replaced."""
    if descriptor_of(path) is not None:
        return True
    try:
        kind = os.stat(path).st_mode
    except (OSError, ValueError):
        return False
    return not stat.S_ISREG(kind) and not stat.S_ISDIR(kind)


def descriptor_of(path: str | Path) -> int | None:
    """The file descriptor that a path such as /dev/stdout or /dev/fd/3 names."""
    text = str(path)
    found = _DESCRIPTOR.fullmatch(text)
    return int(found.group(1)) if found else _STREAMS.get(text)


@contextmanager
def whole_file(path: str | Path, needed: int | None = None) -> Iterator[Path]:
    """A path beside `path` to write to; what is there at the end takes its place, and nothing if that fails.

    Synced to disk, renamed over `path`, and the folder synced too: a reader, or a restart after a kill, sees
    the old file or the new one. Folders on the way are made; a link is followed. A pipe or a device gets the
    whole content at the end.

    **Arguments:** `needed` bytes, if that is known, for the message.

    **Raises** `OutputError` for what the system refuses.
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
            with _interrupts.before_leaving(lambda: beside.unlink(missing_ok=True)):
                yield beside
            with open(beside, "rb+") as file:
                os.fsync(file.fileno())
            os.replace(beside, place)
        except BaseException as error:
            with suppress(OSError):
                beside.unlink(missing_ok=True)
            if isinstance(error, OutputError) and error.path == beside:
                # Who asked for a file knows it by its name.
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
        # What was printed before comes before it.
        (sys.stdout if descriptor == 1 else sys.stderr).flush()
    with writing(path, len(content)), open(path if descriptor is None else os.dup(descriptor), "wb") as file:
        file.write(content)


def sweep(folder: str | Path, *, below: bool = True) -> None:
    """Remove what kills in the middle of `whole_file` and `try_outputs` have left in a folder and `below` it.

    What names a process counts as left when that process is gone; a campaign's result, whose name ends in 32
    hexadecimal digits because its worker may be on another host, when it is an hour old. All else stays.
    """
    # Unlike `rglob`, `os.walk` passes over a folder that vanishes meanwhile.
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
    """Append to a file at once and unbuffered: all of it is there or, after an error, nothing.

    **Raises** `OutputError` for what the system refuses.
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
    """Sync what a folder lists to disk, where the system can do that."""
    if os.name != "posix":
        return
    descriptor = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def write_json(path: str | Path, data: Any) -> None:
    """Write `data` as JSON, whole or not at all; numbers that are not finite become null."""
    text = json.dumps(json_safe(data), indent=2, allow_nan=False)
    write_bytes(path, (text + "\n").encode())


def read_json(path: str | Path) -> Any:
    """What `write_json` wrote. **Raises** `UnreadableError` when the file is missing or no JSON."""
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
