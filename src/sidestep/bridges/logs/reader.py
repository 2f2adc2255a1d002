"""Read a log of any writer, complete or cut off."""

from __future__ import annotations

import bisect
import json
import struct
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from sidestep._packages import needed
from sidestep.bridges.logs.writer import METADATA


@dataclass(frozen=True)
class Record:
    """The content of a log.

    - `topics`: per topic, its messages as (time in s, decoded message), in order of time
    - `metadata`: text by name, written by `LogWriter`; empty in logs of other software
    - `complete`: whether the log was closed; one cut off by a crash lacks about its last second
    """

    topics: Mapping[str, list[tuple[float, Any]]]
    metadata: Mapping[str, str]
    complete: bool
    _times: dict[str, list[float]] = field(default_factory=dict, repr=False, compare=False)

    def at(self, topic: str, time: float) -> Any:
        """The last message on a topic up to a time (s); None if there is none."""
        entries = self.topics.get(topic, [])
        if topic not in self._times:
            self._times[topic] = [stamp for stamp, _ in entries]
        # Stamps are whole nanoseconds.
        place = bisect.bisect_right(self._times[topic], time + 1e-9)
        return entries[place - 1][1] if place else None


def read_log(path: str | Path) -> Record:
    """Everything in an MCAP file of ROS 2 messages.

    **Raises** `ValueError` for another kind of file, an empty log, or missing mcap.
    """
    needed("mcap_ros2.decoder", "logs", "logs need")
    from mcap.exceptions import McapError
    from mcap.records import Channel, DataEnd, Message, Metadata, Schema
    from mcap.stream_reader import StreamReader
    from mcap_ros2.decoder import DecoderFactory

    path = Path(path)
    if not path.is_file():
        raise ValueError(f"there is no log {path}")
    topics: dict[str, list[tuple[float, Any]]] = {}
    metadata: dict[str, str] = {}
    schemas: dict[int, Any] = {}
    channels: dict[int, Any] = {}
    decoders, complete = DecoderFactory(), False
    with open(path, "rb") as file:
        try:
            for record in StreamReader(file, validate_crcs=True).records:
                if isinstance(record, Schema):
                    schemas[record.id] = record
                elif isinstance(record, Channel):
                    channels[record.id] = record
                elif isinstance(record, Metadata) and record.name == METADATA:
                    metadata = dict(record.metadata)
                elif isinstance(record, Message):
                    channel = channels[record.channel_id]
                    decode = decoders.decoder_for(channel.message_encoding, schemas.get(channel.schema_id))
                    if decode is not None:
                        entry = (record.log_time / 1e9, decode(record.data))
                        topics.setdefault(channel.topic, []).append(entry)
                elif isinstance(record, DataEnd):
                    complete = True
                    break
        except (McapError, ValueError, KeyError, EOFError, struct.error) as error:
            if not topics and not metadata:
                raise ValueError(
                    f"{path} is no MCAP file of ROS 2 messages: {error or type(error).__name__}"
                ) from error
    if not topics:
        raise ValueError(f"{path} holds no messages")
    for entries in topics.values():
        entries.sort(key=lambda entry: entry[0])
    return Record(topics, metadata, complete)


def about_of(record: Record) -> dict[str, Any]:
    """The writer's `about` (shield, policy, pursuer, seed, source); empty if there is none."""
    return json.loads(record.metadata.get("about", "{}"))
