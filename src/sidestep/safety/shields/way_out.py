"""Where does the way out that `joint` counts on lead?"""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from sidestep.pursuit import make_pursuer, pursue
from sidestep.safety.shields.joint import JointShield
from sidestep.safety.shields.look_ahead import moved, stretch, wish
from sidestep.world.state import World

_PLAN_POINTS = 33


@eqx.filter_jit
def way_out(shield: JointShield, world: World, memory: Any) -> Float[Array, "n 2"]:
    """Where (m) the way out that the shield counts on leads, against a pursuer that plays `nash`."""
    scenario, game, pursuer = shield.scenario, shield.rows_only, make_pursuer("nash")
    steps = _PLAN_POINTS - 1
    period = shield.horizon / steps
    paced = eqx.tree_at(lambda scenario: scenario.control_period, scenario, period)

    def step(carry: Any, count: Array) -> Any:
        world, sides = carry
        age = memory.age + period * count
        wished = wish(paced, world, sides, stretch(memory.way, age, shield.horizon / len(memory.way)))
        action, sides = game.heed(world, wished, sides)
        wheels = pursue(paced, pursuer, world, jax.random.key(0))
        world = moved(paced, world, action, wheels, shield.acceleration)
        return (world, sides), world.evader

    _, way = jax.lax.scan(step, (world, memory.sides), jnp.arange(steps).astype(period.dtype))
    return jnp.concatenate([world.evader[None], way])
