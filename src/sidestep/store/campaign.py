"""The folder of a campaign. It keeps exactly one result per job, even if processes are killed."""

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

    `campaign.json` (the folder's identity), `campaign.toml` (the campaign file), `results/JOB.json` (one per
    job), `runs/JOB/` (run folders of trainings), `locks/`. A result is first written completely to another
    name, then moved by a hard link, which fails if the file exists: the first complete result stays.
    """

    def __init__(self, folder: str | Path):
        self.folder = Path(folder)
        self._results = self.folder / "results"

    @property
    def token(self) -> str | None:
        """The random token by which a worker recognises the folder; None if it holds no campaign."""
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
        """Prepare the folder for a campaign, a new one or the one it holds.

        **Raises** `ValueError` when it holds something else.
        """
        self._refuse_what_is_not_ours()
        if self.token is None:
            write_json(
                self.folder / "campaign.json", {"format": _FORMAT, "name": name, "token": uuid.uuid4().hex}
            )
        for folder in ("results", "runs", "locks"):
            make_folder(self.folder / folder)
        # Not `runs`, in which workers write, perhaps on another host, whose processes are unknown here.
        sweep(self.folder, below=False)
        sweep(self.folder / "results")
        write_bytes(self.folder / "campaign.toml", text.encode())

    @contextmanager
    def alone(self) -> Iterator[None]:
        """A context in which no other command works on the folder. A killed command releases it.

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
        """The lock of the process that runs a job, so that a worker considered dead does not run it in
        parallel."""
        return hold_files(self.folder / "locks" / f"{job}.lock", wait=True)

    def run_folder(self, job: str) -> Path:
        """The run folder of this job's training."""
        return self.folder / "runs" / job

    def path(self, job: str) -> Path:
        """The file of a job's result."""
        return self._results / f"{job}.json"

    def read(self, job: str) -> dict[str, Any] | None:
        """The record of a job; None if there is none. A damaged file is renamed and counts as none."""
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
        """Store a record unless a complete one exists; returns whether it was stored."""
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
        """The jobs with a result file."""
        return {path.stem for path in self._results.glob("*.json") if not path.name.startswith(".")}

    def damaged(self) -> int:
        """Number of damaged files renamed since the folder was created."""
        return len(list(self._results.glob("*.damaged")))


def _sealed(record: Mapping[str, Any]) -> bytes:
    text = json.dumps(json_safe(record), sort_keys=True, allow_nan=False)
    digest = hashlib.sha256(text.encode()).hexdigest()
    return f'{{"sha256": "{digest}", "record": {text}}}\n'.encode()


def _unsealed(content: bytes) -> dict[str, Any] | None:
    """The record in a file; None if it is incomplete or changed."""
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
    """Move the file to its final name; False if that exists already."""
    try:
        os.link(beside, path)
    except FileExistsError:
        return False
    except OSError as error:
        if error.errno not in _CANNOT_LINK:
            raise
        # No hard links (FAT, some network drives): a partial file is detected, and the job run again.
        try:
            _write_synced(path, beside.read_bytes())
        except FileExistsError:
            return False
    return True
