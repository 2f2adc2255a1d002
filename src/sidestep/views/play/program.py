"""The compiled control step of the page, for one shield."""

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
from sidestep.views.play.control import PursuerControl
from sidestep.views.play.layout import Layout
from sidestep.views.play.rules import TRIES, another_target, turned_back
from sidestep.world import Scenario, World
from sidestep.world.capture_geometry import capture_set_distance, to_pursuer_frame

EVENTS = (
    "reward", "captured", "collided", "reached", "timed_out", "pursuer_clearance", "obstacle_clearance",
)  # fmt: skip


def layouts(scenario: Scenario) -> tuple[Layout, Layout, Layout]:
    """The layouts of a world, of the inputs of `one_period` (a world first), and of its outputs."""
    m, k = scenario.pursuer_count, scenario.obstacle_count
    place: dict[str, tuple[int, ...]] = {
        "evader": (2,), "pursuers": (m, 3), "obstacles": (k, 4), "target": (2,), "time": (),
        "evader_velocity": (2,), "wheel_speeds": (m, 2),
    }  # fmt: skip
    inputs: dict[str, tuple[int, ...]] = {
        **place, "held": (2,), "ask": (), "strategy": (), "mode": (), "command": (2,), "count": (),
        "renew": (), "draws": (TRIES, 2),
    }  # fmt: skip
    outputs: dict[str, tuple[int, ...]] = {
        **place, "nominal": (2,), "action": (2,), "wheels": (m, 2), "status": (), "barriers": (m + k,),
        "slack": (), "intervention": (), **dict.fromkeys(EVENTS, ()),
        "h": (m,), "normals": (m + k, 2), "offsets": (m + k,), "looking": (),
        "next_target": (2,), "turned": (k, 4),
    }  # fmt: skip
    return Layout(place), Layout(inputs), Layout(outputs)


@final
class Program:
    """The control step of one shield, with additional data to draw.

    Everything that the visitor may change (numbers of the scenario, positions, control of the pursuer) is
    traced, so it never recompiles. Input and output are one vector each, with the layouts `inputs` and
    `outputs`.

    **Arguments:** `scenario` with the counts and modes, `shield` by name, `policy` from `as_policy`.
    """

    def __init__(self, scenario: Scenario, shield: str, policy: Callable[..., Any]):
        self.place, self.inputs, self.outputs = layouts(scenario)
        place = self.place.shapes
        _, fixed = eqx.partition((scenario, policy), eqx.is_array)

        def parts(arrays: Any, numbers: Array, layout: Layout) -> tuple[Scenario, Any, Any, World]:
            changed, policy = eqx.combine(arrays, fixed)
            given = layout.split(numbers)
            return changed, policy, given, World(**{name: given[name] for name in place})

        @jax.jit
        def step(arrays: Any, numbers: Array, memory: Any) -> tuple[Array, Any]:
            changed, policy, given, world = parts(arrays, numbers, self.inputs)
            commanded = commands(changed, policy, world, given)
            after = one_period(changed, make_shield(shield, changed), world, commanded, given, memory)
            return self.outputs.joined(after[0]), after[1]

        @jax.jit
        def begin(arrays: Any, numbers: Array) -> Any:
            changed, _, _, world = parts(arrays, numbers, self.inputs)
            return make_shield(shield, changed).init(world)

        @jax.jit
        def plan(arrays: Any, numbers: Array, memory: Any) -> Array:
            changed, _, _, world = parts(arrays, numbers, self.inputs)
            return make_shield(shield, changed).plan(world, memory)

        self.shield = shield
        self._step, self._begin, self._plan = step, begin, plan
        self._dtype = real(0.0).dtype
        self.plans = (
            make_shield(shield, scenario).looks_ahead
            and min(scenario.pursuer_count, scenario.obstacle_count) > 0
        )

    def vector(self, given: dict[str, Any]) -> np.ndarray:
        """The input vector."""
        return self.inputs.filled(given, self._dtype)

    def begin(self, arrays: Any, vector: np.ndarray) -> Any:
        """The shield's memory at the start of an episode."""
        return self._begin(arrays, vector)

    def step(self, arrays: Any, vector: np.ndarray, memory: Any) -> tuple[np.ndarray, Any]:
        """Advance by one period; returns the output vector and the next memory."""
        output, memory = self._step(arrays, vector, memory)
        return np.asarray(output), memory

    def plan(self, arrays: Any, vector: np.ndarray, memory: Any) -> np.ndarray:
        """Positions (n, 2) in m along the escape plan; only if `plans`."""
        return np.asarray(self._plan(arrays, vector, memory), float)

    def compile(self, arrays: Any, vector: np.ndarray) -> None:
        """Compile all functions, by calling each once."""
        memory = self.begin(arrays, vector)
        _, memory = self.step(arrays, vector, memory)
        if self.plans:
            self.plan(arrays, vector, memory)


