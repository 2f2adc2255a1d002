"""Limits of the server's load by visitors."""

from dataclasses import dataclass

from sidestep._bounds import VISITORS, bounded


@dataclass(frozen=True)
class Limits:
    """Limits that protect the server from overload.

    - `visitors` at once; a further one is refused
    - `message_bytes` of one message; a longer one ends the visitor's connection
    - `message_rate` (1/s) on average and `message_burst` at once; further messages are dropped unread
    - `pending` edits that wait for the next period; further ones are refused
    - `frames_ahead`: number of unacknowledged frames from which on a new frame replaces the waiting one
    - `recorded_periods` of one episode; later periods are not recorded
    - `silence` (s) without a message after which the connection is closed, if the visitor has acknowledged
      frames before
    """

    visitors: int = bounded(8, VISITORS)
    message_bytes: int = bounded(8192, least=1)
    message_rate: float = bounded(150.0, above=0.0, unit="1/s")
    message_burst: int = bounded(300, least=1)
    pending: int = bounded(64, least=1)
    frames_ahead: int = bounded(4, least=1)
    recorded_periods: int = bounded(6000, least=1)
    silence: float = bounded(60.0, above=0.0, unit="s")
