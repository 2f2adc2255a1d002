"""The log of a node's decisions."""

import os
from typing import Any, final

from sidestep_ros.parameters import ConfigurationError


@final
class DecisionLog:
    """Writes every decision of a node and its estimated world to an MCAP file; nothing without a path.

    **Raises** `ConfigurationError` if the file exists or cannot be created, or if packages are missing.
    """

    def __init__(self, path: str, scenario: Any, frame: str, about: dict[str, Any]):
        self._writer: Any = None
        self._ahead, self._last = 0.0, 0.0
        if not path:
            return
        from sidestep.bridges.logs import LogWriter

        try:
            self._writer = LogWriter(os.path.expanduser(path), scenario, about, frame=frame)
        except (ValueError, OSError) as error:
            raise ConfigurationError([f"'log': {error}"]) from error

    def add(self, stamp: float, decision: Any) -> str:
        """Write a decision. Returns the error, after which nothing more is written, so that the robot
        continues.

        Times in the file never decrease, even if those of the decisions (`stamp`, s) do.
        """
        if self._writer is None:
            return ""
        from sidestep.store.files import OutputError

        self._ahead = max(self._ahead, self._last - stamp)
        self._last = stamp + self._ahead
        try:
            self._writer.onboard(self._last, decision)
        except OutputError as error:
            self._writer = None
            return f"cannot be written any more: {error}"
        return ""

    def close(self) -> None:
        """Complete the file."""
        if self._writer is not None:
            self._writer.close()
