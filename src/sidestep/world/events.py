"""The events of one control period."""

import equinox as eqx
from jaxtyping import Array, Bool, Float


class Events(eqx.Module):
    """Outcome of one control period; every field has the batch shape of the worlds stepped.

    `captured` and `collided` are contacts at any time in the period, not only at its end, and may both be
    true. `reached` implies neither of them, and `timed_out` none of the three. Clearances (m) are the least
    distances in the period less the capture or collision distance, infinite without such a robot.
    """

    reward: Float[Array, "*batch"]
    captured: Bool[Array, "*batch"]
    collided: Bool[Array, "*batch"]
    reached: Bool[Array, "*batch"]
    timed_out: Bool[Array, "*batch"]
    pursuer_clearance: Float[Array, "*batch"]
    obstacle_clearance: Float[Array, "*batch"]

    @property
    def terminated(self) -> Bool[Array, "*batch"]:
        """The episode ended by capture, collision or reaching the target; the next value is zero."""
        return self.captured | self.collided | self.reached

    @property
    def truncated(self) -> Bool[Array, "*batch"]:
        """The episode was ended by the time limit; learners must bootstrap through it."""
        return self.timed_out
