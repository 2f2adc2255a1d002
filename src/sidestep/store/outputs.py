"""Test whether outputs can be written, before long work begins."""

from __future__ import annotations

import os
import shutil
import tempfile
from collections.abc import Iterable
from pathlib import Path

from sidestep import _interrupts
from sidestep.store.files import PROBE, OutputError, descriptor_of, is_stream, writing

_PROBE = bytes(4096)
Paths = Iterable[str | Path | None]


def try_outputs(*, files: Paths = (), new: Paths = (), folders: Paths = ()) -> None:
    """Test writing of all outputs, without changing anything.

    **Arguments:** `files` that may be overwritten; `new` files, which must not exist; `folders` in which
    files will be written. None entries are ignored. Missing folders are created later. Pipes and devices such
    as /dev/stdout may always be overwritten.

    **Raises** `OutputError` for the first output that cannot be written, and for a file named twice.
    """
    files, new, folders = (
        [Path(path) for path in group if path is not None] for group in (files, new, folders)
    )
    for path in new:
        if os.path.lexists(path) and not is_stream(path):
            raise OutputError(path, f"{path} exists already; give another name, nothing is written over it")
    seen: set[str] = set()
    for path in (*files, *new):
        place = os.path.realpath(path)
        if place in seen and not is_stream(path):
            raise OutputError(path, f"{path} is named for two outputs; give them different names")
        seen.add(place)
        with writing(path):
            _try_file(path)
    for folder in folders:
        place = Path(os.path.realpath(folder))
        for inside in (place, *place.parents):
            if str(inside) in seen:
                raise OutputError(folder, f"{folder} is to be a folder, and {inside} a file; rename one")
        with writing(folder):
            if folder.exists() and not folder.is_dir():
                raise OutputError(folder, f"{folder} is a file, not a folder; choose another name")
            _try_folder(folder, folder / "probe")


def _try_file(path: Path) -> None:
    if path.is_dir():
        raise OutputError(path, f"{path} is a folder; give the name of a file to write")
    if is_stream(path):
        _try_stream(path)
        return
    if path.exists() and not os.access(path, os.W_OK):
        raise OutputError(path, f"{path} is write-protected; give another name")
    _try_folder(path, Path(os.path.realpath(path)))


def _try_stream(path: Path) -> None:
    """Write zero bytes, which a full or closed device already refuses."""
    descriptor = descriptor_of(path)
    if descriptor is not None:
        os.fstat(descriptor)
    elif path.is_fifo():
        # Opening it would wait for a reader.
        if not os.access(path, os.W_OK):
            raise OutputError(path, f"{path} is write-protected; give another name")
    else:
        with open(path, "wb", buffering=0) as file:
            file.write(b"")


def _try_folder(named: Path, place: Path) -> None:
    """Create the missing folders of `place` under another name, write there, and remove them.

    Another name is used so that a folder created meanwhile by another process is not removed.
    """
    there = place.parent
    while not there.exists() and there != there.parent:
        there = there.parent
    if not there.is_dir():
        raise OutputError(named, f"{named} could not be written: {there} is not a folder")
    missing = place.parent.relative_to(there)
    probe = Path(tempfile.mkdtemp(prefix=f"{PROBE}{os.getpid()}-", dir=there))

    def remove() -> None:
        shutil.rmtree(probe, ignore_errors=True)

    try:
        with _interrupts.before_leaving(remove):
            (probe / missing).mkdir(parents=True, exist_ok=True)
            # As long as the temporary name of `whole_file`.
            with open(probe / missing / f".{place.name}.{os.getpid()}.tmp", "wb") as file:
                file.write(_PROBE)
                file.flush()
                os.fsync(file.fileno())
    finally:
        remove()
