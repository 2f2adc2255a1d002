"""Where does the way out that `joint` counts on lead?"""

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from sidestep._arrays import Scalar
from sidestep.pursuit import make_pursuer, pursue
from sidestep.safety.shields.look_ahead import WayOut, moved, stretch, wish
from sidestep.world.scenario import Scenario
from sidestep.world.state import World

_PLAN_POINTS = 33


def way_out(
    scenario: Scenario,
    guard: Callable[..., Any],
    world: World,
    sides: Float[Array, "m"],
    way: WayOut,
    age: Scalar,
    horizon: Scalar,
    acceleration: Scalar | None,
) -> Float[Array, "n 2"]:
    """Where (m) it leads within `horizon` (s) against a pursuer that plays `nash`. See `imagine`."""
    pursuer, steps = make_pursuer("nash"), _PLAN_POINTS - 1
    period = horizon / steps
    paced = eqx.tree_at(lambda scenario: scenario.control_period, scenario, period)

    def step(carry: Any, count: Array) -> Any:
        world, sides = carry
        number = stretch(way, age + period * count, horizon / len(way))
        action, sides = guard(world, wish(paced, world, sides, number), sides)
        wheels = pursue(paced, pursuer, world, jax.random.key(0))
        world = moved(paced, world, action, wheels, acceleration)
        return (world, sides), world.evader

    _, places = jax.lax.scan(step, (world, sides), jnp.arange(steps).astype(period.dtype))
    return jnp.concatenate([world.evader[None], places])
