"""Conversion of messages to the units of `sidestep`: s, poses in the plane, velocities in world axes."""

import math
from dataclasses import dataclass
from typing import Any

from geometry_msgs.msg import PoseStamped, Quaternion, Twist, TwistStamped
from nav_msgs.msg import Odometry

NANOSECONDS = 1_000_000_000
POSE_TYPES = {"pose": PoseStamped, "odometry": Odometry}
"""Message types that carry a pose, by the name used in parameters."""
COMMAND_TYPES = {"twist": Twist, "twist_stamped": TwistStamped}
"""Message types that carry a command, by the name used in parameters."""

_QUATERNION_TOLERANCE = 0.01


class UnusableMessageError(ValueError):
    """An unusable message; the text is the reason shown in diagnostics."""


@dataclass(frozen=True)
class Pose:
    """A robot's pose: `nanoseconds` of the stamp (0: none given), x and y (m), heading (rad)."""

    nanoseconds: int
    x: float
    y: float
    heading: float


def nanoseconds(stamp: Any) -> int:
    """A `builtin_interfaces/Time` as a whole number of nanoseconds."""
    return stamp.sec * NANOSECONDS + stamp.nanosec


def heading_of(quaternion: Quaternion) -> float:
    """Heading (rad) of an orientation: the turn about z.

    **Raises** `UnusableMessageError` unless it is a unit quaternion; zeros mean that the publisher did not
    set it. Non-finite numbers give NaN, which the decision core rejects.
    """
    x, y, z, w = quaternion.x, quaternion.y, quaternion.z, quaternion.w
    length = math.hypot(x, y, z, w)
    if not math.isfinite(length):
        return math.nan
    if abs(length - 1.0) > _QUATERNION_TOLERANCE:
        raise UnusableMessageError(f"its orientation is no unit quaternion (length {length:.3g})")
    return math.atan2(2.0 * (w * z + x * y), 1.0 - 2.0 * (y * y + z * z))


def quaternion_of(heading: float) -> Quaternion:
    """Orientation of a heading (rad)."""
    return Quaternion(z=math.sin(heading / 2.0), w=math.cos(heading / 2.0))


def read_pose(message: Any, frame: str, *, with_heading: bool = True) -> Pose:
    """The pose in a `PoseStamped` or `Odometry`.

    **Raises** `UnusableMessageError` if it is not in `frame`, or lacks a required valid orientation.
    """
    if message.header.frame_id != frame:
        raise UnusableMessageError(f"it is in frame '{message.header.frame_id}', not '{frame}'")
    pose = message.pose.pose if isinstance(message, Odometry) else message.pose
    heading = heading_of(pose.orientation) if with_heading else 0.0
    return Pose(nanoseconds(message.header.stamp), pose.position.x, pose.position.y, heading)


def write_pose(kind: str, stamp: Any, frame: str, child: str, x: float, y: float, heading: float) -> Any:
    """A `PoseStamped` or `Odometry` (by `kind`) in `frame`; `child` is the robot's body frame."""
    message = POSE_TYPES[kind]()
    message.header.stamp = stamp
    message.header.frame_id = frame
    if isinstance(message, Odometry):
        message.child_frame_id = child
        pose = message.pose.pose
    else:
        pose = message.pose
    pose.position.x, pose.position.y = x, y
    pose.orientation = quaternion_of(heading)
    return message


def rotate(x: float, y: float, angle: float) -> tuple[float, float]:
    """The vector (x, y) rotated by `angle` (rad), counter-clockwise."""
    cosine, sine = math.cos(angle), math.sin(angle)
    return cosine * x - sine * y, sine * x + cosine * y


def twist_of(message: Any) -> Twist:
    """The `Twist` in a command of either type."""
    return message.twist if isinstance(message, TwistStamped) else message


def write_command(kind: str, stamp: Any, frame: str, x: float, y: float, turn_rate: float) -> Any:
    """A `Twist` or `TwistStamped` (by `kind`) with a velocity (m/s) and a turn rate (rad/s)."""
    message = COMMAND_TYPES[kind]()
    twist = twist_of(message)
    twist.linear.x, twist.linear.y, twist.angular.z = x, y, turn_rate
    if isinstance(message, TwistStamped):
        message.header.stamp = stamp
        message.header.frame_id = frame
    return message
