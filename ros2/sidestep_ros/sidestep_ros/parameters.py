"""The parameters of the nodes, with their validation.

Parameters are declared with type, range and description (`ros2 param describe`), checked together before the
node starts, and read-only afterwards, except those marked `live`.
"""

import difflib
import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Any

from rcl_interfaces.msg import FloatingPointRange, IntegerRange, ParameterDescriptor
from rclpy.exceptions import InvalidParameterTypeException, InvalidParameterValueException
from rclpy.node import Node

_KINDS = {
    bool: "true or false",
    int: "a whole number",
    float: "a decimal number (0.0, not 0)",
    str: "text",
}
_LARGEST = 1e9
_OF_MIDDLEWARE = ("use_sim_time", "start_type_description_service", "qos_overrides.")


class ConfigurationError(ValueError):
    """Invalid parameters; `problems` lists all errors."""

    def __init__(self, problems: Iterable[str]):
        self.problems = tuple(problems)
        super().__init__("\n".join(f"  - {problem}" for problem in self.problems))


@dataclass(frozen=True)
class Parameter:
    """One parameter. Its default determines the type; `low` to `high`, or `choices`, are allowed."""

    name: str
    default: Any
    description: str
    low: float | None = None
    high: float | None = None
    choices: tuple[str, ...] = ()
    live: bool = False

    def descriptor(self) -> ParameterDescriptor:
        """The descriptor for `ros2 param describe`."""
        descriptor = ParameterDescriptor(
            name=self.name, description=self.description, read_only=not self.live
        )
        if self.choices:
            descriptor.additional_constraints = "one of: " + ", ".join(self.choices)
        if self.low is not None or self.high is not None:
            low = -_LARGEST if self.low is None else self.low
            high = _LARGEST if self.high is None else self.high
            if isinstance(self.default, float):
                descriptor.floating_point_range = [
                    FloatingPointRange(from_value=float(low), to_value=float(high))
                ]
            else:
                descriptor.integer_range = [IntegerRange(from_value=int(low), to_value=int(high))]
        return descriptor

    @property
    def range(self) -> str:
        """The allowed numbers, in words."""
        return f"at least {self.low}" if self.high is None else f"between {self.low} and {self.high}"

    def problem(self, value: Any) -> str | None:
        """The error of a value of the right type; None if it is valid."""
        if self.choices and value not in self.choices:
            near = difflib.get_close_matches(str(value), self.choices, n=1)
            hint = f"; did you mean '{near[0]}'?" if near else ""
            return f"'{self.name}' is '{value}', but must be one of {', '.join(self.choices)}{hint}"
        numbers = value if isinstance(value, list) else [value]
        if any(isinstance(number, float) and not math.isfinite(number) for number in numbers):
            return f"'{self.name}' is {value}, but must be finite"
        return None


def declare(node: Node, parameters: Iterable[Parameter]) -> dict[str, Any]:
    """Declare parameters on a node and return their values by name; empty texts in lists are dropped.

    **Raises** `ConfigurationError` with all errors: types, ranges, choices, unknown names.
    """
    parameters = tuple(parameters)
    values: dict[str, Any] = {}
    problems = unknown_names(node)
    for parameter in parameters:
        try:
            value = node.declare_parameter(parameter.name, parameter.default, parameter.descriptor()).value
        except InvalidParameterTypeException:
            given = overrides(node)[parameter.name]
            kind = _KINDS.get(type(parameter.default), f"a list like {parameter.default}")
            problems.append(f"'{parameter.name}' is {given!r}, but must be {kind}")
            continue
        except InvalidParameterValueException:
            given = overrides(node)[parameter.name]
            problems.append(f"'{parameter.name}' is {given}, but must be {parameter.range}")
            continue
        if isinstance(parameter.default, list):
            # ROS cannot infer the type of an empty list and gives None; [""] also means an empty list.
            value = [entry for entry in value or () if entry != ""]
        if problem := parameter.problem(value):
            problems.append(problem)
        values[parameter.name] = value
    if problems:
        raise ConfigurationError(problems)
    return values


