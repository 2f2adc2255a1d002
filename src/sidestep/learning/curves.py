"""Training curves as TensorBoard events, in the run's `curves/` folder."""

from __future__ import annotations

import socket
import struct
import time
from pathlib import Path
from typing import Any

import numpy as np

from sidestep.store.files import append_bytes, make_folder


def _protos() -> Any:
    # A slow import, which only trainings need.
    from tensorboardX.proto import event_pb2

    return event_pb2


def _mean(lines: list[dict[str, Any]]) -> dict[str, Any]:
    """The means of these lines, as one line for the last of them."""
    names = [name for name in lines[-1] if name not in ("episode", "outcome")]
    values = {name: [line[name] for line in lines if line[name] is not None] for name in names}
    return {
        "episode": lines[-1]["episode"],
        **{name: float(np.mean(some)) for name, some in values.items() if some},
    }


class Curves:
    """Scalars over episodes: return, steps, clearances, interventions, losses.

    With `averaged`, the means of the episodes of a chunk at the last of them: many worlds end tens of
    thousands of episodes.

    Does not use tensorboardX's `SummaryWriter`: an interrupt while that passes an event to its thread can
    make its `close` wait forever.
    """

    def __init__(self, folder: str | Path, purge_step: int, averaged: bool = False):
        event, self._averaged = _protos(), averaged
        place = Path(folder) / "curves"
        make_folder(place)
        # The time in a file's name is in s; the count keeps a resume within that second from overwriting.
        count = len(list(place.glob("events.out.tfevents.*")))
        self._path = place / f"events.out.tfevents.{int(time.time())}.{socket.gethostname()}.{count:06d}"
        start = event.SessionLog(status=event.SessionLog.START)
        self._append(
            [
                event.Event(file_version="brain.Event:2"),
                event.Event(step=purge_step, file_version="brain.Event:2"),
                event.Event(step=purge_step, session_log=start),
            ]
        )

    def write(self, lines: list[dict[str, Any]], losses: Any) -> None:
        """Add the episodes of a chunk, and the means of its `losses` (critic, actor, value) at the last of
        them."""
        from tensorboardX.summary import scalar

        entries: list[tuple[str, float, int]] = []
        points = [{**line, "reached": float(line["outcome"] == "reached")} for line in lines]
        for point in [_mean(points)] if self._averaged and points else points:
            for name, value in point.items():
                if name not in ("episode", "outcome") and value is not None:
                    entries.append((f"episode/{name}", float(value), point["episode"]))
        if lines:
            for name in ("critic", "actor", "value"):
                mean = float(np.mean(getattr(losses, name)))
                entries.append((f"loss/{name}", mean, lines[-1]["episode"]))
        make = _protos().Event
        self._append([make(step=step, summary=scalar(name, value)) for name, value, step in entries])

    def _append(self, events: list[Any]) -> None:
        """As TFRecords: length, its checksum, the event, its checksum."""
        from tensorboardX.record_writer import masked_crc32c

        now, records = time.time(), []
        for event in events:
            event.wall_time = now
            data = event.SerializeToString()
            length = struct.pack("<Q", len(data))
            for part in (length, data):
                records += [part, struct.pack("<I", masked_crc32c(part))]
        # One unbuffered write: after an interrupt the chunk is in the file or not.
        append_bytes(self._path, b"".join(records))
