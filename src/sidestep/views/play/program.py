"""One control period of everything that the page shows, compiled for one shield."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, final

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from sidestep._arrays import real
from sidestep.loop.step import control_step, decide
from sidestep.safety import BarrierRows, PursuitBarrier, Shield, make_shield
from sidestep.safety.shields.answer import with_obstacles
from sidestep.views.play.helm import Helm
from sidestep.views.play.layout import Layout
from sidestep.world import Scenario, World
from sidestep.world.capture_geometry import capture_set_distance, to_pursuer_frame

EVENTS = (
    "reward", "captured", "collided", "reached", "timed_out", "pursuer_clearance", "obstacle_clearance",
)  # fmt: skip


@final
class Program:
    """The control step of one shield, and what is drawn beside it.

    What the visitor may change (numbers of the scenario, positions, who drives) is traced, so that nothing is
    ever compiled again. One vector goes in, `given`, and one comes out, `told`; see those for their parts.

    **Arguments:** `scenario` of the counts and modes that the programs are for, `shield` by name, `policy` as
    `as_policy` returns it.
    """

    def __init__(self, scenario: Scenario, shield: str, policy: Callable[..., Any]):
        m, k = scenario.pursuer_count, scenario.obstacle_count
        place: dict[str, tuple[int, ...]] = {
            "evader": (2,), "pursuers": (m, 3), "obstacles": (k, 4), "target": (2,), "time": (),
            "evader_velocity": (2,), "wheel_speeds": (m, 2),
        }  # fmt: skip
        self.given = Layout({**place, "held": (2,), "ask": (), "strategy": (), "mode": (), "wanted": (2,),
                             "count": ()})  # fmt: skip
        self.told = Layout({
            **place, "nominal": (2,), "action": (2,), "wheels": (m, 2), "status": (), "barriers": (m + k,),
            "slack": (), "intervention": (), **dict.fromkeys(EVENTS, ()),
            "h": (m,), "normals": (m + k, 2), "offsets": (m + k,), "looking": (),
        })  # fmt: skip
        self.place = Layout(place)
        _, fixed = eqx.partition((scenario, policy), eqx.is_array)

        def parts(arrays: Any, numbers: Array, layout: Layout) -> tuple[Scenario, Any, Any, World]:
            changed, policy = eqx.combine(arrays, fixed)
            given = layout.split(numbers)
            return changed, policy, given, World(**{name: given[name] for name in place})

        @jax.jit
        def step(arrays: Any, numbers: Array, memory: Any) -> tuple[Array, Any]:
            changed, policy, given, world = parts(arrays, numbers, self.given)
            kept = make_shield(shield, changed)
            return _step(changed, policy, kept, world, given, memory, self.told)

        @jax.jit
        def begin(arrays: Any, numbers: Array) -> Any:
            changed, _, _, world = parts(arrays, numbers, self.given)
            return make_shield(shield, changed).init(world)

        @jax.jit
        def plan(arrays: Any, numbers: Array, memory: Any) -> Array:
            changed, _, _, world = parts(arrays, numbers, self.given)
            return make_shield(shield, changed).plan(world, memory)

        self.shield = shield
        self._step, self._begin, self._plan = step, begin, plan
        self._dtype = real(0.0).dtype
        self.plans = make_shield(shield, scenario).looks_ahead and m > 0 and k > 0

    def vector(self, given: dict[str, Any]) -> np.ndarray:
        """The vector that goes in."""
        return self.given.filled(given, self._dtype)

    def begin(self, arrays: Any, vector: np.ndarray) -> Any:
        """The shield's memory at the start of an episode."""
        return self._begin(arrays, vector)

    def step(self, arrays: Any, vector: np.ndarray, memory: Any) -> tuple[np.ndarray, Any]:
        """One period: the vector that comes out, and the next memory."""
        told, memory = self._step(arrays, vector, memory)
        return np.asarray(told), memory

    def plan(self, arrays: Any, vector: np.ndarray, memory: Any) -> np.ndarray:
        """Where (n, 2) in m the look-ahead's way out leads; only if `plans`."""
        return np.asarray(self._plan(arrays, vector, memory), float)

    def compile(self, arrays: Any, vector: np.ndarray) -> None:
        """Run everything once, so that it is compiled."""
        memory = self.begin(arrays, vector)
        _, memory = self.step(arrays, vector, memory)
        if self.plans:
            self.plan(arrays, vector, memory)


@final
class Starts:
    """New starts drawn from a scenario's distribution."""

    def __init__(self, scenario: Scenario, place: Layout):
        _, fixed = eqx.partition(scenario, eqx.is_array)

        @jax.jit
        def draw(arrays: Any, seed: Array) -> Array:
            world = eqx.combine(arrays, fixed).reset(jax.random.key(seed))
            return place.joined({name: getattr(world, name) for name in place.shapes})

        self._draw = draw
        self._place = place

    def __call__(self, scenario: Scenario, seed: int) -> dict[str, np.ndarray]:
        """The parts of a world that starts an episode."""
        arrays = eqx.filter(scenario, eqx.is_array)
        vector = np.array(self._draw(arrays, np.uint32(seed)), np.float64)
        return self._place.split(vector)


def traced(scenario: Scenario, policy: Callable[..., Any]) -> Any:
    """What of these a `Program` is handed at each call."""
    return eqx.filter((scenario, policy), eqx.is_array)


def _step(
    scenario: Scenario,
    policy: Callable[..., Any],
    shield: Shield,
    world: World,
    given: dict[str, Any],
    memory: Any,
    told: Layout,
) -> tuple[Array, Any]:
    nominal = jax.lax.cond(
        given["ask"] > 0.0, lambda: decide(scenario, policy, world), lambda: real(given["held"])
    )
    key = jax.random.fold_in(jax.random.key(0), given["count"].astype(jnp.int32))
    helm = Helm(given["strategy"].astype(jnp.int32), given["mode"], given["wanted"], key)
    moved, memory, events, result, wheels = control_step(scenario, shield, helm, world, memory, nominal, key)
    rows = _rows(scenario, shield, world, memory)
    h = jax.vmap(lambda pose: _level(scenario, world, pose))(world.pursuers)
    parts = {name: getattr(moved, name) for name in World.__annotations__ if name in told.shapes}
    parts |= {name: getattr(events, name) for name in EVENTS}
    parts |= {"nominal": nominal, "action": result.action, "wheels": wheels, "status": result.status}
    parts |= {"barriers": result.barriers, "slack": result.slack, "intervention": result.intervention}
    parts |= {"h": h, "normals": rows.normals, "offsets": rows.offsets, "looking": shield.has_plan(memory)}
    return told.joined(parts), memory


def _level(scenario: Scenario, world: World, pose: Any) -> Array:
    """h (m): how far the evader is from a pursuer's capture set, whatever the shield."""
    z = to_pursuer_frame(world.evader, pose)
    return capture_set_distance(z, scenario.usable_angle, scenario.capture_distance)


def _rows(scenario: Scenario, shield: Shield, world: World, memory: Any) -> BarrierRows:
    """The rows that the shield has just kept, with memory as it left it; the game's for a shield without."""
    rows, barrier = shield.rows(world, memory), PursuitBarrier()
    if rows is not None:
        return rows
    towards_pursuers = barrier.rows(scenario, world, barrier.update_memories(scenario, world))
    return with_obstacles(towards_pursuers, scenario, world)
