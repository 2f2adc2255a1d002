"""Shields for custom robots: the built-in shields, for a problem that covers the real one."""

from __future__ import annotations

import dataclasses
from typing import Any, final

import equinox as eqx
import jax
from jaxtyping import Array, Float

from sidestep._arrays import AnyArray, Flag, Scalar, lane_by_lane
from sidestep.safety.barriers.barrier import BarrierRows
from sidestep.safety.shields.shield import Shield, ShieldResult, filter_in_lanes, start_in_lanes
from sidestep.world.models import evader_of
from sidestep.world.robots import body_velocity, wheels_from_body
from sidestep.world.scenario import Scenario
from sidestep.world.state import World


def of_control_point(scenario: Scenario) -> Scenario:
    """The same problem for the evader's control point, which is omnidirectional. Its distances from others
    are longer by the model's offset."""
    model = scenario.evader_model
    if model is None:
        return scenario
    offset = model.offset(scenario)
    return dataclasses.replace(
        scenario,
        evader_model=None,
        capture_distance=scenario.capture_distance + offset,
        collision_distance=scenario.collision_distance + offset,
    )


def covered(scenario: Scenario) -> Scenario:
    """The same problem with a differential drive in place of the pursuer that can do everything it can.

    **Raises** `ValueError` if the pursuer's model names none.
    """
    model = scenario.pursuer_model
    if model is None:
        return scenario
    covering = model.covering(scenario)
    if covering is None:
        raise ValueError(
            f"{type(model).__name__} names no differential drive that can do all it can (`covering`), and "
            "that is what the built-in barriers guard against: name one, or bring a barrier (`shield_of`)"
        )
    rim_speed, half_axle = covering
    return dataclasses.replace(
        scenario, pursuer_model=None, pursuer_speed=rim_speed, pursuer_half_axle=half_axle
    )


def world_of_control_point(scenario: Scenario, world: World) -> World:
    """`world` with the control point in the place of the evader."""
    model = scenario.evader_model
    if model is None:
        return world
    point = lane_by_lane(lambda robot: model.control_point(scenario, robot), world.lanes, evader_of(world))
    world = eqx.tree_at(lambda w: w.evader, world, point)
    return eqx.tree_at(lambda w: w.evader_state, world, None)


@final
class AdaptedShield(Shield):
    """A shield for custom robots: `inner` guards the evader's control point against a differential drive that
    covers the pursuer.

    What `inner` guarantees for its problem holds for the real one if the models are right: the control point
    moves as commanded and is at most `offset` from the robot, and the pursuer does nothing that the covering
    drive cannot. The reported barriers are those of `inner`: of the control point, for distances that are
    longer by the offset.
    """

    scenario: Scenario
    inner: Shield

    @property
    def keeps_pursuit_barrier(self) -> bool:  # type: ignore[override]
        return self.inner.keeps_pursuit_barrier

    @property
    def unadapted(self) -> Shield:
        return self.inner

    @property
    def rows_only(self) -> Shield:
        return AdaptedShield(self.scenario, self.inner.rows_only)

    @property
    def looks_ahead(self) -> bool:
        return self.inner.looks_ahead

    @property
    def takes_lanes(self) -> bool:  # type: ignore[override]
        return self.inner.takes_lanes

    def init(self, world: World) -> Any:
        return start_in_lanes(self.inner, self._seen(world))

    def __call__(
        self, world: World, nominal: Float[AnyArray, "2 *lanes"], memory: Any
    ) -> tuple[ShieldResult, Any]:
        return filter_in_lanes(self.inner, self._seen(world), nominal, memory)

    def rows(self, world: World, memory: Any) -> BarrierRows | None:
        return self.inner.rows(self._seen(world), memory)

    def filter_by_rows(
        self, world: World, nominal: Float[AnyArray, "2 *lanes"], memory: Any
    ) -> tuple[ShieldResult, Any]:
        return self.inner.filter_by_rows(self._seen(world), nominal, memory)

    def has_plan(self, memory: Any) -> Flag:
        return self.inner.has_plan(memory)

    def plan(self, world: World, memory: Any) -> Float[Array, "n 2"]:
        return self.inner.plan(self._seen(world), memory)

    def with_delay(self, delay: Scalar) -> Shield:
        return AdaptedShield(self.scenario, self.inner.with_delay(delay))

    def with_acceleration(self, acceleration: float) -> Shield:
        return AdaptedShield(self.scenario, self.inner.with_acceleration(acceleration))

    def _seen(self, world: World) -> World:
        world = world_of_control_point(self.scenario, world)
        if self.scenario.pursuer_model is None:
            return world

        def restated(wheels: Array) -> Array:
            speed, turn_rate = body_velocity(wheels, self.scenario.pursuer_half_axle)
            return wheels_from_body(speed, turn_rate, self.inner.scenario.pursuer_half_axle)

        return eqx.tree_at(lambda w: w.wheel_speeds, world, jax.vmap(restated)(world.wheel_speeds))
