"""What is a shield? It takes a policy's nominal action and gives the action that the robot may take."""

import abc
from typing import Any, ClassVar

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from sidestep._arrays import AnyArray, Flag, Scalar, lane_by_lane, no_fuse
from sidestep.safety.barriers.barrier import BarrierRows
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

    The scenario's gains, speeds and distances are traced: other values never recompile. A custom shield
    defines `scenario`, `init` and the call. The other answers are those of a shield without a look-ahead.
    """

    scenario: eqx.AbstractVar[Scenario]
    keeps_pursuit_barrier: ClassVar[bool] = False
    """Whether its rows towards pursuers are those of the `PursuitBarrier`; such a shield takes a budget."""
    takes_lanes: ClassVar[bool] = False
    """Whether it takes many worlds in lanes; others are called for each world (`filter_in_lanes`)."""

    @property
    def rows_only(self) -> "Shield":
        """The shield to learn through: only the rows, whose derivatives say how the executed action follows
        the nominal one. A look-ahead is costly and has no derivatives. A shield of rows returns itself."""
        return self

    @property
    def looks_ahead(self) -> bool:
        """Whether it does more than rows. A decision then costs thousands of times as much."""
        return self.rows_only is not self

    @property
    def unadapted(self) -> "Shield":
        """Of a shield for custom robots, the shield of the evader's control point; otherwise itself."""
        return self

    @abc.abstractmethod
    def init(self, world: World) -> Any:
        """The memory (a pytree) at the start of an episode."""

    @abc.abstractmethod
    def __call__(
        self, world: World, nominal: Float[AnyArray, "2 *lanes"], memory: Any
    ) -> tuple[ShieldResult, Any]:
        """Filter the nominal velocity (m/s, world axes).

        **Returns** the `ShieldResult` and the memory for the next call. Non-finite input (a nominal action, a
        pose) gives `Status.INVALID` and an action as close to a stop as the other rows allow.
        """

    def rows(self, world: World, memory: Any) -> BarrierRows | None:
        """The rows that it keeps in this world, towards pursuers first. `memory` is the one that the call for
        this world returned. None for a shield without rows."""
        return None

    def filter_by_rows(
        self, world: World, nominal: Float[AnyArray, "2 *lanes"], memory: Any
    ) -> tuple[ShieldResult, Any]:
        """The call without looking ahead, by the rows alone, for a robot that is short of time."""
        return self(world, nominal, memory)

    def at_once(
        self, world: World, nominal: Float[AnyArray, "2 *lanes"], memory: Any
    ) -> tuple[ShieldResult, Any, Flag] | None:
        """What the call returns where it need not look ahead, and whether it need not. None for a shield that
        does not know this beforehand."""
        if self.looks_ahead:
            return None
        return *self(world, nominal, memory), jnp.ones((), bool)

    def has_plan(self, memory: Any) -> Flag:
        """Whether it holds or follows an escape plan now, because it has looked ahead."""
        return jnp.zeros((), bool)

    def plan(self, world: World, memory: Any) -> Float[Array, "n 2"]:
        """Positions (m) along its escape plan from here on; none for a shield without plans."""
        return jnp.zeros((0, 2), world.evader.dtype)

    def with_delay(self, delay: Scalar) -> "Shield":
        """The shield with this `delay` (s) in its budget; itself if it has no budget."""
        if getattr(self, "budget", None) is None:
            return self
        return eqx.tree_at(lambda shield: shield.budget.delay, self, delay)

    def with_acceleration(self, acceleration: float) -> "Shield":
        """The shield for motors of that acceleration (m/s^2); itself if it does not depend on it."""
        return self


def start_in_lanes(shield: Any, world: World) -> Any:
    """`shield.init` for one world, or for many in lanes."""
    if getattr(shield, "takes_lanes", False):
        return shield.init(world)
    return lane_by_lane(shield.init, world.lanes, world)


def filter_in_lanes(
    shield: Any, world: World, nominal: Float[AnyArray, "2 *lanes"], memory: Any
) -> tuple[Any, Any]:
    """The shield's answer for one world, or for each of many in lanes."""
    if not world.lanes:
        return shield(world, nominal, memory)
    if getattr(shield, "takes_lanes", False):
        return no_fuse(shield, world, nominal, memory)
    return lane_by_lane(shield, world.lanes, world, nominal, memory)