def overrides(node: Node) -> dict[str, Any]:
    """The user's values by name, from parameter files and the command line."""
    given: Mapping[str, Any] = getattr(node, "_parameter_overrides", {})
    return {name: parameter.value for name, parameter in given.items()}


def unknown_names(node: Node) -> list[str]:
    """An error for every given parameter that no node has, because a misspelt limit must not be ignored.

    Parameters of other nodes are accepted, so that all can share a file.
    """
    known = [parameter.name for group in GROUPS for parameter in group]
    problems = []
    for name in overrides(node):
        if name in known or name.startswith(_OF_MIDDLEWARE):
            continue
        near = difflib.get_close_matches(name, known, n=1)
        problems.append(f"there is no parameter '{name}'" + (f"; did you mean '{near[0]}'?" if near else ""))
    return problems


SCENARIO = (
    Parameter("scenario", "paper", "Preset or scenario file: speeds, sizes, distances, control period."),
    Parameter("scenario_overrides", [""], "Scenario fields to change, as NAME=VALUE: [evader_speed=0.18]."),
    Parameter("frame", "map", "The fixed frame that every pose must be in; others are rejected."),
)
"""Parameters of the world, for all nodes."""

TOPICS = (
    Parameter("evader.topic", "evader/pose", "Topic of the evader's pose."),
    Parameter(
        "evader.type", "pose", "Its message type: PoseStamped or Odometry.", choices=("pose", "odometry")
    ),
    Parameter("pursuers.topics", ["pursuer/pose"], "Topics of the pursuers' poses, one each."),
    Parameter("pursuers.type", "pose", "Their message type.", choices=("pose", "odometry")),
    Parameter(
        "obstacles.topics", ["obstacle/pose"], "Topics of the obstacles' poses, one each; [''] for none."
    ),
    Parameter("obstacles.type", "pose", "Their message type.", choices=("pose", "odometry")),
    Parameter("command.topic", "cmd_vel", "Topic of the safe command."),
    Parameter(
        "command.type", "twist", "Message type of commands, in and out.", choices=("twist", "twist_stamped")
    ),
    Parameter("command.axes", "body", "Axes of commands without a frame.", choices=("body", "world")),
    Parameter("command.body_frame", "base_link", "Name of the evader's body frame in stamped commands."),
)
"""Parameters of topics and types, for all nodes."""

