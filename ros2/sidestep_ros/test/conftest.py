"""Live nodes, and robots that do as a test says."""

import contextlib
import functools
import os
import signal
import subprocess
import sys
import threading
import time
from pathlib import Path

import pytest
import rclpy
from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import PoseStamped, Twist
from rclpy.duration import Duration
from rclpy.executors import ExternalShutdownException, SingleThreadedExecutor
from rclpy.node import Node
from sidestep_ros import quality
from sidestep_ros.messages import rotate, write_command, write_pose

PATIENCE = 240.0

assert os.environ.get("ROS_AUTOMATIC_DISCOVERY_RANGE") == "LOCALHOST", "run these tests with `make test-ros`"
# Processes that test at the same time do not hear each other.
_WORKER = int(os.environ.get("PYTEST_XDIST_WORKER", "gw0")[2:])
os.environ["ROS_DOMAIN_ID"] = str((int(os.environ["ROS_DOMAIN_ID"]) + _WORKER) % 100)


def pytest_terminal_summary(terminalreporter):
    """What was measured and seen; of times nothing is asserted."""
    for reports in terminalreporter.stats.values():
        for report in reports:
            for name, line in getattr(report, "user_properties", ()):
                if name == "seen" and report.when == "call":
                    terminalreporter.write_line(line)


@pytest.fixture
def report(record_property):
    """`report(line)` shows a line at the end of the run."""
    return functools.partial(record_property, "seen")


@pytest.fixture(scope="session")
def middleware():
    rclpy.init()
    yield
    rclpy.try_shutdown()


def wait_until(condition, what, seconds=PATIENCE):
    """Wait for something that must happen, however slow the machine."""
    end = time.monotonic() + seconds
    while time.monotonic() < end:
        found = condition()
        if found:
            return found
        time.sleep(0.005)
    raise AssertionError(f"waited {seconds:.0f} s in vain for {what}")


class NodeProcess:
    """A node as users start it without colcon, with everything it says in a file."""

    def __init__(self, module, folder, *parameters, environment=()):
        self.log = Path(folder) / f"{module}-{time.monotonic_ns()}.log"
        arguments = [part for parameter in parameters for part in ("-p", parameter)]
        with self.log.open("wb") as file:
            self._process = subprocess.Popen(
                [sys.executable, "-m", f"sidestep_ros.{module}", "--ros-args", *arguments],
                stdout=file,
                stderr=subprocess.STDOUT,
                env={**os.environ, **dict(environment)},
            )

    @property
    def said(self):
        return self.log.read_text(errors="replace")

    def wait_ready(self):
        def ready():
            assert self._process.poll() is None, self.said
            return "ready" in self.said

        wait_until(ready, f"{self.log.name} to be ready")
        return self

    def hold_up(self, seconds):
        """Let it stand still, as a busy machine would."""
        self._process.send_signal(signal.SIGSTOP)
        time.sleep(seconds)
        self._process.send_signal(signal.SIGCONT)

    def stop(self, number=signal.SIGINT):
        """Ask it to end; returns its exit status."""
        if self._process.poll() is None:
            self._process.send_signal(number)
        return self.wait()

    def wait(self):
        try:
            return self._process.wait(30)
        except subprocess.TimeoutExpired:
            self._process.kill()
            raise


@pytest.fixture(scope="session")
def environment(tmp_path_factory):
    """Processes compile each program once for the whole run, and as fast as they can."""
    return {
        "JAX_COMPILATION_CACHE_DIR": str(tmp_path_factory.mktemp("compiled")),
        "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS": "0",
        "XLA_FLAGS": "--xla_backend_optimization_level=1",
    }


@pytest.fixture(scope="module")
def start(tmp_path_factory, environment):
    """`start("shield_node", "shield:=game", ...)`: a live node; ended with the tests of the file."""
    running = []

    def start(module, *parameters, **more):
        folder = tmp_path_factory.getbasetemp()
        running.append(NodeProcess(module, folder, *parameters, environment={**environment, **more}))
        return running[-1]

    yield start
    for process in running:
        with contextlib.suppress(subprocess.TimeoutExpired):
            process.stop()


class Spinner:
    """Nodes of the test's own, run in a thread."""

    def __init__(self, *nodes):
        self._executor = SingleThreadedExecutor()
        self._nodes = nodes
        for node in nodes:
            self._executor.add_node(node)
        self._going = True
        self._thread = threading.Thread(target=self._spin, daemon=True)

    def _spin(self):
        with contextlib.suppress(ExternalShutdownException):
            while self._going:
                self._executor.spin_once(timeout_sec=0.1)

    def __enter__(self):
        self._thread.start()
        return self

    def __exit__(self, *error):
        self._going = False
        self._thread.join()
        for node in self._nodes:
            node.destroy_node()


class Robots(Node):
    """An evader that drives as told, a pursuer and an obstacle that stand still, seen `rate` times a second.

    `spoil[robot]` (or `spoil["nominal"]`) takes each message on its way out, and returns what is published in
    its place, or None. `commands` holds what arrived, `told` the diagnostics, newest last.
    """

    def __init__(self, rate=20.0, frame="map"):
        super().__init__("robots")
        self.period, self.frame = 1.0 / rate, frame
        self.poses = {"evader": [0.0, 0.0, 0.7], "pursuer": [1.2, 0.6, 3.0], "obstacle": [-1.2, 0.8, 0.0]}
        self.nominal = (0.0, -0.02)
        self.spoil = {}
        self.commands = []
        self.told = []
        self._to = {
            robot: self.create_publisher(PoseStamped, f"{robot}/pose", quality.POSES_OUT)
            for robot in self.poses
        }
        self._nominal = self.create_publisher(Twist, "cmd_vel_nominal", quality.COMMANDS)
        self.create_subscription(Twist, "cmd_vel", self._obey, quality.RECORDED)
        self.create_subscription(DiagnosticArray, "/diagnostics", self._read, quality.RECORDED)
        self.create_timer(self.period, self._tick)

    def _obey(self, message):
        self.commands.append(message)

    def _read(self, message):
        self.told.append({status.name.partition(": ")[2]: status for status in message.status})

    def _tick(self):
        x, y, heading = self.poses["evader"]
        if self.commands:
            twist = self.commands[-1]
            vx, vy = rotate(twist.linear.x, twist.linear.y, heading)
            self.poses["evader"][:2] = x + self.period * vx, y + self.period * vy
        twist = write_command("twist", None, "", *rotate(*self.nominal, -heading), 0.0)
        self._send("nominal", self._nominal, twist)
        for robot, pose in self.poses.items():
            stamp = self.stamp()
            self._send(robot, self._to[robot], write_pose("pose", stamp, self.frame, robot, *pose))

    def stamp(self, ahead=0.0):
        """The time now, or `ahead` (s) of now, as a stamp."""
        now = self.get_clock().now() + Duration(nanoseconds=round(1e9 * ahead))
        return now.to_msg()

    def _send(self, name, publisher, message):
        message = self.spoil.get(name, lambda message: message)(message)
        if message is not None:
            publisher.publish(message)

    def command(self):
        """The newest velocity in world axes, m/s."""
        twist = self.commands[-1]
        return rotate(twist.linear.x, twist.linear.y, self.poses["evader"][2])