@final
class Starts:
    """Draws starts from a scenario's distribution."""

    def __init__(self, scenario: Scenario, place: Layout):
        _, fixed = eqx.partition(scenario, eqx.is_array)

        @jax.jit
        def draw(arrays: Any, seed: Array) -> Array:
            world = eqx.combine(arrays, fixed).reset(jax.random.key(seed))
            return place.joined({name: getattr(world, name) for name in place.shapes})

        self._draw = draw
        self._place = place

    def __call__(self, scenario: Scenario, seed: int) -> dict[str, np.ndarray]:
        """The parts of a start world."""
        arrays = eqx.filter(scenario, eqx.is_array)
        vector = np.array(self._draw(arrays, np.uint32(seed)), np.float64)
        return self._place.split(vector)


def traced(scenario: Scenario, policy: Callable[..., Any]) -> Any:
    """The arrays of scenario and policy, which a `Program` gets at each call."""
    return eqx.filter((scenario, policy), eqx.is_array)


class _Commanded(eqx.Module):
    """Pursuers that drive as commanded, `wheels (m, 2)` in m/s."""

    wheels: Array

    def steer_all(self, scenario: Scenario, world: World) -> Array:
        """The commanded wheel speeds."""
        return self.wheels

    def __call__(self, scenario: Scenario, world: World, key: Any) -> Array:
        """Those of the first pursuer alone."""
        return self.wheels[0]


def commands(
    scenario: Scenario, policy: Callable[..., Any], world: World, given: dict[str, Any]
) -> tuple[Array, Array]:
    """What policy and pursuers ask for: the nominal velocity (2,), which is `held` unless the policy is to be
    asked, and wheel speeds (m, 2), m/s. `given`: inputs named by `layouts`."""
    nominal = jax.lax.cond(
        given["ask"] > 0.0, lambda: decide(scenario, policy, world), lambda: real(given["held"])
    )
    # A raw key: programs are also translated, and a typed one hides its words.
    key = jax.random.fold_in(jax.random.PRNGKey(0), given["count"].astype(jnp.int32))
    pursuers = PursuerControl(given["strategy"].astype(jnp.int32), given["mode"], given["command"], key)
    return nominal, pursuers.steer_all(scenario, world)


def one_period(
    scenario: Scenario,
    shield: Shield,
    world: World,
    commanded: tuple[Array, Array],
    given: dict[str, Any],
    memory: Any,
) -> tuple[dict[str, Any], Any]:
    """One control period of the page: the outputs named by `layouts`, and the shield's next memory.

    Beside the world that physics leaves (m, m/s, rad, s) there is what the page goes on with: `next_target`,
    which is another one where it was reached or `renew` is set, and the obstacles as they have `turned`.

    **Arguments:** `commanded` by `commands`; `given`: `renew` and `draws`.
    """
    nominal, wheels = commanded
    step = control_step(scenario, shield, _Commanded(wheels), world, memory, nominal, None)
    moved, memory, events, result, wheels = step
    rows = _rows(scenario, shield, world, memory)
    h = jax.vmap(lambda pose: _level(scenario, world, pose))(world.pursuers)
    renewed = events.reached | (given["renew"] > 0.0)
    target = jnp.where(renewed, another_target(scenario, moved, given["draws"]), moved.target)
    parts = {name: getattr(moved, name) for name in layouts(scenario)[0].shapes}
    parts |= {name: getattr(events, name) for name in EVENTS}
    parts |= {"nominal": nominal, "action": result.action, "wheels": wheels, "status": result.status}
    parts |= {"barriers": result.barriers, "slack": result.slack, "intervention": result.intervention}
    parts |= {"h": h, "normals": rows.normals, "offsets": rows.offsets, "looking": shield.has_plan(memory)}
    parts |= {"next_target": target, "turned": turned_back(scenario, moved)}
    return parts, memory


def _level(scenario: Scenario, world: World, pose: Any) -> Array:
    """The evader's signed distance h (m) from a pursuer's capture set, for any shield."""
    z = to_pursuer_frame(world.evader, pose)
    return capture_set_distance(z, scenario.usable_angle, scenario.capture_distance)


def _rows(scenario: Scenario, shield: Shield, world: World, memory: Any) -> BarrierRows:
    """The rows of the shield's last call, with the memory it returned; those of `game` for a shield without
    rows."""
    rows, barrier = shield.rows(world, memory), PursuitBarrier()
    if rows is not None:
        return rows
    towards_pursuers = barrier.rows(scenario, world, barrier.update_memories(scenario, world))
    return with_obstacles(towards_pursuers, scenario, world)