DECIDING = (
    Parameter("shield", "joint", "Which shield filters.", choices=("paper", "game", "joint")),
    Parameter("compiled", True, "Decide by compiled C, where there is a compiler and it agrees with JAX."),
    Parameter(
        "stamps",
        "header",
        "Time of a pose: its stamp; its arrival if the stamp is zero; always its arrival.",
        choices=("header", "arrival_if_zero", "arrival"),
    ),
    Parameter(
        "trigger",
        "poses",
        "Decide as soon as a new pose of every robot has arrived, or by the timer only.",
        choices=("poses", "timer"),
    ),
    Parameter("grace", 0.1, "Share of the period that a decision waits for poses.", 0.0, 1.0),
    Parameter("late_after", 0.2, "A command is late after this share of the period beyond it.", 0.0, 10.0),
    Parameter("stale_after", 0.2, "A pose older than this (s) is stale.", 0.001, 10.0),
    Parameter("nominal_timeout", 0.5, "A nominal command older than this (s) is lost.", 0.001, 60.0),
    Parameter("on_fault", "evade", "On a fault, flee from the pursuer, or stop.", choices=("evade", "stop")),
    Parameter(
        "budget.position_error", 0.0, "Largest error of a robot's position relative to the evader, m.", 0.0
    ),
    Parameter("budget.heading_error", 0.0, "Largest error of a pursuer's heading, rad.", 0.0),
    Parameter("budget.delay", 0.0, "Longest time from a pose's stamp to the command's actuation, s.", 0.0),
    Parameter("budget.tracking_error", 0.0, "Largest error of the inner velocity loop, m/s.", 0.0),
    Parameter(
        "budget.own_motion_predicted", True, "Whether the evader's pose is extrapolated with its commands."
    ),
    Parameter("position_noise", 0.001, "Standard deviation of measured positions, m.", 0.0),
    Parameter("heading_noise", 0.005, "Standard deviation of measured headings, rad.", 0.0),
    Parameter("actuation_delay", 0.0, "Time from a command to its effect, s; a part of budget.delay.", 0.0),
    Parameter("motor_lag", 0.0, "Time constant with which the motors reach the commanded velocity, s.", 0.0),
    Parameter("motor_acceleration", 1000.0, "Largest acceleration by the motors, m/s^2.", 0.001),
    Parameter("predict_pursuer", False, "Extrapolate the pursuers to actuation time."),
    Parameter("obstacle_acceleration", 0.02, "How fast an obstacle's drift may change, m/s^2.", 0.0),
    Parameter("jump_tolerance", 0.05, "A pose farther than this from the reachable ones is a jump, m.", 0.0),
    Parameter("heading_tolerance", 0.35, "As jump_tolerance, for headings, rad.", 0.0),
    Parameter("jump_confirmations", 5, "Number of jumps in a row that must agree to be accepted.", 1, 1000),
    Parameter("future_tolerance", 0.05, "A stamp further ahead of the clock than this (s) is refused.", 0.0),
    Parameter("turn_rate_limit", 1.0, "Largest turn rate (rad/s) that is sent to the base.", 0.0, 100.0),
    Parameter(
        "diagnostics_period", 0.5, "Longest time (s) between diagnostics; 0.0: every decision.", 0.0, 60.0
    ),
    Parameter("log", "", "New MCAP file for all decisions and estimated worlds; empty: none."),
    Parameter("marker_period", 0.2, "Time (s) between markers for subscribers; 0.0: none.", 0.0, 60.0),
)
"""Parameters of the shield node and the policy node."""

SHIELD = (Parameter("nominal.topic", "cmd_vel_nominal", "Topic of the command to filter."),)
"""Parameters of the shield node only."""

POLICY = (
    Parameter("policy", "goal-seeking", "goal-seeking, pretrained, or the folder of a training run."),
    Parameter("target", [0.0, 0.0], "Target: x and y (m) in the fixed frame.", live=True),
    Parameter("target_topic", "target", "PoseStamped topic with new targets."),
    Parameter("nominal_only", False, "Publish the policy's nominal command, for a shield node to filter."),
)
"""Parameters of the policy node only."""

TWIN = (
    Parameter("physics", "plain", "MuJoCo, or exact simulation.", choices=("mujoco", "plain")),
    Parameter("pursuer", "nash", "Strategy of the pursuers."),
    Parameter(
        "pose_rate",
        0.0,
        "Sets of poses per second; 0.0: one per control period, or as sensors do.",
        0.0,
        1000.0,
    ),
    Parameter("sensors", "motion-capture", "How MuJoCo's poses are measured: a preset of the twin."),
    Parameter("base", "servo", "The evader's base in MuJoCo."),
    Parameter("seed", 0, "Seed of starts, targets and noise.", 0, 2**31 - 1),
    Parameter("evader_heading", 0.0, "The plain evader's heading at the start, rad.", -3.15, 3.15),
    Parameter("command_timeout", 0.5, "Without a command for this long (s), the evader stops.", 0.001, 60.0),
    Parameter("new_targets", True, "When the target is reached, publish a random new one."),
    Parameter("target_topic", "target", "PoseStamped topic of those targets."),
)
"""Parameters of the twin only."""

GROUPS = (SCENARIO, TOPICS, DECIDING, SHIELD, POLICY, TWIN)
"""All parameters of all nodes."""
