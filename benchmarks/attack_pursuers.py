"""Pursuers that attack an evader between them and an obstacle, for the studies of `joint`.

None of them is a model that a shield imagines, nor the worst case that a table is solved for.
"""

from typing import Any, final

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, PRNGKeyArray

from sidestep.learning import load_pursuer
from sidestep.pursuit import Pursuer, make_pursuer
from sidestep.pursuit.steering import bearing_of, nearer_end, turn_and_drive
from sidestep.trials.falsification.attackers import JointSaddle, herder, sideswiper
from sidestep.world.capture_geometry import to_pursuer_frame
from sidestep.world.scenario import Scenario
from sidestep.world.state import World


def _towards(scenario: Scenario, world: World, place: Float[Array, "2"]) -> Float[Array, "2"]:
    """Wheel speeds (m/s) that turn the nearer end to a place and drive there."""
    end, turn = nearer_end(bearing_of(to_pursuer_frame(place, world.pursuer)))
    return turn_and_drive(
        turn, end, scenario.pursuer_speed, scenario.pursuer_half_axle, scenario.control_period
    )


@final
class Guard(Pursuer):
    """Waits at the target, on the evader's side of it, and plays `nash` against one within `leash` (m)."""

    leash: float = eqx.field(static=True, default=0.6)

    def steer(self, scenario: Scenario, world: World, key: PRNGKeyArray) -> Float[Array, "2"]:
        offset = world.evader - world.target
        distance = jnp.linalg.norm(offset)
        post = world.target + 0.1 * offset / jnp.maximum(distance, 1e-3)
        near = jnp.linalg.norm(world.evader - world.pursuer[:2]) < self.leash
        attack = make_pursuer("nash")(scenario, world, key)
        return jnp.where(near | (distance < self.leash), attack, _towards(scenario, world, post))


@final
class Reverser(Pursuer):
    """Drives at the evader with its rear, wherever that is, and turns the front to it every `hold` seconds
    for one: each time the evader has to change the side."""

    hold: float = eqx.field(static=True, default=3.0)

    def steer(self, scenario: Scenario, world: World, key: PRNGKeyArray) -> Float[Array, "2"]:
        bearing = bearing_of(to_pursuer_frame(world.evader, world.pursuer))
        rear = bearing - jnp.where(bearing < 0.0, -jnp.pi, jnp.pi)
        back = jnp.mod(world.time, self.hold + 1.0) < self.hold
        return turn_and_drive(
            jnp.where(back, rear, bearing),
            jnp.where(back, -1.0, 1.0).astype(bearing.dtype),
            scenario.pursuer_speed,
            scenario.pursuer_half_axle,
            scenario.control_period,
        )


@final
class Jitter(Pursuer):
    """Plays `nash`, but in a share of the periods drives each wheel at full speed in a random direction."""

    share: float = eqx.field(static=True, default=0.3)

    def steer(self, scenario: Scenario, world: World, key: PRNGKeyArray) -> Float[Array, "2"]:
        first, second = jax.random.split(key)
        wheels = jax.random.rademacher(second, (2,), dtype=world.evader.dtype) * scenario.pursuer_speed
        attack = make_pursuer("nash")(scenario, world, key)
        return jnp.where(jax.random.bernoulli(first, self.share), wheels, attack)


def _float(value: float) -> Array:
    return jnp.asarray(value, float)


ATTACKS: dict[str, Any] = {
    "herder": lambda: herder((jnp.asarray(False), _float(0.6))),
    "sideswiper": lambda: sideswiper((_float(0.6), _float(0.3))),
    "guard": Guard,
    "reverser": Reverser,
    "saddle": lambda: JointSaddle(None, jnp.zeros(2)),
    "jitter": Jitter,
    "hunter": lambda: load_pursuer("hunter"),
}
"""The attacking pursuers by name; `saddle` lowers the barrier, or what is left to the obstacle, as far as one
period allows, and knows the evader's velocity."""


def pursuer_named(name: str) -> Any:
    """An attacking pursuer, or one of `load_pursuer`."""
    return ATTACKS[name]() if name in ATTACKS else load_pursuer(name)
