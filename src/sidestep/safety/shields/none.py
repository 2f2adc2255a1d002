"""The shield `none`: no shield at all, but the speed limit."""

from __future__ import annotations

from typing import Any, final

from jaxtyping import Float

from sidestep._arrays import AnyArray
from sidestep.safety.barriers.barrier import RangeBarrier
from sidestep.safety.shields.answer import decide, with_obstacles
from sidestep.safety.shields.shield import Shield, ShieldResult
from sidestep.world.scenario import Scenario
from sidestep.world.state import World


@final
class NoShield(Shield):
    """Cuts the nominal action to the speed limit and changes nothing else; reports distances as barriers.

    Status `OK`, `CORRECTED` (by the speed limit), or `INVALID` and a stop for a non-finite action or world.
    """

    takes_lanes = True
    scenario: Scenario

    def init(self, world: World) -> Any:
        return RangeBarrier().update_memories(self.scenario, world)

    def __call__(
        self, world: World, nominal: Float[AnyArray, "2 *lanes"], memory: Any
    ) -> tuple[ShieldResult, Any]:
        rows = with_obstacles(RangeBarrier().rows(self.scenario, world, memory), self.scenario, world)
        return decide(self.scenario, world, nominal, rows, enforced=False, hard=0), memory
