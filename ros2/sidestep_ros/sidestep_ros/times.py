"""The clocks of poses and of the control cycle."""

import time
from collections.abc import Callable

from rclpy.clock import Clock, JumpThreshold
from rclpy.clock_type import ClockType
from rclpy.duration import Duration
from rclpy.node import Node

from sidestep_ros.messages import NANOSECONDS, UnusableMessageError


class Times:
    """Times in s since the node's start, which floats represent precisely.

    Poses have ROS time, which may be simulated and may be set. The control cycle must continue when the clock
    is set, so it uses a steady clock, unless time is simulated.
    """

    def __init__(self, node: Node, stamps: str = "header"):
        self._ros = node.get_clock()
        self._stamps = stamps
        self._simulated = bool(node.get_parameter("use_sim_time").value)
        self._epoch = 0 if self._simulated else self._ros.now().nanoseconds
        self.timer_clock = self._ros if self._simulated else Clock(clock_type=ClockType.STEADY_TIME)

    def seconds(self, nanoseconds: int) -> float:
        """A time of the ROS clock in s since the node's start."""
        return (nanoseconds - self._epoch) / NANOSECONDS

    def now(self) -> float:
        """ROS time, s."""
        return self.seconds(self._ros.now().nanoseconds)

    def of_cycle(self) -> float:
        """The time (s, of arbitrary origin) of the control cycle."""
        return self.now() if self._simulated else time.monotonic()

    def when_set_back(self, act: Callable[[], None]) -> None:
        """Call `act` whenever a simulated clock goes back.

        A timer on it must be reset then: rcl does so only for a timer that last ran out after the time to
        which the clock goes back, not for one that poses have always reset before it ran out.
        """
        # Keep a reference for the lifetime of the node.
        self._jumps = self._ros.create_jump_callback(
            JumpThreshold(min_forward=None, min_backward=Duration(nanoseconds=-1), on_clock_change=False),
            post_callback=lambda jump: act(),
        )

    def of_stamp(self, nanoseconds: int) -> float:
        """The time (s) of a message with this stamp, according to the parameter `stamps`.

        **Raises** `UnusableMessageError` for a zero stamp that may not be replaced.
        """
        if self._stamps == "arrival" or (nanoseconds == 0 and self._stamps == "arrival_if_zero"):
            return self.now()
        if nanoseconds == 0:
            raise UnusableMessageError("its stamp is zero (parameter 'stamps' can allow that)")
        return self.seconds(nanoseconds)
