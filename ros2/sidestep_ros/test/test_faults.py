"""Faults, injected live into a shield node: each has its reaction, none lets the wish through unfiltered."""

import math

import pytest
from conftest import Robots, Spinner, wait_until
from geometry_msgs.msg import Quaternion
from sidestep_ros.recorder import values_of

SPEED = 0.1574
SPEED_TOLERANCE = 1e-4


@pytest.fixture(scope="module")
def robots(middleware):
    robots = Robots()
    with Spinner(robots):
        yield robots


@pytest.fixture(scope="module")
def node(start, robots):
    node = start("shield_node", "shield:=game", "diagnostics_period:=0.0").wait_ready()
    wait_until(lambda: level(robots) == "normal", "a normal decision")
    return node


@pytest.fixture
def live(node, robots):
    """The robots before a fault, in good order; and in good order again after it."""
    yield robots
    robots.spoil.clear()
    wait_until(lambda: level(robots) == "normal", "all to be well again")
    for twist in robots.commands:
        assert math.hypot(twist.linear.x, twist.linear.y) <= SPEED + SPEED_TOLERANCE


def level(robots):
    """The level of the newest decision that diagnostics told of."""
    for statuses in reversed(robots.told):
        if "decisions" in statuses and statuses["decisions"].values:
            return values_of(statuses["decisions"])["level"]
    return None


def heard(robots, about, words, wanted=None):
    """Wait for diagnostics on `about` with `words`, at level `wanted` if given; returns the status."""
    begin = len(robots.told)

    def found():
        for statuses in robots.told[begin:]:
            if about not in statuses or words not in statuses[about].message:
                continue
            if wanted is None or values_of(statuses["decisions"])["level"] == wanted:
                return statuses[about]
        return None

    return wait_until(found, f"'{words}' in the diagnostics on {about}", 60.0)


def with_stamp(robots, ahead):
    def change(message):
        message.header.stamp = robots.stamp(ahead)
        return message

    return change


def now_and_then(change, every):
    """`change` on one message of so many."""
    count = 0

    def sometimes(message):
        nonlocal count
        count += 1
        return change(message) if count % every == 0 else message

    return sometimes


def nan_place(message):
    message.pose.position.x = math.nan
    return message


def moved(message):
    message.pose.position.x += 2.0
    return message


def nan_wish(message):
    message.linear.x = math.nan
    return message


def in_odom(message):
    message.header.frame_id = "odom"
    return message


def without_stamp(message):
    message.header.stamp.sec = message.header.stamp.nanosec = 0
    return message


def without_orientation(message):
    message.pose.orientation = Quaternion(w=0.0)
    return message


def nothing(message):
    return None


def show(report, fault, status):
    report(f"fault: {fault}: {values_of(status).get('level', '')} | {status.message}")


@pytest.mark.parametrize("robot, wanted", [("pursuer", "evade"), ("obstacle", "evade"), ("evader", "stop")])
def test_stale_pose(live, report, robot, wanted):
    live.spoil[robot] = nothing
    show(report, f"no pose of the {robot}", heard(live, "decisions", "stale", wanted))
    if wanted == "stop":
        assert wait_until(lambda: live.command() == (0.0, 0.0), "a stop")
        return
    away = [a - b for a, b in zip(live.poses["evader"], live.poses["pursuer"], strict=True)][:2]
    wait_until(
        lambda: (
            sum(a * v for a, v in zip(away, live.command(), strict=True)) > 0.9 * SPEED * math.hypot(*away)
        ),
        "a flight from the pursuer",
    )


@pytest.mark.parametrize("robot", ["evader", "pursuer", "obstacle"])
def test_pose_that_is_not_finite(live, report, robot):
    live.spoil[robot] = now_and_then(nan_place, 3)
    show(
        report,
        f"one pose of the {robot} in three is not finite",
        heard(live, "decisions", "not finite, dropped"),
    )


def test_orientation_that_was_not_filled_in(live, report):
    live.spoil["pursuer"] = now_and_then(without_orientation, 3)
    show(report, "one orientation in three is all zeros", heard(live, "messages", "unit quaternion"))


def test_poses_out_of_order(live, report):
    live.spoil["pursuer"] = now_and_then(with_stamp(live, -0.08), 3)
    show(report, "one pose in three is older than the one before", heard(live, "decisions", "out of order"))


def test_stamp_from_the_future(live, report):
    live.spoil["pursuer"] = now_and_then(with_stamp(live, 60.0), 3)
    show(report, "one stamp in three is a minute ahead", heard(live, "decisions", "from the future"))


def test_stamp_of_zero(live, report):
    live.spoil["pursuer"] = now_and_then(without_stamp, 3)
    show(report, "one stamp in three is zero", heard(live, "messages", "its stamp is zero"))


def test_pose_in_another_frame(live, report):
    live.spoil["pursuer"] = now_and_then(in_odom, 3)
    show(report, "one pose in three is in another frame", heard(live, "messages", "frame 'odom', not 'map'"))


def test_all_poses_in_another_frame_are_as_none(live, report):
    live.spoil["evader"] = in_odom
    show(report, "every pose of the evader is in another frame", heard(live, "decisions", "stale", "stop"))


@pytest.mark.parametrize("robot", ["pursuer", "evader"])
def test_pose_that_jumps(live, report, robot):
    live.spoil[robot] = now_and_then(moved, 3)
    show(report, f"one pose of the {robot} in three is 2 m off", heard(live, "decisions", "jump, dropped"))


def test_robot_that_was_carried_away_is_believed_after_a_while(live, report):
    live.spoil["pursuer"] = moved
    show(
        report, "the pursuer is suddenly 2 m off, and stays there", heard(live, "decisions", "somewhere else")
    )
    wait_until(lambda: level(live) == "normal", "the new place to be believed")


def test_lost_nominal_command(live, report):
    live.spoil["nominal"] = nothing
    show(report, "no nominal command", heard(live, "decisions", "nominal velocity lost", "degraded"))


def test_nominal_command_that_is_not_finite(live, report):
    live.spoil["nominal"] = now_and_then(nan_wish, 3)
    show(
        report,
        "one nominal command in three is not finite",
        heard(live, "decisions", "nominal: 1 not finite"),
    )


def test_late_cycle(live, node, report):
    node.hold_up(0.15)
    show(report, "the node is held up for 0.15 s", heard(live, "decisions", "late command"))


def test_wish_into_the_pursuer_is_not_let_through(live):
    x, y, _ = live.poses["evader"]
    live.poses["pursuer"][:2] = x + 0.28, y
    live.nominal = (SPEED, 0.0)
    # A jump is believed after some poses; before that, commands are of the pursuer where it was.
    heard(live, "decisions", "somewhere else")
    wait_until(lambda: live.command()[0] < 0.2 * SPEED, "a correction")
    live.nominal = (0.0, -0.02)
    live.poses["pursuer"][:2] = x + 1.2, y + 0.6
    heard(live, "decisions", "somewhere else")


def test_last_word_is_a_stop(live, node, report):
    live.nominal = (0.05, 0.0)
    wait_until(lambda: math.hypot(*live.command()) > 0.01, "motion")
    assert node.stop() == 0, node.said
    wait_until(lambda: live.command() == (0.0, 0.0), "a stop", 5.0)
    report("fault: the node is told to end (SIGINT): its last command is a stop")
    assert "Traceback" not in node.said
