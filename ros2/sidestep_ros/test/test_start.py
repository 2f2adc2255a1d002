"""Start and end of a node: nothing wrong may start, nothing slow may be left for the loop."""

import math
import re
import signal

import pytest
from conftest import NodeProcess, Robots, Spinner, wait_until
from geometry_msgs.msg import PoseStamped
from rcl_interfaces.srv import SetParameters
from rclpy.parameter import Parameter
from rosgraph_msgs.msg import Clock
from sidestep_ros import quality
from sidestep_ros.messages import write_pose
from test_faults import heard, level


def test_node_with_wrong_parameters_says_all_of_them_and_ends(tmp_path, environment):
    node = NodeProcess(
        "shield_node", tmp_path, "sheild:=game", "grace:=-1.0", "on_fault:=panic", environment=environment
    )
    assert node.wait() == 2
    assert "no parameter 'sheild'; did you mean 'shield'?" in node.said
    assert "'grace' is -1.0, but must be between 0.0 and 1.0" in node.said
    assert "'on_fault' is 'panic', but must be one of evade, stop" in node.said
    assert "Traceback" not in node.said


def test_a_log_is_never_written_over(tmp_path, environment):
    (tmp_path / "drive.mcap").write_bytes(b"of yesterday")
    node = NodeProcess(
        "shield_node", tmp_path, f"log:={tmp_path / 'drive.mcap'}", "shield:=game", environment=environment
    )
    assert node.wait() == 2
    assert "drive.mcap exists already" in node.said
    assert (tmp_path / "drive.mcap").read_bytes() == b"of yesterday"


@pytest.fixture
def robots(middleware):
    robots = Robots()
    with Spinner(robots):
        yield robots


def test_policy_node_compiles_nothing_in_its_loop_and_takes_only_targets_that_can_be(start, robots):
    node = start(
        "policy_node", "shield:=game", "target:=[1.0, -0.5]", "diagnostics_period:=0.0", JAX_LOG_COMPILES="1"
    ).wait_ready()
    before = node.said
    assert "ompiling" in before, "JAX no longer tells what it compiles: this test would see nothing"
    accepted = []
    robots.create_subscription(PoseStamped, "/sidestep_policy/target", accepted.append, quality.LATCHED)
    wait_until(lambda: level(robots) == "normal", "a normal decision")
    wait_until(lambda: accepted and accepted[0].pose.position.x == 1.0, "the target, to one who came late")

    targets = robots.create_publisher(PoseStamped, "target", quality.TARGET)
    wait_until(targets.get_subscription_count, "the node to listen")
    for frame, x, words in (("odom", 1.0, "frame 'odom'"), ("map", float("nan"), "not two finite numbers")):
        targets.publish(write_pose("pose", robots.stamp(), frame, "", x, 0.3, 0.0))
        heard(robots, "messages", words)
    targets.publish(write_pose("pose", robots.stamp(), "map", "", *robots.poses["obstacle"]))
    heard(robots, "messages", "within the collision distance (0.2 m) of obstacle 0")
    targets.publish(write_pose("pose", robots.stamp(), "map", "", 0.5, -1.0, 0.0))
    wait_until(lambda: accepted[-1].pose.position.x == 0.5, "the new target")

    client = robots.create_client(SetParameters, "/sidestep_policy/set_parameters")
    assert client.wait_for_service(20.0)

    def change(name, value):
        wanted = [Parameter(name, value=value).to_parameter_msg()]
        answer = client.call_async(SetParameters.Request(parameters=wanted))
        wait_until(answer.done, f"an answer about {name}")
        return answer.result().results[0]

    assert change("target", [0.2, -1.0]).successful
    wait_until(lambda: accepted[-1].pose.position.x == 0.2, "the target of the parameter")
    refused = change("target", robots.poses["obstacle"][:2])
    assert not refused.successful
    assert "collision distance" in refused.reason
    assert not change("shield", "paper").successful
    assert not change("stale_after", 9.0).successful

    since = node.said.removeprefix(before)
    assert not re.search(r"ompiling|Finished tracing", since), since
    assert node.stop(signal.SIGTERM) == 0
    assert robots.command() == (0.0, 0.0)


def test_robot_told_to_stop_on_faults_does_not_flee(start, robots, report):
    node = start("shield_node", "shield:=game", "on_fault:=stop", "diagnostics_period:=0.0").wait_ready()
    robots.nominal = (0.05, 0.0)
    wait_until(lambda: level(robots) == "normal", "a normal decision")
    wait_until(lambda: math.hypot(*robots.command()) > 0.01, "motion")
    for robot in ("pursuer", "obstacle"):
        robots.spoil[robot] = lambda message: None
        status = heard(robots, "decisions", "stale", "stop")
        assert "standing still" in status.message
        assert wait_until(lambda: robots.command() == (0.0, 0.0), "a stop")
        report(f"fault: on_fault: stop, no pose of the {robot}: stop | {status.message}")
        robots.spoil.clear()
        wait_until(lambda: level(robots) == "normal", "all to be well again")
        wait_until(lambda: math.hypot(*robots.command()) > 0.01, "motion again")
    assert node.stop() == 0, node.said


def test_clock_that_goes_back_begins_anew(start, robots):
    """As when a recording is played in a loop."""
    clock = robots.create_publisher(Clock, "/clock", 1)
    time = [1000.0]

    def tick():
        time[0] += 0.02
        message = Clock()
        message.clock.sec, message.clock.nanosec = int(time[0]), round(1e9 * (time[0] % 1.0)) % 10**9
        clock.publish(message)

    def stamped(message):
        message.header.stamp.sec, message.header.stamp.nanosec = (
            int(time[0]),
            round(1e9 * (time[0] % 1.0)) % 10**9,
        )
        return message

    robots.spoil = dict.fromkeys(("evader", "pursuer", "obstacle"), stamped)
    robots.create_timer(0.02, tick)
    node = start("shield_node", "shield:=game", "use_sim_time:=true", "diagnostics_period:=0.0").wait_ready()
    wait_until(lambda: level(robots) == "normal", "a normal decision")
    time[0] = 500.0
    heard(robots, "messages", "clock: it went back by")
    heard(robots, "decisions", "normal", "normal")
    assert node.stop() == 0, node.said
