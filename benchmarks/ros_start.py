"""How long is it from the start of a ROS 2 node to the first command that it has decided on poses?

    make .venv-ros/.ready      # once
    .venv/bin/python ros2/private_network.py .venv-ros/bin/python benchmarks/ros_start.py --json FILE

Poses of all robots and a nominal command are published at 20 Hz all the time. The shield node starts as a
process of its own, as `python -m sidestep_ros.shield_node`: with an empty cache folder, then again with what
that left. The time runs from before the process starts to the first command that is not a stop.
"""

import argparse
import os
import signal
import statistics
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import rclpy  # pyright: ignore[reportMissingImports]
from geometry_msgs.msg import PoseStamped, Twist  # pyright: ignore[reportMissingImports]
from sidestep_ros import quality  # pyright: ignore[reportMissingImports]

from machine import conditions, load
from sidestep.store.files import write_json

_PATIENCE = 300.0
_POSES = {"evader": (0.0, 0.0), "pursuer": (1.5, 0.0), "obstacle": (0.0, 1.5)}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--shields", nargs="+", default=["game", "joint"], choices=("paper", "game", "joint"))
    parser.add_argument("--repeats", type=int, default=5, help="starts with a filled cache")
    parser.add_argument("--json", type=Path)
    options = parser.parse_args()
    result: dict[str, Any] = {**conditions(load()), "shields": {}}
    rclpy.init()
    for shield in options.shields:
        for compiled in (True, False):
            with tempfile.TemporaryDirectory() as cache:
                first, *warm = [_seconds(shield, compiled, cache) for _ in range(1 + options.repeats)]
            name = f"{shield}, {'compiled C' if compiled else 'JAX'}"
            found = {"cold": first, "warm": statistics.median(warm), "warm, worst": max(warm)}
            result["shields"][name] = found
            print(name, {key: round(value, 2) for key, value in found.items()}, flush=True)
            if options.json is not None:
                write_json(options.json, result)
    rclpy.try_shutdown()


def _seconds(shield: str, compiled: bool, cache: str) -> float:
    """Seconds from the start of the node to its first command that moves the base."""
    robots = rclpy.create_node("robots")
    poses = {name: robots.create_publisher(PoseStamped, f"{name}/pose", quality.POSES_OUT) for name in _POSES}
    nominal = robots.create_publisher(Twist, "cmd_vel_nominal", quality.COMMANDS)
    heard: list[float] = []

    def listen(command: Twist) -> None:
        if abs(command.linear.x) + abs(command.linear.y) > 0.0:
            heard.append(time.perf_counter())

    robots.create_subscription(Twist, "cmd_vel", listen, quality.COMMANDS)

    def publish() -> None:
        stamp = robots.get_clock().now().to_msg()
        for name, (x, y) in _POSES.items():
            message = PoseStamped()
            message.header.frame_id, message.header.stamp = "map", stamp
            message.pose.position.x, message.pose.position.y = x, y
            message.pose.orientation.w = 1.0
            poses[name].publish(message)
        wanted = Twist()
        wanted.linear.x = 0.1
        nominal.publish(wanted)

    robots.create_timer(0.05, publish)
    parameters = [f"shield:={shield}", f"compiled:={str(compiled).lower()}"]
    words = [part for parameter in parameters for part in ("-p", parameter)]
    begun = time.perf_counter()
    node = subprocess.Popen(
        [sys.executable, "-m", "sidestep_ros.shield_node", "--ros-args", *words],
        env={**os.environ, "SIDESTEP_CACHE": cache},
        stderr=subprocess.DEVNULL,
    )
    try:
        while not heard:
            if node.poll() is not None or time.perf_counter() - begun > _PATIENCE:
                raise SystemExit(f"no command from the node behind {shield}")
            rclpy.spin_once(robots, timeout_sec=0.01)
    finally:
        node.send_signal(signal.SIGINT)
        node.wait(30.0)
        robots.destroy_node()
    return heard[0] - begun


if __name__ == "__main__":
    main()
