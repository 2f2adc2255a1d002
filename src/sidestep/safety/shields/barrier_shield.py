"""A shield from a barrier of one's own."""

from __future__ import annotations

from typing import Any, final

from jaxtyping import Float

from sidestep._arrays import AnyArray
from sidestep.safety.barriers.barrier import Barrier, BarrierRows, ObstacleBarrier, compose
from sidestep.safety.barriers.probe import announce, probe_barrier
from sidestep.safety.shields.adapted import AdaptedShield, of_control_point
from sidestep.safety.shields.answer import decide
from sidestep.safety.shields.shield import Shield, ShieldResult
from sidestep.world.scenario import Scenario
from sidestep.world.state import World


@final
class BarrierShield(Shield):
    """Keeps the rows of any barrier towards pursuers, before those towards obstacles when not all can hold.

    It promises what the barriers do: in continuous time, where their rows can be kept. Make one with
    `shield_of`, which looks at the barrier first.
    """

    scenario: Scenario
    towards_pursuers: Barrier
    towards_obstacles: Barrier = ObstacleBarrier()

    def init(self, world: World) -> Any:
        kept = self.towards_pursuers, self.towards_obstacles
        return tuple(barrier.remember(self.scenario, world) for barrier in kept)

    def __call__(
        self, world: World, nominal: Float[AnyArray, "2 *lanes"], memory: Any
    ) -> tuple[ShieldResult, Any]:
        scenario, kept = self.scenario, (self.towards_pursuers, self.towards_obstacles)
        memory = tuple(
            barrier.remember(scenario, world, sides) for barrier, sides in zip(kept, memory, strict=True)
        )
        rows, hard = self.rows(world, memory), scenario.pursuer_count
        return decide(scenario, world, nominal, rows, enforced=True, hard=hard), memory

    def rows(self, world: World, memory: Any) -> BarrierRows:
        kept = self.towards_pursuers, self.towards_obstacles
        pairs = zip(kept, memory, strict=True)
        return compose(*(barrier.rows(self.scenario, world, sides) for barrier, sides in pairs))


def shield_of(
    barrier: Barrier, scenario: Scenario, towards_obstacles: Barrier | None = None, *, probe: bool = True
) -> Shield:
    """The shield that keeps `barrier` towards pursuers, and the obstacles' as ever or `towards_obstacles`.

    **Raises** `ValueError` with all that `probe_barrier` finds wrong: shapes, numbers that are not finite, an
    allowance that is not of class K through zero, a normal that is not the gradient or vanishes. **Warns**
    `BarrierWarning` of what keeps it from guaranteeing anything: motions that its rate leaves out, rows that
    nothing can keep. `probe=False` leaves the look out.
    """
    inner = of_control_point(scenario)
    if probe:
        announce(probe_barrier(barrier, scenario))
        if towards_obstacles is not None:
            announce(probe_barrier(towards_obstacles, scenario))
    shield = BarrierShield(inner, barrier, towards_obstacles or ObstacleBarrier())
    return shield if scenario.evader_model is None else AdaptedShield(scenario, shield)
