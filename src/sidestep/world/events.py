"""What happened during one control period."""

import equinox as eqx
from jaxtyping import Array, Bool, Float


class Events(eqx.Module):
    """Outcome of one control period; every field has the batch shape of the worlds stepped.

    `captured` and `collided` are contacts at any instant of the period, not only at its end, and may
    both be true. `reached` needs neither; `timed_out` needs none of the three. Clearances (m) are the
    smallest distances of the period less the capture or collision distance, infinite when there is no
    such robot.
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
        """The episode ended by something that happened; its value beyond is zero."""
        return self.captured | self.collided | self.reached

    @property
    def truncated(self) -> Bool[Array, "*batch"]:
        """The episode was cut by the time limit; learners must bootstrap through it."""
        return self.timed_out
