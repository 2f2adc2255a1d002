"""How long is it from a pose to the command that follows it, and is every late command reported?

    make .venv-ros/.ready      # once
    .venv/bin/python ros2/private_network.py .venv-ros/bin/python benchmarks/ros_loop.py --json FILE

The twin and the policy node run as processes of their own, as `python -m sidestep_ros...`, and this one
records what the robot's base would hear. The latency runs from the stamp of the newest pose that a decision
used to the arrival of its command here, by the machine's clock. The obstacle stands still, so that it stays
where the targets are, and each target that is reached gives way to another: the evader is chased on.
"""

import argparse
import contextlib
import json
import signal
import subprocess
import sys
import threading
import time
from pathlib import Path
from typing import Any

import rclpy
from rclpy.executors import ExternalShutdownException, SingleThreadedExecutor
from sidestep_ros.recorder import Recorder, values_of

from machine import conditions, load
from sidestep.store.files import write_json

_PATIENCE = 300.0


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--minutes", type=float, default=10.0)
    parser.add_argument("--rate", type=float, default=20.0, help="control periods per second")
    parser.add_argument("--shield", default="joint", choices=("paper", "game", "joint"))
    parser.add_argument("--physics", default="plain", choices=("plain", "mujoco"))
    parser.add_argument("--sensors", default="perfect", help="of mujoco; others add a delay of their own")
    parser.add_argument("--pursuer", default="nash")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--json", type=Path)
    options = parser.parse_args()
    before = load()
    figures = measure(options)
    settings = {name: str(value) for name, value in vars(options).items() if name != "json"}
    result = {**conditions(before), "options": settings, **figures}
    print(json.dumps(figures, indent=2))
    if options.json is not None:
        write_json(options.json, result)


def measure(options: argparse.Namespace) -> dict[str, Any]:
    """Run the loop and return what was recorded of it."""
    overrides = f"[control_period={1.0 / options.rate}, 'obstacle_velocity=[0.0, 0.0]']"
    common = ("command.type:=twist_stamped", f"scenario_overrides:={overrides}")
    nodes = [
        _start("policy_node", *common, f"shield:={options.shield}", "diagnostics_period:=0.0"),
        _start(
            "twin_node", *common, f"physics:={options.physics}", f"pursuer:={options.pursuer}",
            f"seed:={options.seed}", f"sensors:={options.sensors}",
        ),
    ]  # fmt: skip
    rclpy.init()
    recorder = Recorder("sidestep_policy")
    try:
        with _spinning(recorder):
            _wait_for_commands(recorder, nodes, options.rate)
            recorder.forget()
            time.sleep(60.0 * options.minutes)
            figures = recorder.summary()
            figures["twin"] = values_of(recorder.others["sidestep_twin: robots"])
    finally:
        for node in nodes:
            node.send_signal(signal.SIGINT)
        for node in nodes:
            node.wait(30.0)
        recorder.destroy_node()
        rclpy.try_shutdown()
    return figures


def _start(module: str, *parameters: str) -> subprocess.Popen[bytes]:
    arguments = [part for parameter in parameters for part in ("-p", parameter)]
    return subprocess.Popen([sys.executable, "-m", f"sidestep_ros.{module}", "--ros-args", *arguments])


def _wait_for_commands(recorder: Recorder, nodes: list[subprocess.Popen[bytes]], rate: float) -> None:
    """Until the loop has run for two seconds: compilation and the first messages are not what is measured."""
    end = time.monotonic() + _PATIENCE
    while len(recorder.latencies()) < 2.0 * rate:
        if any(node.poll() is not None for node in nodes):
            raise SystemExit("a node ended before the loop ran; it says above why")
        if time.monotonic() > end:
            raise SystemExit(f"no commands that follow poses within {_PATIENCE:.0f} s")
        time.sleep(0.1)


@contextlib.contextmanager
def _spinning(node: Recorder):
    executor = SingleThreadedExecutor()
    executor.add_node(node)
    ended = threading.Event()

    def spin() -> None:
        with contextlib.suppress(ExternalShutdownException):
            while not ended.is_set():
                executor.spin_once(timeout_sec=0.1)

    thread = threading.Thread(target=spin, daemon=True)
    thread.start()
    try:
        yield
    finally:
        ended.set()
        thread.join()


if __name__ == "__main__":
    main()
