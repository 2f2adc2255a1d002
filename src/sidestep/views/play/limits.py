"""How much may one visitor, and all of them together, ask of the server?"""

from dataclasses import dataclass

from sidestep._bounds import VISITORS, bounded


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

    visitors: int = bounded(8, VISITORS)
    message_bytes: int = bounded(8192, least=1)
    message_rate: float = bounded(150.0, above=0.0, unit="1/s")
    message_burst: int = bounded(300, least=1)
    pending: int = bounded(64, least=1)
    frames_ahead: int = bounded(4, least=1)
    recorded_periods: int = bounded(6000, least=1)
    silence: float = bounded(60.0, above=0.0, unit="s")
