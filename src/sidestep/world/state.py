"""The state of the world."""

from __future__ import annotations

from collections.abc import Mapping

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from sidestep._arrays import AnyArray, Scalar, real

WORLD_FIELDS = ("evader", "pursuers", "obstacles", "target", "time", "evader_velocity", "wheel_speeds")
"""The fields of every world."""


class World(eqx.Module):
    """The state of all robots, as a pytree. SI units, headings counter-clockwise in rad.

    `evader_velocity` and `wheel_speeds` are those executed in the last control period (zero after a reset).
    Pursuers use the first to intercept the evader, and shields may use the second.

    **Attributes:** `evader (2,)`; `pursuers (m, 3)` x, y, heading; `obstacles (k, 4)` x, y, vx, vy;
    `target (2,)`; `time ()` in s; `evader_velocity (2,)`; `wheel_speeds (m, 2)` left, right;
    `evader_state (s,)` of a custom `EvaderModel`, None without one.
    """

    evader: Float[Array, "2"]
    pursuers: Float[Array, "m 3"]
    obstacles: Float[Array, "k 4"]
    target: Float[Array, "2"]
    time: Scalar
    evader_velocity: Float[Array, "2"]
    wheel_speeds: Float[Array, "m 2"]
    evader_state: Float[Array, "s"] | None

    def __init__(
        self,
        evader: Float[AnyArray, "2"],
        pursuers: Float[AnyArray, "m 3"],
        obstacles: Float[AnyArray, "k 4"],
        target: Float[AnyArray, "2"],
        time: Float[AnyArray, ""] | float = 0.0,
        evader_velocity: Float[AnyArray, "2"] | None = None,
        wheel_speeds: Float[AnyArray, "m 2"] | None = None,
        evader_state: Float[AnyArray, "s"] | None = None,
    ):
        self.evader = real(evader)
        self.pursuers = real(pursuers)
        self.obstacles = real(obstacles)
        self.target = real(target)
        self.time = real(time)
        self.evader_velocity = (
            jnp.zeros_like(self.evader) if evader_velocity is None else real(evader_velocity)
        )
        self.wheel_speeds = (
            jnp.zeros((self.pursuers.shape[0], 2), self.pursuers.dtype)
            if wheel_speeds is None
            else real(wheel_speeds)
        )
        self.evader_state = None if evader_state is None else real(evader_state)

    @property
    def lanes(self) -> int:
        """The number of batch axes after the components; 0 for a single world."""
        return self.evader.ndim - 1

    @property
    def pursuer(self) -> Float[AnyArray, "3 *lanes"]:
        """The pursuer that a strategy steers, the first one: x, y, heading."""
        return self.pursuers[0]

    def seen_by(self, index: int) -> World:
        """The same world with pursuer `index` first, as a strategy for it gets it."""
        if index == 0:
            return self
        return eqx.tree_at(
            lambda world: (world.pursuers, world.wheel_speeds),
            self,
            (jnp.roll(self.pursuers, -index, axis=0), jnp.roll(self.wheel_speeds, -index, axis=0)),
        )

    def set_apart(self, when: Bool[Array, "*lanes"]) -> World:
        """The same world with pursuers and obstacles moved by 1 km where `when`.

        For ended episodes that are stepped along with the rest of their batch: a shield with look-ahead then
        decides quickly.
        """
        off = jnp.where(when, 1000.0, 0.0)
        return eqx.tree_at(
            lambda world: (world.pursuers, world.obstacles),
            self,
            (self.pursuers.at[:, 0].add(off), self.obstacles.at[:, 0].add(off)),
        )


def worlds_of(parts: Mapping[str, AnyArray]) -> World:
    """A `World` of many worlds, from arrays with equal leading axes, named as in `WORLD_FIELDS` and
    optionally `evader_state`. The constructor of `World` is for a single world."""
    place, has_state = jnp.zeros(2), "evader_state" in parts
    one = World(place, jnp.zeros((1, 3)), jnp.zeros((1, 4)), place, evader_state=place if has_state else None)
    names = (*WORLD_FIELDS, "evader_state") if has_state else WORLD_FIELDS
    return jax.tree.unflatten(jax.tree.structure(one), [jnp.asarray(parts[name]) for name in names])
