"""The twin node: simulated robots for the other nodes. Publishes poses and executes commands in real time."""

import itertools
import math
import sys
from typing import Any, final

import numpy as np
from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import PoseStamped
from rclpy.node import Node
from rclpy.time import Time

from sidestep_ros import quality, reports
from sidestep_ros.commands import Attitude, Commands
from sidestep_ros.messages import COMMAND_TYPES, NANOSECONDS, POSE_TYPES, UnusableMessageError, write_pose
from sidestep_ros.parameters import SCENARIO, TOPICS, TWIN, ConfigurationError, declare
from sidestep_ros.running import run, tune_jax
from sidestep_ros.settings import check_topics, make_plant, make_scenario
from sidestep_ros.times import Times

_REPORT_SECONDS = 1.0


@final
class TwinNode(Node):
    """An evader that executes `cmd_vel`, pursuers that chase it, and drifting obstacles.

    The world advances by the elapsed time whenever a command arrives or poses are due, so a command acts from
    its arrival on. All robots stand still until the first command. Contacts are counted; after a contact a
    new episode begins.
    """

    def __init__(self, **options: Any):
        super().__init__("sidestep_twin", **options)
        self.values = values = declare(self, (*SCENARIO, *TOPICS, *TWIN))
        check_topics(values)
        self.scenario = make_scenario(values)
        period = float(self.scenario.control_period)
        self._period = period
        self._times = Times(self)
        self._attitude = Attitude()
        self._commands = Commands(
            {**values, "turn_rate_limit": math.inf}, self._times, self._attitude, period
        )
        self._complaints = reports.Complaints()
        self._wheels_for = self._make_pursuer(values["pursuer"])
        self._start = self._make_start()
        self._plant = make_plant(values, self.scenario)
        self._counts = {"captured": 0, "collided": 0, "reached": 0, "commands": 0}
        self._least = math.inf
        self._random = np.random.default_rng(values["seed"])
        self._pose_publishers = self._make_pose_publishers()
        self._target = self.create_publisher(PoseStamped, values["target_topic"], quality.TARGET)
        self._diagnostics = self.create_publisher(DiagnosticArray, "/diagnostics", quality.DIAGNOSTICS)

    def get_ready(self) -> None:
        """Compile and place all robots, then start the clock."""
        self._begin()
        self.create_subscription(
            COMMAND_TYPES[self._commands.kind], self.values["command.topic"], self._obey, quality.COMMANDS
        )
        rate = self.values["pose_rate"] or self._plant.pose_rate
        self.create_timer(1.0 / rate, self._tick, clock=self._times.timer_clock)
        self.create_timer(_REPORT_SECONDS, self._report, clock=self._times.timer_clock)
        self._moved_at = self._times.of_cycle()
        self.get_logger().info("ready")

    def leave_safe(self) -> None:
        """Nothing to do: the simulated robots stop with the node."""

    def _make_pursuer(self, name: str) -> Any:
        import equinox as eqx
        import jax

        from sidestep.pursuit import make_pursuer, pursue

        try:
            strategy = make_pursuer(name)
        except ValueError as error:
            raise ConfigurationError([f"'pursuer': {error}"]) from error

        @eqx.filter_jit
        def wheels(scenario: Any, world: Any, key: Any, asked: Any) -> Any:
            return pursue(scenario, strategy, world, jax.random.fold_in(key, asked))

        key, asked = jax.random.key(self.values["seed"]), itertools.count()
        return lambda world: np.asarray(wheels(self.scenario, world, key, np.int32(next(asked))))

    def _make_start(self) -> Any:
        import equinox as eqx
        import jax

        reset = eqx.filter_jit(lambda scenario, key: scenario.reset(key))
        return lambda seed: reset(self.scenario, jax.random.key(seed))

    def _make_pose_publishers(self) -> dict[tuple[str, int], Any]:
        values = self.values
        topics = {("evader", 0): (values["evader.topic"], values["evader.type"])}
        for kind in ("pursuer", "obstacle"):
            for index, topic in enumerate(values[f"{kind}s.topics"]):
                topics[kind, index] = (topic, values[f"{kind}s.type"])
        return {
            robot: (kind, self.create_publisher(POSE_TYPES[kind], topic, quality.POSES_OUT))
            for robot, (topic, kind) in topics.items()
        }

    def _begin(self) -> None:
        seed = int(self._random.integers(2**31))
        world = self._start(seed)
        self._goal = np.asarray(world.target, float)
        self._wheels = self._wheels_for(world)
        self._plant.reset(world, seed)
        self._time = self._steer_at = 0.0
        self._command = (-math.inf, (0.0, 0.0), 0.0)

    def _obey(self, message: Any) -> None:
        try:
            _, velocity, turn_rate = self._commands.read(message)
        except UnusableMessageError as error:
            self._complaints.add("command", str(error))
            return
        self._move()
        self._command = (self._times.of_cycle(), velocity, turn_rate)
        self._counts["commands"] += 1

    def _tick(self) -> None:
        self._move()
        if self._time >= self._steer_at:
            self._steer_at = max(self._steer_at + self._period, self._time)
            self._wheels = self._wheels_for(self._plant.world)
        now = self.get_clock().now()
        for robot, index, stamp, pose in self._plant.measurements():
            if robot == "evader":
                self._attitude.see(self._times.now() + stamp - self._time, pose[2])
            kind, publisher = self._pose_publishers[robot, index]
            age = round((self._time - stamp) * NANOSECONDS)
            when = Time(nanoseconds=now.nanoseconds - age, clock_type=now.clock_type).to_msg()
            publisher.publish(write_pose(kind, when, self.values["frame"], f"{robot}{index}", *pose))

    def _move(self) -> None:
        """Advance the world to now. The evader follows its last command, or stops if that is too old."""
        now = self._times.of_cycle()
        passed, self._moved_at = now - self._moved_at, now
        if passed <= 0.0 or not self._counts["commands"]:
            return
        when, velocity, turn_rate = self._command
        # A simulated clock may have gone back.
        if not 0.0 <= now - when <= self.values["command_timeout"]:
            velocity, turn_rate = (0.0, 0.0), 0.0
        self._plant.command(np.asarray(velocity, float), self._wheels, turn_rate)
        self._time += passed
        # MuJoCo advances in whole steps; the remainder is added to the next advance.
        self._happened(self._plant.advance(self._time - self._plant.time))

    def _happened(self, contacts: Any) -> None:
        to_pursuer = contacts.pursuer_distance - float(self.scenario.capture_distance)
        to_obstacle = contacts.obstacle_distance - float(self.scenario.collision_distance)
        self._least = min(self._least, to_pursuer, to_obstacle)
        for name in ("captured", "collided"):
            if getattr(contacts, name):
                self._counts[name] += 1
                self.get_logger().error(f"the evader was {name}; everything starts anew")
        if contacts.captured or contacts.collided:
            self._report()
            self._begin()
            return
        x, y = map(float, self._plant.world.evader)
        if math.hypot(x - self._goal[0], y - self._goal[1]) <= float(self.scenario.reach_distance):
            self._counts["reached"] += 1
            if self.values["new_targets"]:
                self._set_new_target()

    def _set_new_target(self) -> None:
        """Choose a new target in the arena, away from obstacles and from the evader."""
        world, half = self._plant.world, float(self.scenario.arena_side) / 2.0
        taken = [*np.asarray(world.obstacles, float)[:, :2], np.asarray(world.evader, float)]
        apart = float(self.scenario.target_separation)
        for _ in range(1000):
            goal = self._random.uniform(-half, half, 2)
            if all(np.linalg.norm(goal - place) >= apart for place in taken):
                break
        self._goal = goal
        self._tell_target()

    def _tell_target(self) -> None:
        x, y = map(float, self._goal)
        stamp = self.get_clock().now().to_msg()
        self._target.publish(write_pose("pose", stamp, self.values["frame"], "", x, y, 0.0))

    def _report(self) -> None:
        if self.values["new_targets"]:
            # Sent repeatedly for late subscribers, because RViz's targets are not latched.
            self._tell_target()
        contact = self._counts["captured"] + self._counts["collided"]
        values = {**self._counts, "least clearance (m)": self._least, **self._complaints.counts}
        status = reports.status(
            f"{self.get_name()}: robots",
            reports.ERROR if contact else reports.OK,
            f"{contact} contacts" if contact else "no contact",
            values,
        )
        self._diagnostics.publish(reports.array(self.get_clock().now().to_msg(), status))


def main(arguments: list[str] | None = None) -> int:
    """Run the node (`ros2 run sidestep_ros twin_node`)."""
    tune_jax()
    return run(TwinNode, arguments)


if __name__ == "__main__":
    sys.exit(main())
