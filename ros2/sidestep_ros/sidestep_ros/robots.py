"""Subscriptions to the poses of all robots."""

import functools
from collections.abc import Callable
from typing import Any

from rclpy.node import Node

from sidestep_ros import quality
from sidestep_ros.commands import Attitude
from sidestep_ros.messages import POSE_TYPES, UnusableMessageError, read_pose
from sidestep_ros.reports import Complaints
from sidestep_ros.times import Times

_OF_ONE_SWEEP = 0.75


class Robots:
    """Subscribes to the poses of evader, pursuers and obstacles, and passes them to the decision core.

    Accepted headings of the evader also go to `attitude`, and unusable messages to `complaints`.
    `on_complete` is called when a pose of every robot has arrived since `begin_anew`, and the poses' stamps
    differ by less than three quarters of the `period` (s). Without that limit, a pose that arrives just after
    a decision would make every following set complete too early.
    """

    def __init__(
        self,
        node: Node,
        values: dict[str, Any],
        times: Times,
        attitude: Attitude,
        complaints: Complaints,
        on_complete: Callable[[], None],
        period: float,
    ):
        self._node, self._times = node, times
        self._attitude, self._complaints, self._on_complete = attitude, complaints, on_complete
        self._frame, self._spread = values["frame"], _OF_ONE_SWEEP * period
        self._topics = {("evader", 0): (values["evader.topic"], POSE_TYPES[values["evader.type"]])}
        for kind in ("pursuer", "obstacle"):
            for index, topic in enumerate(values[f"{kind}s.topics"]):
                self._topics[kind, index] = (topic, POSE_TYPES[values[f"{kind}s.type"]])
        self._heard: set[tuple[str, int]] = set()
        self._stamps: dict[tuple[str, int], float] = {}

    def subscribe(self, onboard: Any) -> None:
        """Subscribe, and pass poses to `onboard` from now on."""
        self._onboard = onboard
        for (kind, index), (topic, message_type) in self._topics.items():
            hear = functools.partial(self._hear, kind, index)
            self._node.create_subscription(message_type, topic, hear, quality.POSES_IN)

    def begin_anew(self) -> None:
        """Begin a new set of poses after a decision."""
        self._heard.clear()

    def forget(self) -> None:
        """Forget all poses."""
        self._heard.clear()
        self._stamps.clear()

    @property
    def newest(self) -> float | None:
        """Stamp (s) of the newest pose accepted."""
        return max(self._stamps.values(), default=None)

    def ages(self, now: float) -> dict[str, object]:
        """Age (s) of each robot's last accepted pose, by its name."""
        return {
            f"{kind} {index}": now - self._stamps[kind, index]
            if (kind, index) in self._stamps
            else "never seen"
            for kind, index in self._topics
        }

    def _hear(self, kind: str, index: int, message: Any) -> None:
        try:
            pose = read_pose(message, self._frame, with_heading=kind != "obstacle")
            stamp = self._times.of_stamp(pose.nanoseconds)
        except UnusableMessageError as error:
            self._complaints.add(f"{kind} {index}", str(error))
            return
        place = (pose.x, pose.y) if kind == "obstacle" else (pose.x, pose.y, pose.heading)
        reading = self._onboard.see(kind, stamp, place, index, now=self._times.now())
        if not reading.used:
            self._complaints.add(f"{kind} {index}", reading.value)
            return
        if kind == "evader":
            self._attitude.see(stamp, pose.heading)
        self._stamps[kind, index] = stamp
        self._heard.add((kind, index))
        stamps = [self._stamps[robot] for robot in self._heard]
        if len(stamps) == len(self._topics) and max(stamps) - min(stamps) < self._spread:
            self._on_complete()
