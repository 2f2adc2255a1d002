"""A shield from a custom barrier."""

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
    """Keeps the rows of any barrier towards pursuers; they come before those towards obstacles where not all
    are feasible.

    It guarantees what the barriers do: in continuous time, where their rows are feasible. Make one with
    `shield_of`, which probes the barrier first.
    """

    scenario: Scenario
    towards_pursuers: Barrier
    towards_obstacles: Barrier = ObstacleBarrier()

    def init(self, world: World) -> Any:
        return self._updated(world, (None, None))

    def __call__(
        self, world: World, nominal: Float[AnyArray, "2 *lanes"], memory: Any
    ) -> tuple[ShieldResult, Any]:
        memory, hard = self._updated(world, memory), self.scenario.pursuer_count
        rows = self.rows(world, memory)
        return decide(self.scenario, world, nominal, rows, enforced=True, hard=hard), memory

    def rows(self, world: World, memory: Any) -> BarrierRows:
        pairs = zip(self._kept, memory, strict=True)
        return compose(*(barrier.rows(self.scenario, world, one) for barrier, one in pairs))

    @property
    def _kept(self) -> tuple[Barrier, Barrier]:
        return self.towards_pursuers, self.towards_obstacles

    def _updated(self, world: World, memory: Any) -> Any:
        pairs = zip(self._kept, memory, strict=True)
        return tuple(barrier.update_memories(self.scenario, world, one) for barrier, one in pairs)


def shield_of(
    barrier: Barrier, scenario: Scenario, towards_obstacles: Barrier | None = None, *, probe: bool = True
) -> Shield:
    """The shield that keeps `barrier` towards pursuers, and towards obstacles `ObstacleBarrier` or another.

    It works for custom robots too (`AdaptedShield`).

    **Raises** `ValueError` with everything that `probe_barrier` finds wrong: wrong shapes, non-finite
    numbers, an alpha that is not of class K, a normal that is not the gradient or vanishes. **Warns**
    `BarrierWarning` where there is no guarantee: motions that the rate leaves out, rows that are infeasible.
    `probe=False` skips the probe.
    """
    inner = of_control_point(scenario)
    if probe:
        announce(probe_barrier(barrier, scenario))
        if towards_obstacles is not None:
            announce(probe_barrier(towards_obstacles, scenario))
    shield = BarrierShield(inner, barrier, towards_obstacles or ObstacleBarrier())
    return shield if scenario.evader_model is None else AdaptedShield(scenario, shield)
