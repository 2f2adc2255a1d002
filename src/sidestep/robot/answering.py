"""Policy and shield compiled into one call, from one vector to one vector."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any, NamedTuple, Protocol, final

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from sidestep._arrays import length
from sidestep.loop.step import decide
from sidestep.safety import PursuitBarrier, Shield, ShieldResult
from sidestep.safety.shields.look_ahead import clearance
from sidestep.store.programs import kept_program
from sidestep.world import Scenario, World

Numbers = Float[np.ndarray, "n"]


class Estimate(NamedTuple):
    """The estimated world at actuation time: the parts of a `World`."""

    evader: Numbers
    pursuers: Float[np.ndarray, "m 3"]
    obstacles: Float[np.ndarray, "k 4"]
    target: Numbers
    velocity: Numbers
    wheel_speeds: Float[np.ndarray, "m 2"]
    time: float

    def world(self) -> World:
        """The estimate as a `World`."""
        dtype = jax.dtypes.canonicalize_dtype(float)
        with np.errstate(over="ignore"):  # As in `Answering`.
            evader, pursuers, obstacles, target, *still = (np.asarray(part, dtype) for part in self)
        velocity, wheel_speeds, time = still
        return World(evader, pursuers, obstacles, target, time, velocity, wheel_speeds)


class Answer(NamedTuple):
    """The shield's answer: a `ShieldResult` with the nominal velocity and the clearance."""

    nominal: Numbers
    action: Numbers
    status: int
    slack: float
    intervention: float
    clearance: float
    barriers: Numbers

    @classmethod
    def of(cls, vector: Numbers, count: int) -> Answer:
        """The answer from its concatenated parts, with `count` barriers."""
        status, slack, intervention, clearance = vector[4:8].tolist()
        return cls(
            vector[:2], vector[2:4], int(status), slack, intervention, clearance, vector[8 : 8 + count]
        )


class Answers(Protocol):
    """What the decision core asks: a shield and a policy, made into few calls."""

    def start(self, world: Estimate) -> Any:
        """The shield's memory before the first call."""
        ...

    def __call__(
        self, world: Estimate, given: Numbers, ask: bool, flee: bool, delay: float, memory: Any
    ) -> tuple[Answer, Any]:
        """The shield's answer and next memory.

        `given`: the nominal velocity (m/s) unless the policy decides (`ask`) or the robot flees (`flee`).
        `delay` (s) replaces the budget's.
        """
        ...

    def plan(self, world: Estimate, memory: Any) -> Float[np.ndarray, "n 2"]:
        """Positions (m) along the shield's escape plan."""
        ...


