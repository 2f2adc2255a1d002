"""The diagnostics of a node."""

import math
from collections import Counter
from collections.abc import Mapping
from typing import Any

from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue

OK, WARN, ERROR = DiagnosticStatus.OK, DiagnosticStatus.WARN, DiagnosticStatus.ERROR
NEWEST_POSE = "newest pose to command (s)"
LATE_COMMANDS = "late commands"
LATE_LIMIT = "late if more than (s)"
"""Names of values that `recorder` reads."""
SEVERITY = {"normal": OK, "degraded": WARN, "evade": ERROR, "stop": ERROR}
"""Diagnostic level per level of a decision."""


def text(value: object) -> str:
    """A value as text for diagnostics."""
    return f"{value:.6g}" if isinstance(value, float) else str(value)


def array(stamp: Any, *statuses: DiagnosticStatus) -> DiagnosticArray:
    """Statuses as one message."""
    message = DiagnosticArray(status=list(statuses))
    message.header.stamp = stamp
    return message


def status(name: str, level: bytes, message: str, values: Mapping[str, object]) -> DiagnosticStatus:
    """One status with its values."""
    pairs = [KeyValue(key=key, value=text(value)) for key, value in values.items()]
    return DiagnosticStatus(level=level, name=name, hardware_id="sidestep", message=message, values=pairs)


class Complaints:
    """Errors of messages: counts since the start, and those not reported yet."""

    def __init__(self):
        self.counts: Counter[str] = Counter()
        self._fresh: dict[str, str] = {}

    @property
    def fresh(self) -> tuple[str, ...]:
        """Errors that are not reported yet."""
        return tuple(self._fresh.values())

    def add(self, about: str, why: str) -> None:
        """Count an unused message on `about`, with the reason."""
        self.counts[about] += 1
        self._fresh[about] = f"{about}: {why}"

    def reported(self) -> None:
        """Mark all errors as reported."""
        self._fresh.clear()


def decision_values(decision: Any, names: tuple[str, ...]) -> dict[str, object]:
    """The values of a decision (`sidestep.robot.Decision`), with `names` of the statuses."""
    return {
        "status": names[int(decision.status)],
        "level": decision.level,
        "reactions": "; ".join(decision.reactions) or "none",
        "clearance (m)": float(decision.clearance),
        "slack (m/s)": float(decision.slack),
        "intervention (m/s)": float(decision.intervention),
        "least barrier (m)": min(map(float, decision.barriers), default=math.inf),
        "pose age at decision (s)": float(decision.latency),
        "decision took (s)": float(decision.compute_seconds),
    }
