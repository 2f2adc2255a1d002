"""What an exported function takes and gives, and the function as JAX has it."""

from __future__ import annotations

import re
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from sidestep._arrays import real
from sidestep.bridges.export.program import Program, kind_of
from sidestep.loop.step import decide
from sidestep.safety import Shield
from sidestep.world import Scenario, World, observation_size


class Field(NamedTuple):
    """Numbers that go in or out together: name, shape, kind of number, and what it says about itself."""

    name: str
    shape: tuple[int, ...]
    kind: str
    words: str = ""

    @property
    def size(self) -> int:
        """How many numbers they are."""
        return int(np.prod(self.shape))

    def entries(self, before: str = "") -> list[str]:
        """A name for each of the numbers."""
        return [before + self.name + "".join(f"[{k}]" for k in place) for place in np.ndindex(*self.shape)]

    def given(self, program: Program, before: str = "") -> np.ndarray:
        """The numbers as inputs of a program."""
        made = np.empty(self.size, object)
        made[:] = [program.given(name, self.kind) for name in self.entries(before)]
        return made.reshape(self.shape)


class Exported:
    """A policy, a shield or both for a scenario.

    **Attributes:** `fields`, those of a `World` in its order; `wish`, the nominal velocity; `seen`, the
    observation; `memory`, what the shield keeps from call to call.
    """

    def __init__(self, scenario: Scenario, policy: Callable[..., Any] | None, shield: Shield, what: str):
        self.scenario, self.policy, self.shield, self.what = scenario, policy, shield, what
        m, k = scenario.pursuer_count, scenario.obstacle_count
        self.fields = [
            Field("evader", (2,), "f", "x, y in m"),
            Field("pursuers", (m, 3), "f", "x, y in m, heading in rad"),
            Field("obstacles", (k, 4), "f", "x, y in m, vx, vy in m/s"),
            Field("target", (2,), "f", "x, y in m"),
            Field("time", (), "f", "s since the start"),
            Field("evader_velocity", (2,), "f", "driven in the last period, m/s"),
            Field("wheel_speeds", (m, 2), "f", "left, right, in the last period, m/s"),
        ]
        self.seen = Field("observation", (observation_size(scenario),), "f")
        self.wish = Field("wish", (2,), "f", "nominal velocity in m/s")
        self.memory: list[Field] = []
        if what != "policy":
            zeros = [real(jnp.zeros(field.shape)) for field in self.fields]
            memory, self._structure = jax.tree.flatten_with_path(shield.init(World(*zeros)))
            for keys, leaf in memory:
                name = re.sub(r"\W+", "_", jax.tree_util.keystr(keys)).strip("_") or "sides"
                self.memory.append(Field(name, leaf.shape, kind_of(leaf.dtype)))

    def start(self, *world: Any) -> tuple[Any, ...]:
        """The shield's memory before the first call."""
        return tuple(jax.tree.leaves(self.shield.init(World(*world))))

    def filtered(self, *values: Any) -> tuple[Any, ...]:
        """Safe velocity, status and next memory, for a world, a nominal velocity and the memory."""
        n = len(self.fields)
        memory = jax.tree.unflatten(self._structure, values[n + 1 :])
        result, after = self.shield(World(*values[:n]), values[n], memory)
        return (result.action, result.status, *jax.tree.leaves(after))

    def wished(self, *world: Any) -> tuple[Any, ...]:
        """The policy's velocity in a world, m/s."""
        assert self.policy is not None
        return (decide(self.scenario, self.policy, World(*world)),)

    def both(self, *values: Any) -> tuple[Any, ...]:
        """`filtered` with what the policy wishes."""
        n = len(self.fields)
        (wish,) = self.wished(*values[:n])
        return self.filtered(*values[:n], wish, *values[n:])

    def acted(self, observation: Any) -> tuple[Any, ...]:
        """The policy's action for an observation."""
        assert self.policy is not None
        return (self.policy(observation),)
