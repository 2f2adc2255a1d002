"""What is a shield? From the action a policy would take to the action a robot may take, with a status."""

import abc
from typing import Any

import equinox as eqx
from jaxtyping import Array, Float, Int

from sidestep._arrays import AnyArray, apart, lane_by_lane
from sidestep.world.scenario import Scenario
from sidestep.world.state import World


class ShieldResult(eqx.Module):
    """What a shield decided.

    - `action (2,)` the velocity to execute, m/s in world axes; always finite and within the speed limit
    - `status` see `Status`
    - `barriers (m + k,)` h in m, pursuers first; -inf where the world was not finite
    - `slack` m/s by which the action keeps the tightest row (negative: violates); +inf without rows
    - `intervention` |action - nominal|, m/s, see `correction`
    """

    action: Float[Array, "2 *lanes"]
    status: Int[Array, "*lanes"]
    barriers: Float[Array, "n *lanes"]
    slack: Float[Array, "*lanes"]
    intervention: Float[Array, "*lanes"]


class Shield(eqx.Module):
    """A shield for one scenario. `memory = shield.init(world)`; then one call per control period.

    The scenario's gains, speeds and distances are traced: other values never recompile.
    """

    scenario: eqx.AbstractVar[Scenario]

    @property
    def rows_only(self) -> "Shield":
        """The shield to learn through: its rows, whose derivatives say how the executed action follows the
        nominal one, without anything that is costly and has none. The shield itself if it is all rows."""
        return self

    @property
    def looks_ahead(self) -> bool:
        """Whether it does more than rows, so that a decision costs thousands of times as much."""
        return self.rows_only is not self

    @property
    def takes_lanes(self) -> bool:
        """Whether it takes many worlds in lanes; others are asked for each (`filter_in_lanes`)."""
        return False

    @abc.abstractmethod
    def init(self, world: World) -> Any:
        """The memory (a pytree) at the start of an episode."""

    @abc.abstractmethod
    def __call__(
        self, world: World, nominal: Float[AnyArray, "2 *lanes"], memory: Any
    ) -> tuple[ShieldResult, Any]:
        """Filter the nominal velocity (m/s, world axes).

        **Returns** the `ShieldResult` and the memory for the next call. Non-finite input (a nominal
        action, a pose) gives `Status.INVALID` and an action as close to a stop as the rest allows.
        """


def start_in_lanes(shield: Any, world: World) -> Any:
    """`shield.init` for one world or for many in lanes, whatever the shield takes."""
    if getattr(shield, "takes_lanes", False):
        return shield.init(world)
    return lane_by_lane(shield.init, world.lanes, world)


def filter_in_lanes(
    shield: Any, world: World, nominal: Float[AnyArray, "2 *lanes"], memory: Any
) -> tuple[Any, Any]:
    """The shield's answer for one world or for each of many in lanes, whatever the shield takes."""
    if not world.lanes:
        return shield(world, nominal, memory)
    if getattr(shield, "takes_lanes", False):
        return apart(shield, world, nominal, memory)
    return lane_by_lane(shield, world.lanes, world, nominal, memory)
