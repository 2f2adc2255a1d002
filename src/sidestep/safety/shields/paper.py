"""The shield `paper`: the paper's own, kept as the baseline."""

from __future__ import annotations

from typing import Any, final

from jaxtyping import Float

from sidestep._arrays import AnyArray
from sidestep.safety.barriers.barrier import BarrierRows, RangeBarrier
from sidestep.safety.shields.answer import decide, with_obstacles
from sidestep.safety.shields.shield import Shield, ShieldResult
from sidestep.world.scenario import Scenario
from sidestep.world.state import World


@final
class PaperShield(Shield):
    """The paper's shield: `RangeBarrier` towards pursuers, `ObstacleBarrier` towards obstacles.

    Kept as the baseline. Its pursuer row is not always feasible (see `RangeBarrier`). Then the answer
    violates the pursuers' rows least, and after that the obstacles' rows least.
    """

    takes_lanes = True
    scenario: Scenario

    def init(self, world: World) -> Any:
        return RangeBarrier().update_memories(self.scenario, world)

    def __call__(
        self, world: World, nominal: Float[AnyArray, "2 *lanes"], memory: Any
    ) -> tuple[ShieldResult, Any]:
        hard = self.scenario.pursuer_count
        rows = self.rows(world, memory)
        return decide(self.scenario, world, nominal, rows, enforced=True, hard=hard), memory

    def rows(self, world: World, memory: Any) -> BarrierRows:
        return with_obstacles(RangeBarrier().rows(self.scenario, world, memory), self.scenario, world)
