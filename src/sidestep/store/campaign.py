"""The folder of a campaign: every job's result there exactly once, whoever is killed, and when."""

from __future__ import annotations

import contextlib
import errno
import hashlib
import json
import os
import uuid
import warnings
from collections.abc import Iterator, Mapping
from contextlib import AbstractContextManager, contextmanager
from pathlib import Path
from typing import Any

from sidestep.store.damage import DamageWarning
from sidestep.store.files import (
    json_safe,
    make_folder,
    read_json,
    sweep,
    sync_folder,
    write_bytes,
    write_json,
    writing,
)
from sidestep.store.lock import hold, hold_files, is_vacant

_FORMAT = 1
_CANNOT_LINK = (errno.EPERM, errno.ENOTSUP, errno.ENOSYS, errno.EMLINK, errno.EXDEV)


class Store:
    """The results of a campaign in its folder.

    `campaign.json` (which folder this is), `campaign.toml` (what was asked for), `results/JOB.json` (one job
    each), `runs/JOB/` (what trainings leave), `locks/`. A result is first written whole beside its place,
    then put there by a hard link, which fails if another is there: the first complete result stays.
    """

    def __init__(self, folder: str | Path):
        self.folder = Path(folder)
        self._results = self.folder / "results"

    @property
    def token(self) -> str | None:
        """The random word by which a worker knows the folder as the same; None where there is no campaign."""
        if not (self.folder / "campaign.json").is_file():
            return None
        about = read_json(self.folder / "campaign.json")
        if not isinstance(about, dict) or about.get("format") != _FORMAT or "token" not in about:
            raise ValueError(
                f"{self.folder / 'campaign.json'} is not what this version of sidestep writes; "
                "choose another --out"
            )
        return str(about["token"])

    def begin(self, name: str, text: str) -> None:
        """Make the folder ready for a campaign, a new one or the one that it holds.

        **Raises** `ValueError` when it holds something else.
        """
        self._refuse_what_is_not_ours()
        if self.token is None:
            write_json(
                self.folder / "campaign.json", {"format": _FORMAT, "name": name, "token": uuid.uuid4().hex}
            )
        for folder in ("results", "runs", "locks"):
            make_folder(self.folder / folder)
        # Not `runs`: there workers write, perhaps on another host, whose processes nobody knows here.
        sweep(self.folder, below=False)
        sweep(self.folder / "results")
        write_bytes(self.folder / "campaign.toml", text.encode())

    @contextmanager
    def alone(self) -> Iterator[None]:
        """While this lasts, no other command works on the folder; a killed one no longer does.

        **Raises** `FolderInUseError` when another does, `ValueError` when the folder holds something else.
        """
        self._refuse_what_is_not_ours()
        with hold(self.folder):
            yield

    def _refuse_what_is_not_ours(self) -> None:
        if self.folder.exists() and not self.folder.is_dir():
            raise ValueError(f"{self.folder} is a file, not a folder; choose another --out")
        if not self.folder.is_dir() or self.token is not None:
            return
        # What a kill leaves before `campaign.json` is in place; the first is that of earlier versions.
        begun = ("campaign.lock", ".campaign.json.")
        if not all(is_vacant(entry) or entry.name.startswith(begun) for entry in self.folder.iterdir()):
            raise ValueError(f"{self.folder} holds other files and no campaign; choose another --out")

    def lock(self, job: str) -> AbstractContextManager[None]:
        """Held by the process that runs the job: a worker taken for dead does not run it beside another."""
        return hold_files(self.folder / "locks" / f"{job}.lock", wait=True)

    def run_folder(self, job: str) -> Path:
        """Where a training of this job is kept."""
        return self.folder / "runs" / job

    def path(self, job: str) -> Path:
        """The file of a job's result."""
        return self._results / f"{job}.json"

    def read(self, job: str) -> dict[str, Any] | None:
        """The record of a job, None if there is none. A damaged file is set aside and counts as none."""
        path = self.path(job)
        try:
            content = path.read_bytes()
        except FileNotFoundError:
            return None
        record = _unsealed(content)
        if record is None or record.get("job") != job:
            aside = path.with_suffix(".damaged")
            with contextlib.suppress(FileNotFoundError):
                os.replace(path, aside)
                warnings.warn(
                    f"{path} is damaged and now called {aside.name}. Lost: the result of this job, which is "
                    "run again",
                    DamageWarning,
                    stacklevel=2,
                )
            return None
        return record

    def keep(self, record: Mapping[str, Any]) -> bool:
        """Put a record in its place unless a whole one is there; says whether it was put there."""
        job = record["job"]
        path = self.path(job)
        beside = path.with_name(f".{job}.{uuid.uuid4().hex}.tmp")
        content = _sealed(record)
        with writing(path, len(content)):
            try:
                _write_synced(beside, content)
                while not _link(beside, path):
                    if self.read(job) is not None:
                        return False
            finally:
                beside.unlink(missing_ok=True)
            sync_folder(path.parent)
        return True

    def jobs(self) -> set[str]:
        """The jobs that have a file."""
        return {path.stem for path in self._results.glob("*.json") if not path.name.startswith(".")}

    def damaged(self) -> int:
        """Files that were set aside since the folder was begun."""
        return len(list(self._results.glob("*.damaged")))


def _sealed(record: Mapping[str, Any]) -> bytes:
    text = json.dumps(json_safe(record), sort_keys=True, allow_nan=False)
    digest = hashlib.sha256(text.encode()).hexdigest()
    return f'{{"sha256": "{digest}", "record": {text}}}\n'.encode()


def _unsealed(content: bytes) -> dict[str, Any] | None:
    """The record in a file; None when any of it is missing or changed."""
    try:
        whole = json.loads(content)
        record = whole["record"]
        text = json.dumps(record, sort_keys=True, allow_nan=False)
        seal = whole["sha256"]
    except (ValueError, KeyError, TypeError):
        return None
    same = isinstance(record, dict) and hashlib.sha256(text.encode()).hexdigest() == seal
    return record if same else None


def _write_synced(path: Path, content: bytes) -> None:
    with open(path, "xb") as file:
        file.write(content)
        file.flush()
        os.fsync(file.fileno())


def _link(beside: Path, path: Path) -> bool:
    """Give the file its place; False when there is one already."""
    try:
        os.link(beside, path)
    except FileExistsError:
        return False
    except OSError as error:
        if error.errno not in _CANNOT_LINK:
            raise
        # No hard links here (FAT, some network drives): whole all the same, or found damaged and run again.
        try:
            _write_synced(path, beside.read_bytes())
        except FileExistsError:
            return False
    return True
