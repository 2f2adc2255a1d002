"""Which parameters does a node have, and are they right?

Parameters are declared with their type, range and a description (`ros2 param describe`), checked all at once
before anything starts, and read-only from then on but for those that say otherwise.
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
    """Parameters that cannot be used; `problems` says each thing that is wrong."""

    def __init__(self, problems: Iterable[str]):
        self.problems = tuple(problems)
        super().__init__("\n".join(f"  - {problem}" for problem in self.problems))


@dataclass(frozen=True)
class Parameter:
    """One parameter: its default tells the type; `low` to `high`, or `choices`, what is allowed."""

    name: str
    default: Any
    description: str
    low: float | None = None
    high: float | None = None
    choices: tuple[str, ...] = ()
    live: bool = False

    def descriptor(self) -> ParameterDescriptor:
        """What `ros2 param describe` shows."""
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
        """What numbers are allowed, in words."""
        return f"at least {self.low}" if self.high is None else f"between {self.low} and {self.high}"

    def problem(self, value: Any) -> str | None:
        """What is wrong with a value of the right type, if anything is."""
        if self.choices and value not in self.choices:
            near = difflib.get_close_matches(str(value), self.choices, n=1)
            hint = f"; did you mean '{near[0]}'?" if near else ""
            return f"'{self.name}' is '{value}', but must be one of {', '.join(self.choices)}{hint}"
        numbers = value if isinstance(value, list) else [value]
        if any(isinstance(number, float) and not math.isfinite(number) for number in numbers):
            return f"'{self.name}' is {value}, but must be finite"
        return None


def declare(node: Node, parameters: Iterable[Parameter]) -> dict[str, Any]:
    """Declare parameters on a node and return their values by name; texts left empty in lists are dropped.

    **Raises** `ConfigurationError` with everything that is wrong: types, ranges, choices, unknown names.
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
            # ROS cannot tell the type of an empty list and gives None; [""] stands for one too.
            value = [entry for entry in value or () if entry != ""]
        if problem := parameter.problem(value):
            problems.append(problem)
        values[parameter.name] = value
    if problems:
        raise ConfigurationError(problems)
    return values


def overrides(node: Node) -> dict[str, Any]:
    """What the user gave, by name: parameter files and the command line."""
    given: Mapping[str, Any] = getattr(node, "_parameter_overrides", {})
    return {name: parameter.value for name, parameter in given.items()}


def unknown_names(node: Node) -> list[str]:
    """A complaint about every given parameter that no node here has: a misspelt limit must not be ignored.

    Those of the other nodes are left in peace, so that all can share a file.
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
"""What every node needs to know of the world."""

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
    Parameter(
        "command.axes", "body", "Axes of commands without a frame of their own.", choices=("body", "world")
    ),
    Parameter("command.body_frame", "base_link", "Name of the evader's body frame in stamped commands."),
)
"""Topics and types, for the nodes and for the twin."""

DECIDING = (
    Parameter("shield", "joint", "Which shield filters.", choices=("paper", "game", "joint")),
    Parameter(
        "stamps",
        "header",
        "When a pose was true: its stamp; its arrival if the stamp is zero; always its arrival.",
        choices=("header", "arrival_if_zero", "arrival"),
    ),
    Parameter(
        "trigger",
        "poses",
        "Decide as soon as a new pose of every robot is there, or by the timer alone.",
        choices=("poses", "timer"),
    ),
    Parameter("grace", 0.1, "Share of the period that a decision waits for poses.", 0.0, 1.0),
    Parameter("late_after", 0.2, "A command is late after this share of the period beyond it.", 0.0, 10.0),
    Parameter("stale_after", 0.2, "A pose older than this (s) is stale.", 0.001, 10.0),
    Parameter("nominal_timeout", 0.5, "A nominal command older than this (s) is lost.", 0.001, 60.0),
    Parameter(
        "on_fault", "evade", "On a fault, move as the game says is safe, or stop.", choices=("evade", "stop")
    ),
    Parameter(
        "budget.position_error", 0.0, "Largest error of a robot's place as seen from the evader, m.", 0.0
    ),
    Parameter("budget.heading_error", 0.0, "Largest error of a pursuer's heading, rad.", 0.0),
    Parameter(
        "budget.delay", 0.0, "Longest time from when a pose was true to when the command acts, s.", 0.0
    ),
    Parameter("budget.tracking_error", 0.0, "Largest error of the inner velocity loop, m/s.", 0.0),
    Parameter(
        "budget.own_motion_predicted", True, "Whether the evader's motion since its pose is added to it."
    ),
    Parameter("position_noise", 0.001, "Standard deviation of measured positions, m.", 0.0),
    Parameter("heading_noise", 0.005, "Standard deviation of measured headings, rad.", 0.0),
    Parameter("actuation_delay", 0.0, "Time from a command to its effect, s; a part of budget.delay.", 0.0),
    Parameter("motor_lag", 0.0, "Time constant with which the motors reach the velocity told, s.", 0.0),
    Parameter("motor_acceleration", 1000.0, "The most that the motors accelerate the robot, m/s^2.", 0.001),
    Parameter("predict_pursuer", False, "Also drive the pursuers on from their last poses."),
    Parameter("obstacle_acceleration", 0.02, "How fast an obstacle's drift may change, m/s^2.", 0.0),
    Parameter("jump_tolerance", 0.05, "A pose is a jump beyond what the robot can drive and this, m.", 0.0),
    Parameter("heading_tolerance", 0.35, "A heading is a jump beyond what it can turn and this, rad.", 0.0),
    Parameter("jump_confirmations", 5, "Jumps that must agree before they are believed.", 1, 1000),
    Parameter("future_tolerance", 0.05, "A stamp further ahead of the clock than this (s) is refused.", 0.0),
    Parameter(
        "turn_rate_limit", 1.0, "Largest turn rate (rad/s) that is let through to the base.", 0.0, 100.0
    ),
    Parameter(
        "diagnostics_period", 0.5, "Longest time (s) between diagnostics; 0.0: every decision.", 0.0, 60.0
    ),
    Parameter("log", "", "New MCAP file for every decision and what it was made from; empty: none."),
    Parameter("marker_period", 0.2, "Time (s) between markers, while somebody looks; 0.0: none.", 0.0, 60.0),
)
"""What the two nodes that decide have in common."""

SHIELD = (Parameter("nominal.topic", "cmd_vel_nominal", "Topic of the command to filter."),)
"""What only the shield node has."""

POLICY = (
    Parameter("policy", "goal-seeking", "goal-seeking, or the folder of a training run."),
    Parameter("target", [0.0, 0.0], "Where to go: x and y (m) in the fixed frame.", live=True),
    Parameter("target_topic", "target", "PoseStamped topic with new targets."),
    Parameter(
        "nominal_only", False, "Publish what the policy wants, unfiltered, for a shield node to filter."
    ),
)
"""What only the policy node has."""

TWIN = (
    Parameter("physics", "plain", "MuJoCo, or the plain simulation.", choices=("mujoco", "plain")),
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
    Parameter("new_targets", True, "When the target is reached, publish another at random."),
    Parameter("target_topic", "target", "PoseStamped topic of those targets."),
)
"""What only the twin has."""

GROUPS = (SCENARIO, TOPICS, DECIDING, SHIELD, POLICY, TWIN)
"""All parameters that there are."""
