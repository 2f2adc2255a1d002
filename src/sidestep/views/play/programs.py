"""Compiled control steps, shared by all visitors and compiled in the background."""

from __future__ import annotations

import logging
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import Any, final

from sidestep.safety.shields.catalogue import SHIELDS
from sidestep.views.play.program import Program, Starts, traced
from sidestep.world import Scenario

COLD, WARMING, READY, FAILED = "cold", "warming", "ready", "failed"
"""The states of a shield's program."""

_log = logging.getLogger(__name__)


@final
class Programs:
    """The programs of all shields for one scenario, each compiled when it is first needed.

    `warm` returns at once; a separate thread compiles one shield after the other.

    **Raises** `ValueError` for custom robots, which the page does not support.
    """

    def __init__(self, scenario: Scenario, policy: Callable[..., Any]):
        scenario.check_built_in("the page", "make a video instead, sidestep evaluate --video")
        self.scenario, self.policy = scenario, policy
        self._programs = {name: Program(scenario, name, policy) for name in SHIELDS}
        self.layout = next(iter(self._programs.values()))
        self.starts = Starts(scenario, self.layout.place)
        self._states = dict.fromkeys(SHIELDS, COLD)
        self._worker = ThreadPoolExecutor(1, thread_name_prefix="sidestep-compile")

    def __getitem__(self, shield: str) -> Program:
        return self._programs[shield]

    @property
    def states(self) -> dict[str, str]:
        """The state of each shield's program."""
        return dict(self._states)

    def ready(self, shield: str) -> bool:
        """Whether `shield` can be stepped without waiting."""
        return self._states[shield] == READY

    def warm(self, *shields: str) -> None:
        """Compile those of these that are not compiled yet, in this order."""
        for shield in shields:
            if self._states[shield] == COLD:
                self._states[shield] = WARMING
                self._worker.submit(self._compile, shield)

    def close(self) -> None:
        """Stop compiling."""
        self._worker.shutdown(wait=False, cancel_futures=True)

    def _compile(self, shield: str) -> None:
        try:
            program = self._programs[shield]
            vector = program.vector(self.starts(self.scenario, 0))
            program.compile(traced(self.scenario, self.policy), vector)
            self._states[shield] = READY
        except Exception:
            # The error of this thread is shown in the log and on the page.
            _log.exception("the shield %s could not be compiled", shield)
            self._states[shield] = FAILED
