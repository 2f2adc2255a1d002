"""Conversion between velocities in world axes and commands of the base."""

import math
from typing import Any

from geometry_msgs.msg import TwistStamped

from sidestep_ros.messages import UnusableMessageError, nanoseconds, rotate, twist_of, write_command
from sidestep_ros.times import Times


class Attitude:
    """The evader's heading: the last measured one, extrapolated with the commanded turn rate."""

    def __init__(self):
        self._heading = 0.0
        self._at = -math.inf
        self.turn_rate = 0.0

    def see(self, stamp: float, heading: float) -> None:
        """Register a measured heading (rad) at time `stamp` (s)."""
        self._heading, self._at = heading, stamp

    def at(self, now: float) -> float:
        """The extrapolated heading (rad) at time `now` (s); 0 before the first measurement."""
        return self._heading + self.turn_rate * max(0.0, now - self._at if math.isfinite(self._at) else 0.0)


class Commands:
    """Reads and writes commands of one type, in the evader's body frame or in world axes.

    A velocity in body axes rotates with a turning base, so it is converted with the heading at the middle of
    the period.
    """

    def __init__(self, values: dict[str, Any], times: Times, attitude: Attitude, period: float):
        self.kind = values["command.type"]
        self._body = values["command.axes"] == "body"
        self._frames = {values["command.body_frame"]: True, values["frame"]: False, "": self._body}
        self._frame = values["command.body_frame"] if self._body else values["frame"]
        self._times, self._attitude, self._period = times, attitude, period
        self._turn_rate_limit = values["turn_rate_limit"]

    def read(self, message: Any) -> tuple[float, tuple[float, float], float]:
        """Time (s), velocity in world axes (m/s) and limited turn rate (rad/s) of a command.

        A stamped command may be in the body frame or in the fixed frame; the parameter `command.axes` is for
        commands without a frame. **Raises** `UnusableMessageError` for any other frame.
        """
        now = self._times.now()
        when, body = now, self._body
        if isinstance(message, TwistStamped):
            body = self._frames.get(message.header.frame_id)
            if body is None:
                known = ", ".join(f"'{frame}'" for frame in self._frames if frame)
                raise UnusableMessageError(f"it is in frame '{message.header.frame_id}', not in {known}")
            stamp = nanoseconds(message.header.stamp)
            when = self._times.of_stamp(stamp) if stamp else now
        twist = twist_of(message)
        velocity = (twist.linear.x, twist.linear.y)
        if body:
            velocity = rotate(*velocity, self._attitude.at(now))
        turn_rate = twist.angular.z if math.isfinite(twist.angular.z) else 0.0
        limit = self._turn_rate_limit
        return when, velocity, min(max(turn_rate, -limit), limit)

    def write(self, stamp: Any, x: float, y: float, turn_rate: float) -> Any:
        """The message that commands velocity (x, y) (m/s, world axes) and a turn rate (rad/s) from now on."""
        if self._body:
            heading = self._attitude.at(self._times.now()) + turn_rate * self._period / 2.0
            x, y = rotate(x, y, -heading)
        self._attitude.turn_rate = turn_rate
        return write_command(self.kind, stamp, self._frame, x, y, turn_rate)
