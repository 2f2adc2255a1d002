"""Messages: nothing ambiguous may pass for a pose or a command."""

import math

import pytest
from geometry_msgs.msg import PoseStamped, Quaternion, Twist, TwistStamped
from nav_msgs.msg import Odometry
from sidestep_ros.commands import Attitude, Commands
from sidestep_ros.messages import (
    UnusableMessageError,
    heading_of,
    quaternion_of,
    read_pose,
    twist_of,
    write_pose,
)


class FixedTimes:
    """Times that stand still."""

    def __init__(self, now=100.0):
        self.value = now

    def now(self):
        return self.value

    def of_stamp(self, nanoseconds):
        return nanoseconds * 1e-9


def make_commands(kind="twist", axes="body", attitude=None, times=None):
    values = {
        "command.type": kind, "command.axes": axes, "command.body_frame": "base_link", "frame": "map",
        "turn_rate_limit": 1.0,
    }  # fmt: skip
    return Commands(values, times or FixedTimes(), attitude or Attitude(), 0.05)


@pytest.mark.parametrize("heading", [-3.1, -1.0, 0.0, 0.3, 3.1])
def test_heading_survives_the_quaternion(heading):
    assert heading_of(quaternion_of(heading)) == pytest.approx(heading)


def test_orientation_of_zeros_is_refused():
    with pytest.raises(UnusableMessageError, match="unit quaternion"):
        heading_of(Quaternion(x=0.0, y=0.0, z=0.0, w=0.0))


def test_orientation_that_is_not_finite_reaches_the_core_as_nan():
    assert math.isnan(heading_of(Quaternion(w=math.inf)))


@pytest.mark.parametrize("kind", ["pose", "odometry"])
def test_pose_in_another_frame_is_refused(kind):
    message = write_pose(kind, PoseStamped().header.stamp, "odom", "base_link", 1.0, 2.0, 0.5)
    with pytest.raises(UnusableMessageError, match="'odom', not 'map'"):
        read_pose(message, "map")
    pose = read_pose(message, "odom")
    assert (pose.x, pose.y, pose.heading) == pytest.approx((1.0, 2.0, 0.5))


def test_pose_without_a_frame_is_refused():
    with pytest.raises(UnusableMessageError, match="frame ''"):
        read_pose(Odometry(), "map")


def test_obstacle_needs_no_orientation():
    message = PoseStamped()
    message.header.frame_id = "map"
    message.pose.orientation = Quaternion(w=0.0)
    assert read_pose(message, "map", with_heading=False).heading == 0.0
    with pytest.raises(UnusableMessageError):
        read_pose(message, "map")


def test_stamp_keeps_its_nanoseconds():
    message = PoseStamped()
    message.header.frame_id = "map"
    message.header.stamp.sec, message.header.stamp.nanosec = 1_800_000_000, 123_456_789
    assert read_pose(message, "map").nanoseconds == 1_800_000_000_123_456_789


def test_body_command_is_turned_by_the_heading_and_back():
    attitude = Attitude()
    attitude.see(100.0, math.pi / 2.0)
    commands = make_commands(attitude=attitude)
    twist = Twist()
    twist.linear.x = 0.1
    when, velocity, turn_rate = commands.read(twist)
    assert (when, turn_rate) == (100.0, 0.0)
    assert velocity == pytest.approx((0.0, 0.1))
    out = commands.write(None, *velocity, 0.0)
    assert (out.linear.x, out.linear.y) == pytest.approx((0.1, 0.0))


def test_world_command_is_not_turned():
    attitude = Attitude()
    attitude.see(100.0, 1.0)
    commands = make_commands(axes="world", attitude=attitude)
    out = commands.write(None, 0.1, -0.05, 0.0)
    assert (out.linear.x, out.linear.y) == pytest.approx((0.1, -0.05))


def test_velocity_of_a_turning_base_is_right_in_the_middle_of_the_period():
    attitude = Attitude()
    attitude.see(100.0, 0.0)
    out = make_commands(attitude=attitude).write(None, 0.1, 0.0, 0.8)
    middle = 0.8 * 0.05 / 2.0
    world = (
        math.cos(middle) * out.linear.x - math.sin(middle) * out.linear.y,
        math.sin(middle) * out.linear.x + math.cos(middle) * out.linear.y,
    )
    assert world == pytest.approx((0.1, 0.0))


def test_heading_is_predicted_by_the_turn_rate_commanded():
    attitude = Attitude()
    attitude.see(100.0, 0.2)
    attitude.turn_rate = 0.5
    assert attitude.at(100.1) == pytest.approx(0.25)
    assert attitude.at(99.0) == 0.2


def test_turn_rate_is_limited_and_nan_is_no_turning():
    twist = Twist()
    twist.angular.z = -7.0
    assert make_commands().read(twist)[2] == -1.0
    twist.angular.z = math.nan
    assert make_commands().read(twist)[2] == 0.0


@pytest.mark.parametrize("frame, turned", [("base_link", True), ("map", False), ("", True)])
def test_stamped_command_is_read_in_the_frame_it_names(frame, turned):
    attitude = Attitude()
    attitude.see(100.0, math.pi / 2.0)
    message = TwistStamped()
    message.header.frame_id = frame
    message.header.stamp.sec = 99
    message.twist.linear.x = 0.1
    when, velocity, _ = make_commands("twist_stamped", attitude=attitude).read(message)
    assert when == 99.0
    assert velocity == pytest.approx((0.0, 0.1) if turned else (0.1, 0.0))


def test_stamped_command_in_an_unknown_frame_is_refused():
    message = TwistStamped()
    message.header.frame_id = "camera"
    with pytest.raises(UnusableMessageError, match="'camera', not in 'base_link', 'map'"):
        make_commands("twist_stamped").read(message)


def test_answer_has_the_type_and_frame_asked_for():
    stamped = make_commands("twist_stamped", "world").write(TwistStamped().header.stamp, 0.1, 0.0, 0.0)
    assert isinstance(stamped, TwistStamped)
    assert stamped.header.frame_id == "map"
    assert twist_of(stamped).linear.x == 0.1
    assert isinstance(make_commands("twist").write(None, 0.1, 0.0, 0.0), Twist)
