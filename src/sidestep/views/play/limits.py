"""How much may one visitor, and all of them together, ask of the server?"""

from dataclasses import dataclass


@dataclass(frozen=True)
class Limits:
    """Bounds that keep a server alive whatever arrives.

    - `visitors` at once; one more is told that there is no room
    - `message_bytes` of one message; a longer one ends that visitor's connection
    - `message_rate` (1/s) on average and `message_burst` at once; what comes beyond is dropped unread
    - `pending` edits that wait for the next period; further ones are refused
    - `frames_ahead`: frames sent but not yet acknowledged, beyond which newer ones replace each other here
    - `recorded_periods` of one episode; it is played on, but recorded no further
    - `silence` (s) without any message after which a visitor that has acknowledged frames before is taken to
      have gone
    """

    visitors: int = 8
    message_bytes: int = 8192
    message_rate: float = 150.0
    message_burst: int = 300
    pending: int = 64
    frames_ahead: int = 4
    recorded_periods: int = 6000
    silence: float = 60.0
