"""Store the state of an attack, in two files: after a kill between two writes, one of them matches the rounds
in `metrics.jsonl`."""

from __future__ import annotations

import os
import warnings
from pathlib import Path
from typing import Any

from sidestep.store.checkpoints import CheckpointError, read_arrays, write_arrays
from sidestep.store.damage import DamageWarning


def _newest(folder: Path, name: str) -> Path:
    return folder / "checkpoints" / f"{name}.npz"


def _before(folder: Path, name: str) -> Path:
    return folder / "checkpoints" / f"{name}-before.npz"


def keep(folder: Path, name: str, state: Any, rows: dict[str, int], round: int) -> None:
    """Store an attack's state at the end of a round (from 0); that of the previous round is kept."""
    newest = _newest(folder, name)
    if round and newest.is_file():
        os.replace(newest, _before(folder, name))
    write_arrays(newest, state, rows=rows, round=round)


def restored(folder: Path, name: str, fresh: Any, rounds: int) -> Any:
    """The attack's state after `rounds` rounds; `fresh` if there was none.

    If it is damaged or missing, an earlier state, with a `DamageWarning`.
    """
    if fresh is None or not rounds:
        return fresh
    newest, before = _newest(folder, name), _before(folder, name)
    problems, state, learned = [], fresh, 0
    for path in (newest, before):
        try:
            found, about = read_arrays(path, fresh)
        except CheckpointError as error:
            problems.append(str(error))
            continue
        if learned < int(about["round"]) + 1 <= rounds:
            state, learned = found, int(about["round"]) + 1
            if path == before:
                os.replace(before, newest)
    if learned < rounds:
        warnings.warn(
            f"{'; '.join(problems) or f'{newest} is of another round'}. The attack {name} goes on after "
            f"round {rounds} with what it had learned by round {learned}. Lost: what it learned in the "
            f"{rounds - learned} rounds between",
            DamageWarning,
            stacklevel=2,
        )
    return state
