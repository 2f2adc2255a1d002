"""The shield node: filters nominal commands into safe ones."""

import math
import sys
from typing import Any, final

from sidestep_ros import quality
from sidestep_ros.messages import COMMAND_TYPES, UnusableMessageError
from sidestep_ros.onboard_node import OnboardNode
from sidestep_ros.parameters import SHIELD
from sidestep_ros.running import run, tune_jax


@final
class ShieldNode(OnboardNode):
    """Subscribes to a nominal command, and publishes the filtered command of the same type."""

    own_parameters = SHIELD

    def __init__(self, **options: Any):
        super().__init__("sidestep_shield", **options)
        self._turning = (-math.inf, 0.0)

    def make_onboard(self, settings: Any) -> Any:
        from sidestep.robot import Onboard

        return Onboard(
            self.scenario,
            shield=self.values["shield"],
            policy=None,
            settings=settings,
            answering=self.answering,
        )

    def listen(self) -> None:
        message_type = COMMAND_TYPES[self.values["command.type"]]
        self.create_subscription(message_type, self.values["nominal.topic"], self._hear, quality.COMMANDS)

    def _hear(self, message: Any) -> None:
        try:
            stamp, velocity, turn_rate = self.commands.read(message)
        except UnusableMessageError as error:
            self.complaints.add("nominal", str(error))
            return
        reading = self.onboard.nominal(stamp, velocity, now=self.times.now())
        if not reading.used:
            self.complaints.add("nominal", reading.value)
            return
        self._turning = (stamp, turn_rate)

    def turn_rate_at(self, now: float) -> float:
        when, turn_rate = self._turning
        # The age may be negative, because the clock may have gone back.
        return turn_rate if abs(now - when) <= self.values["nominal_timeout"] else 0.0


def main(arguments: list[str] | None = None) -> int:
    """Run the node (`ros2 run sidestep_ros shield_node`)."""
    tune_jax()
    return run(ShieldNode, arguments)


if __name__ == "__main__":
    sys.exit(main())