@final
class Answering:
    """A shield and a policy compiled into one call with one input vector and one output vector.

    On small computers, passing many small arrays takes most of a decision's time. Where JAX keeps compiled
    programs, these are loaded without tracing (`sidestep.store.programs`).

    `rows_only`: the shield decides by its rows, without looking ahead. The memory is the same.
    """

    def __init__(self, shield: Shield, policy: Callable[..., Any] | None, *, rows_only: bool = False):
        self.shield, self.policy, self.rows_only = shield, policy, rows_only
        arrays, self._fixed = eqx.partition((shield, policy), eqx.is_array)
        leaves, self._structure = jax.tree.flatten(arrays)
        self._leaves = [np.asarray(leaf) for leaf in leaves]
        m, k = shield.scenario.pursuer_count, shield.scenario.obstacle_count
        self.shapes = ((2,), (m, 3), (k, 4), (2,), (2,), (m, 2), (), (2,), (), (), ())
        """Shapes of the parts of the input vector: an `Estimate`, then `given`, `ask`, `flee`, `delay`."""
        ends = np.cumsum([math.prod(shape) for shape in self.shapes]).tolist()
        self._cuts = [slice(*cut) for cut in zip([0, *ends], ends, strict=False)]
        self.flags = slice(self._cuts[8].start, self._cuts[9].stop)
        """Where `ask` and `flee` are in the input vector."""
        self._numbers = np.zeros(ends[-1], jax.dtypes.canonicalize_dtype(float))
        self._parts = [
            self._numbers[cut].reshape(shape) for cut, shape in zip(self._cuts, self.shapes, strict=True)
        ]
        self._count, self.size = m + k, 8 + m + k
        self._programs: dict[str, Callable[..., Any]] = {}

    def start(self, world: Estimate) -> Any:
        return self._program("start", self.pack(world))

    def __call__(
        self, world: Estimate, given: Numbers, ask: bool, flee: bool, delay: float, memory: Any
    ) -> tuple[Answer, Any]:
        vector, memory = self.answer(self.pack(world, given, ask, flee, delay), memory)
        return self.unpack(vector), memory

    def plan(self, world: Estimate, memory: Any) -> Float[np.ndarray, "n 2"]:
        return np.asarray(self._program("plan", self.pack(world), memory), float)

    def answer(self, numbers: Numbers, memory: Any) -> tuple[Array, Any]:
        """The answer's vector and the next memory, for the input vector."""
        return self._program("answer", numbers, memory)

    @property
    def may_look_ahead(self) -> bool:
        """Whether a decision may look ahead, which takes thousands of times as long."""
        return self.shield.looks_ahead and not self.rows_only

    def at_once(self, numbers: Array, memory: Any) -> tuple[Array, Any, Any] | None:
        """What `answer` returns where it does not look ahead, for JAX to trace: the vector, whether it need
        not look ahead, and the next memory. None if the shield does not know that beforehand."""
        shield, world, nominal = self._asked(self.shield, self.policy, numbers)
        if self.rows_only:
            found = *shield.filter_by_rows(world, nominal, memory), jnp.ones((), bool)
        elif (found := shield.at_once(world, nominal, memory)) is None:
            return None
        result, memory, decided = found
        return _vector(shield.scenario, world, nominal, result), decided, memory

    def pack(self, world: Estimate, *more: Any) -> Numbers:
        """The input vector; what is not given is void."""
        with np.errstate(over="ignore"):  # An overflow to infinity gives a non-finite answer.
            for place, part in zip(self._parts, (*world, *more), strict=False):
                place[...] = part
        return self._numbers.copy()

    def unpack(self, vector: Any) -> Answer:
        """The answer in a vector."""
        return Answer.of(np.asarray(vector, np.float64), self._count)

    def _program(self, name: str, numbers: Numbers, memory: Any = None) -> Any:
        given = jax.tree.leaves(memory)
        if name not in self._programs:
            made, structure = getattr(self, f"_{name}"), jax.tree.structure(memory)

            def flat(*arguments: Any) -> Any:
                count = len(self._leaves)
                arrays = jax.tree.unflatten(self._structure, arguments[:count])
                shield, policy = eqx.combine(arrays, self._fixed)
                memory = jax.tree.unflatten(structure, arguments[count + 1 :])
                return made(shield, policy, arguments[count], memory)

            about = (name, self._fixed, self.rows_only)
            self._programs[name] = kept_program(about, flat, *self._leaves, numbers, *given)
        return self._programs[name](*self._leaves, numbers, *given)

    # As JAX traces them

    def _start(self, shield: Shield, policy: Any, numbers: Array, memory: Any) -> Any:
        return shield.init(self._split(numbers)[0])

    def _plan(self, shield: Shield, policy: Any, numbers: Array, memory: Any) -> Any:
        return shield.plan(self._split(numbers)[0], memory)

    def _answer(self, shield: Shield, policy: Any, numbers: Array, memory: Any) -> Any:
        shield, world, nominal = self._asked(shield, policy, numbers)
        result, memory = (shield.filter_by_rows if self.rows_only else shield)(world, nominal, memory)
        return _vector(shield.scenario, world, nominal, result), memory

    def _asked(self, shield: Shield, policy: Any, numbers: Array) -> tuple[Shield, World, Array]:
        """The shield with the delay of this decision, the world, and the nominal velocity (m/s)."""
        world, (given, ask, flee, delay) = self._split(numbers)
        shield = shield.with_delay(delay)
        return shield, world, _nominal(shield.scenario, policy, world, given, ask, flee)

    def _split(self, numbers: Array) -> tuple[World, list[Array]]:
        parts = [numbers[cut].reshape(shape) for cut, shape in zip(self._cuts, self.shapes, strict=True)]
        evader, pursuers, obstacles, target, velocity, wheels, time = parts[:7]
        return World(evader, pursuers, obstacles, target, time, velocity, wheels), parts[7:]


def _vector(scenario: Scenario, world: World, nominal: Array, result: ShieldResult) -> Array:
    """The parts of an `Answer`, concatenated."""
    outcome = [nominal, result.action, result.status.astype(nominal.dtype), result.slack]
    outcome += [result.intervention, clearance(scenario, world), result.barriers]
    return jnp.concatenate([jnp.atleast_1d(part) for part in outcome])


def _nominal(scenario: Scenario, policy: Any, world: World, given: Array, ask: Array, flee: Array) -> Array:
    """The nominal velocity (m/s): `given`, or the policy's with `ask`, or with `flee` full speed away from
    the nearest pursuer."""
    nominal = given
    if policy is not None:
        nominal = jnp.where(ask > 0.0, decide(scenario, policy, world), given)
        # Policies are trained on episodes that end at the target; there a robot must stand still.
        way = world.target - world.evader
        nominal = jnp.where(length(way[0], way[1]) <= scenario.reach_distance, 0.0, nominal)
    if scenario.pursuer_count:
        barrier = PursuitBarrier()
        rows = barrier.rows(scenario, world, barrier.update_memories(scenario, world))
        away = rows.normals[jnp.argmin(rows.values)]
        nominal = jnp.where(flee > 0.0, scenario.evader_speed * away, nominal)
    return nominal
