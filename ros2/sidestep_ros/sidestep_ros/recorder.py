"""Measure the latency from poses to commands, and whether every late command was reported."""

import math
from typing import Any, final

import numpy as np
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from geometry_msgs.msg import TwistStamped
from rclpy.node import Node

from sidestep_ros import quality, reports
from sidestep_ros.messages import NANOSECONDS, nanoseconds

_ROUNDING = 0.0005


@final
class Recorder(Node):
    """Takes the place of the robot's base: records stamped commands and their diagnostics.

    The recorded node needs `command.type: twist_stamped`, and `diagnostics_period: 0.0` for the latency of
    every command.
    """

    def __init__(self, of: str, command_topic: str = "cmd_vel", **options: Any):
        super().__init__("sidestep_recorder", **options)
        self._of = of
        self.arrivals: dict[int, int] = {}
        self.velocities: dict[int, tuple[float, float]] = {}
        self.decisions: dict[int, DiagnosticStatus] = {}
        self.others: dict[str, DiagnosticStatus] = {}
        self.create_subscription(TwistStamped, command_topic, self._hear_command, quality.RECORDED)
        self.create_subscription(DiagnosticArray, "/diagnostics", self._hear_diagnostics, quality.RECORDED)

    def forget(self) -> None:
        """Discard all records, for example those of the start."""
        for records in (self.arrivals, self.velocities, self.decisions):
            records.clear()

    def _hear_command(self, message: TwistStamped) -> None:
        stamp = nanoseconds(message.header.stamp)
        self.arrivals[stamp] = self.get_clock().now().nanoseconds
        self.velocities[stamp] = (message.twist.linear.x, message.twist.linear.y)

    def _hear_diagnostics(self, message: DiagnosticArray) -> None:
        for status in message.status:
            if status.name == f"{self._of}: decisions" and status.values:
                self.decisions[nanoseconds(message.header.stamp)] = status
            else:
                self.others[status.name] = status

    def latencies(self) -> np.ndarray:
        """Time (s) from the stamp of the newest pose used to the arrival of each command."""
        found = []
        # A copy, because more may arrive in another thread.
        for stamp, arrival in self.arrivals.copy().items():
            if stamp in self.decisions:
                age = float(values_of(self.decisions[stamp]).get(reports.NEWEST_POSE, math.nan))
                found.append(age + (arrival - stamp) / NANOSECONDS)
        return np.array([latency for latency in found if math.isfinite(latency)])

    def gaps(self) -> tuple[np.ndarray, np.ndarray]:
        """The stamp (ns) of each command except the first, and the time (s) since the previous one.

        Only for commands between the first and the last reported decision, because reports follow commands.
        """
        decided, arrived = sorted(self.decisions.copy()), sorted(self.arrivals.copy())
        first, last = (decided[0], decided[-1]) if decided else (0, 0)
        stamps = np.array([stamp for stamp in arrived if first <= stamp <= last], np.int64)
        return stamps[1:], np.diff(stamps) / NANOSECONDS

    def summary(self) -> dict[str, Any]:
        """Latencies (s), late commands according to their stamps, and how many of them were not reported."""
        latencies, (_, gaps) = self.latencies(), self.gaps()
        decisions = [values_of(status) for _, status in sorted(self.decisions.copy().items())]
        limit = float(decisions[0][reports.LATE_LIMIT]) if decisions else math.inf
        late = int(np.sum(gaps > limit + _ROUNDING))
        ends = [int(values[reports.LATE_COMMANDS]) for values in (decisions[:1] + decisions[-1:])]
        reported = ends[-1] - ends[0] if ends else 0
        arrivals = np.diff(np.array(sorted(self.arrivals.copy().values()), np.int64)) / NANOSECONDS
        return {
            "commands": len(self.arrivals),
            "with latency": len(latencies),
            "latency p50": _quantile(latencies, 0.5),
            "latency p99": _quantile(latencies, 0.99),
            "latency worst": _quantile(latencies, 1.0),
            "late commands": late,
            "late commands reported": reported,
            "late commands not reported": max(0, late - reported),
            "longest time between commands": _quantile(gaps, 1.0),
            "longest time between arrivals": _quantile(arrivals, 1.0),
            "levels": _count(values["level"] for values in decisions),
        }


def values_of(status: DiagnosticStatus) -> dict[str, str]:
    """The values of a status, by name."""
    return {pair.key: pair.value for pair in status.values}


def _quantile(numbers: np.ndarray, share: float) -> float | None:
    return round(float(np.quantile(numbers, share)), 6) if len(numbers) else None


def _count(words: Any) -> dict[str, int]:
    words = list(words)
    return {word: words.count(word) for word in sorted(set(words))}
