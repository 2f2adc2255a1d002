"""Can what a command is to write be written? Tried before anything long begins."""

from __future__ import annotations

import os
import shutil
import tempfile
from collections.abc import Iterable
from pathlib import Path

from sidestep.store.files import PROBE, OutputError, descriptor_of, is_stream, writing

_PROBE = bytes(4096)
Paths = Iterable[str | Path | None]


def try_outputs(*, files: Paths = (), new: Paths = (), folders: Paths = ()) -> None:
    """Try to write where something will be written, and leave everything as it was.

    **Arguments:** `files` written anew or in place of what is there; `new` files, never over one that exists;
    `folders` in which files are written. None stands for an output that was not asked for. Folders that are
    missing are made later; pipes and devices such as /dev/stdout are files that always may be written over.

    **Raises** `OutputError` for the first of them that cannot be written, and for a file named twice.
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
            raise OutputError(path, f"{path} is named for two outputs; give each a name of its own")
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
    """Nothing at all is written, which a full or a closed device refuses already."""
    descriptor = descriptor_of(path)
    if descriptor is not None:
        os.fstat(descriptor)
    elif path.is_fifo():
        # To open it would wait for a reader.
        if not os.access(path, os.W_OK):
            raise OutputError(path, f"{path} is write-protected; give another name")
    else:
        with open(path, "wb", buffering=0) as file:
            file.write(b"")


def _try_folder(named: Path, place: Path) -> None:
    """Make what is missing on the way to `place` under another name, write there, and take it all away.

    Under another name, so that nobody who makes the same folder meanwhile loses it.
    """
    there = place.parent
    while not there.exists() and there != there.parent:
        there = there.parent
    if not there.is_dir():
        raise OutputError(named, f"{named} could not be written: {there} is not a folder")
    missing = place.parent.relative_to(there)
    probe = Path(tempfile.mkdtemp(prefix=f"{PROBE}{os.getpid()}-", dir=there))
    try:
        (probe / missing).mkdir(parents=True, exist_ok=True)
        # As long as the name that it is written under at first.
        with open(probe / missing / f".{place.name}.{os.getpid()}.tmp", "wb") as file:
            file.write(_PROBE)
            file.flush()
            os.fsync(file.fileno())
    finally:
        shutil.rmtree(probe, ignore_errors=True)
