"""Policy and shield compiled into one call, from one vector to one vector."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple, final

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Float

from sidestep._arrays import length, real
from sidestep.loop.step import decide
from sidestep.safety import PursuitBarrier, Shield
from sidestep.safety.shields.look_ahead import clearance
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
        with np.errstate(over="ignore"):  # As in `Answering`.
            return World(
                self.evader,
                self.pursuers,
                self.obstacles,
                self.target,
                np.float64(self.time),
                evader_velocity=self.velocity,
                wheel_speeds=self.wheel_speeds,
            )


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
        return cls(
            nominal=vector[:2],
            action=vector[2:4],
            status=int(vector[4]),
            slack=float(vector[5]),
            intervention=float(vector[6]),
            clearance=float(vector[7]),
            barriers=vector[8 : 8 + count],
        )


@final
class Answering:
    """A shield and a policy compiled into one call with one input vector and one output vector.

    On small computers, passing many small arrays takes most of a decision's time.

    `rows_only`: the shield decides by its rows, without looking ahead. The memory is the same.
    """

    def __init__(self, shield: Shield, policy: Callable[..., Any] | None, *, rows_only: bool = False):
        scenario = shield.scenario
        self._arrays, fixed = eqx.partition((shield, policy), eqx.is_array)
        m, k = scenario.pursuer_count, scenario.obstacle_count
        shapes = [(2,), (m, 3), (k, 4), (2,), (2,), (m, 2), (), (2,), (), (), ()]
        split = ravel_pytree([jnp.zeros(shape, dtype=float) for shape in shapes])[1]
        self._count = m + k

        @jax.jit
        def answer(arrays: Any, numbers: Array, memory: Any) -> tuple[Array, Any]:
            shield, policy = eqx.combine(arrays, fixed)
            parts = split(numbers)
            evader, pursuers, obstacles, target, velocity, wheels, time = parts[:7]
            world = World(evader, pursuers, obstacles, target, time, velocity, wheels)
            given, ask, flee, delay = parts[7:]
            shield = shield.with_delay(delay)
            nominal = _nominal(shield.scenario, policy, world, given, ask, flee)
            result, memory = (shield.filter_by_rows if rows_only else shield)(world, nominal, memory)
            outcome = [nominal, result.action, result.status.astype(nominal.dtype), result.slack]
            outcome += [result.intervention, clearance(shield.scenario, world), result.barriers]
            return jnp.concatenate([jnp.atleast_1d(part) for part in outcome]), memory

        self._compiled = answer

    def __call__(
        self, world: Estimate, given: Numbers, ask: bool, flee: bool, delay: float, memory: Any
    ) -> tuple[Answer, Any]:
        """The shield's answer and next memory.

        `given`: the nominal velocity (m/s) unless the policy decides (`ask`) or the robot flees (`flee`).
        `delay` (s) replaces the budget's.
        """
        parts = (*world, given, ask, flee, delay)
        numbers = np.concatenate([np.ravel(np.asarray(part, np.float64)) for part in parts])
        with np.errstate(over="ignore"):  # An overflow to infinity gives a non-finite answer.
            numbers = numbers.astype(real(0.0).dtype)
        vector, memory = self._compiled(self._arrays, numbers, memory)
        return Answer.of(np.asarray(vector, np.float64), self._count), memory


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
