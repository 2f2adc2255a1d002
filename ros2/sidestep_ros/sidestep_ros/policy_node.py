"""The policy node: drives to a target with a policy and a shield, or with the policy alone."""

import math
import sys
from pathlib import Path
from typing import Any, final

from geometry_msgs.msg import PoseStamped
from rcl_interfaces.msg import SetParametersResult

from sidestep_ros import quality
from sidestep_ros.messages import UnusableMessageError, read_pose, write_pose
from sidestep_ros.onboard_node import OnboardNode
from sidestep_ros.parameters import POLICY, ConfigurationError
from sidestep_ros.running import run, tune_jax


@final
class PolicyNode(OnboardNode):
    """Drives to the target of the parameter `target` or of a message on `target_topic`, whichever is newer.

    A new target is accepted if it is finite and not within the collision distance of an obstacle. The
    accepted target is published on `~/target`.
    """

    own_parameters = POLICY

    def __init__(self, **options: Any):
        super().__init__("sidestep_policy", **options)
        if problem := self._problem(self.values["target"]):
            raise ConfigurationError([f"'target': {problem}"])
        self._accepted = self.create_publisher(PoseStamped, "~/target", quality.LATCHED)

    def make_onboard(self, settings: Any) -> Any:
        from sidestep.robot import Onboard

        policy = self.values["policy"]
        if policy not in ("goal-seeking", "pretrained") and not Path(policy).is_dir():
            raise ConfigurationError(
                [f"'policy' is '{policy}', neither goal-seeking, pretrained nor a run's folder"]
            )
        shield = "none" if self.values["nominal_only"] else self.values["shield"]
        return Onboard(
            self.scenario, shield=shield, policy=policy, settings=settings, answering=self.answering
        )

    def listen(self) -> None:
        self._go_to(*self.values["target"])
        self.add_on_set_parameters_callback(self._check_parameters)
        self.add_post_set_parameters_callback(self._take_parameters)
        self.create_subscription(PoseStamped, self.values["target_topic"], self._hear_target, quality.TARGET)

    def velocity_of(self, decision: Any) -> Any:
        if not self.values["nominal_only"]:
            return decision.velocity
        # Unfiltered, but a stop without an estimated world.
        return (0.0, 0.0) if decision.level in ("evade", "stop") else decision.nominal

    def _go_to(self, x: float, y: float) -> None:
        self.onboard.target = self.target = (x, y)
        stamp = self.get_clock().now().to_msg()
        self._accepted.publish(write_pose("pose", stamp, self.values["frame"], "", x, y, 0.0))

    def _hear_target(self, message: PoseStamped) -> None:
        try:
            pose = read_pose(message, self.values["frame"], with_heading=False)
        except UnusableMessageError as error:
            self.complaints.add("target", str(error))
            return
        if problem := self._problem((pose.x, pose.y)):
            self.complaints.add("target", problem)
            return
        if (pose.x, pose.y) != self.target:
            self._go_to(pose.x, pose.y)

    def _problem(self, target: Any) -> str | None:
        """Why a target is rejected; None if it is accepted."""
        if len(target) != 2 or not all(map(math.isfinite, target)):
            return f"{list(target)} is not two finite numbers, x and y in m"
        if self.world is None:
            return None
        least = float(self.scenario.collision_distance)
        for i, (x, y, *_) in enumerate(self.world.obstacles.tolist()):
            if math.hypot(x - target[0], y - target[1]) <= least:
                return f"it is within the collision distance ({least:.3g} m) of obstacle {i}"
        return None

    def _check_parameters(self, parameters: Any) -> SetParametersResult:
        problems = (self._problem(parameter.value) for parameter in parameters if parameter.name == "target")
        problem = next(filter(None, problems), None)
        return SetParametersResult(successful=problem is None, reason=problem or "")

    def _take_parameters(self, parameters: Any) -> None:
        for parameter in parameters:
            if parameter.name == "target":
                self._go_to(*parameter.value)


def main(arguments: list[str] | None = None) -> int:
    """Run the node (`ros2 run sidestep_ros policy_node`)."""
    tune_jax()
    return run(PolicyNode, arguments)


if __name__ == "__main__":
    sys.exit(main())
