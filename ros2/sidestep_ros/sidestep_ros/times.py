"""What time is it, for poses, for the control cycle, and for what a stamp says?"""

import time
from collections.abc import Callable

from rclpy.clock import Clock, JumpThreshold
from rclpy.clock_type import ClockType
from rclpy.duration import Duration
from rclpy.node import Node

from sidestep_ros.messages import NANOSECONDS, UnusableMessageError


class Times:
    """Times in s since the node began, small enough for full precision.

    Poses live in ROS time, which may be simulated and may be set. The cycle must go on when somebody sets the
    clock: it runs by a steady one, unless time is simulated.
    """

    def __init__(self, node: Node, stamps: str = "header"):
        self._ros = node.get_clock()
        self._stamps = stamps
        self._simulated = bool(node.get_parameter("use_sim_time").value)
        self._epoch = 0 if self._simulated else self._ros.now().nanoseconds
        self.timer_clock = self._ros if self._simulated else Clock(clock_type=ClockType.STEADY_TIME)

    def seconds(self, nanoseconds: int) -> float:
        """A time of the ROS clock as s since the node began."""
        return (nanoseconds - self._epoch) / NANOSECONDS

    def now(self) -> float:
        """ROS time, s."""
        return self.seconds(self._ros.now().nanoseconds)

    def of_cycle(self) -> float:
        """The time (s, from anywhere) that the control cycle goes by."""
        return self.now() if self._simulated else time.monotonic()

    def when_set_back(self, act: Callable[[], None]) -> None:
        """Call `act` whenever a simulated clock goes back.

        A timer on it must be reset then: rcl does so by itself only for a timer that ran out after the time
        to which the clock goes back, not for one that poses have always reset before.
        """
        # Kept for as long as the node is there.
        self._jumps = self._ros.create_jump_callback(
            JumpThreshold(min_forward=None, min_backward=Duration(nanoseconds=-1), on_clock_change=False),
            post_callback=lambda jump: act(),
        )

    def of_stamp(self, nanoseconds: int) -> float:
        """The time (s) of which a message with this stamp speaks, as the parameter `stamps` says.

        **Raises** `UnusableMessageError` for a stamp of zero that may not be replaced.
        """
        if self._stamps == "arrival" or (nanoseconds == 0 and self._stamps == "arrival_if_zero"):
            return self.now()
        if nanoseconds == 0:
            raise UnusableMessageError("its stamp is zero (parameter 'stamps' can allow that)")
        return self.seconds(nanoseconds)
