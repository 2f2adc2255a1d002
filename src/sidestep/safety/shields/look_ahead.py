"""Imagined chases: what becomes of a way out if it is followed, against several pursuers at once.

A *way out* is a wished velocity for each of a few stretches of time; what the evader then drives is the
wish passed through the rows of the `game` shield, pursuers first. So an imagined chase keeps from capture
as the real one does, and what remains to be seen is whether obstacles stay clear too.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from sidestep._arrays import Count, Lanes, Scalar, length, stack
from sidestep.pursuit import Pursuer, pursue
from sidestep.safety.barriers.pursuit_barrier import PursuitBarrier
from sidestep.world.scenario import Scenario
from sidestep.world.state import World

HEADINGS = 16
"""World headings, evenly spread, that may be wished."""
WISHES = HEADINGS + 4
"""Wishes: the headings; then away from the pursuer, to either side of its axis, and a stop."""
STRETCHES = 4
"""Stretches of time in a way out, each with a wish of its own."""

WayOut = Int[Array, "stretches"]
"""The wish of each stretch, by number."""


def wish(
    scenario: Scenario, world: World, sides: Float[Array, "m *lanes"], number: Int[Array, "*lanes"]
) -> Float[Array, "2 *lanes"]:
    """Velocity (m/s, world axes) of wish `number` in this world.

    The last four are relative to the first pursuer and turn as it turns: along the pursuit barrier's normal,
    which is how the clearance grows fastest; to the left and to the right of its axis, where it must turn
    before it can drive; and a stop, which leaves the choice to the rows.
    """
    angle = 2.0 * jnp.pi * number.astype(world.evader.dtype) / HEADINGS
    held = jnp.cos(angle), jnp.sin(angle)
    away, _ = PursuitBarrier().approach(scenario, world.evader, world.pursuer, sides[0])
    heading = world.pursuer[2]
    left = -jnp.sin(heading), jnp.cos(heading)
    relative = number - HEADINGS
    sign = jnp.where(relative == 1, 1.0, -1.0).astype(away.dtype)

    def component(i: int) -> Lanes:
        chosen = jnp.where(relative == 0, away[i], sign * left[i])
        return jnp.where(relative < 0, held[i], jnp.where(relative == 3, 0.0, chosen))

    return scenario.evader_speed * stack(component(0), component(1))


def stretch(way: WayOut, age: Scalar, length: Scalar) -> Count:
    """The wish of a way out that has been followed for `age` (s); its last one from then on."""
    return way[jnp.clip((age / length).astype(jnp.int32), 0, STRETCHES - 1)]


def clearance(scenario: Scenario, world: World) -> Lanes:
    """Distance (m) left before the evader collides or is captured; negative in contact."""
    x, y = world.evader[0], world.evader[1]
    to_pursuers = length(world.pursuers[:, 0] - x, world.pursuers[:, 1] - y)
    to_obstacles = length(world.obstacles[:, 0] - x, world.obstacles[:, 1] - y)
    return jnp.minimum(
        jnp.min(to_pursuers - scenario.capture_distance, axis=0, initial=jnp.inf),
        jnp.min(to_obstacles - scenario.collision_distance, axis=0, initial=jnp.inf),
    )


def ramp(
    velocity: Float[Array, "2 *lanes"],
    wanted: Float[Array, "2 *lanes"],
    acceleration: Scalar,
    period: Scalar,
) -> tuple[Float[Array, "2 *lanes"], Float[Array, "2 *lanes"]]:
    """Mean velocity in a period and velocity at its end (m/s) of a robot that goes from `velocity` straight
    to `wanted` at `acceleration` (m/s^2)."""
    lacking_x, lacking_y = wanted[0] - velocity[0], wanted[1] - velocity[1]
    gained, lacking = acceleration * period, length(lacking_x, lacking_y)
    end = jnp.where(lacking > gained, gained / jnp.where(lacking > gained, lacking, 1.0), 1.0)
    # The time that it takes, at most the whole period, is spent half-way between, the rest at the end.
    mean = end * (1.0 - 0.5 * jnp.minimum(lacking / gained, 1.0))
    return (
        stack(velocity[0] + mean * lacking_x, velocity[1] + mean * lacking_y),
        stack(velocity[0] + end * lacking_x, velocity[1] + end * lacking_y),
    )


def moved(
    scenario: Scenario,
    world: World,
    velocity: Float[Array, "2 *lanes"],
    wheels: Float[Array, "m 2 *lanes"],
    acceleration: Scalar | None,
) -> World:
    """`scenario.moved` of a robot that drives `velocity` at once, or else as its `acceleration` (m/s^2) lets
    it get there from `world.evader_velocity`."""
    if acceleration is None:
        return scenario.moved(world, velocity, wheels)
    mean, end = ramp(world.evader_velocity, velocity, acceleration, scenario.control_period)
    return eqx.tree_at(lambda w: w.evader_velocity, scenario.moved(world, mean, wheels), end)


class Outlook(eqx.Module):
    """What becomes of imagined chases: time (s) until the first contact, all of it where there is none, and
    the smallest clearance (m) on the way, that of the start left out."""

    time: Float[Array, "models n"]
    least: Float[Array, "models n"]


def imagine(
    scenario: Scenario,
    guard: Callable[..., Any],
    models: Sequence[Pursuer],
    worlds: World,
    sides: Float[Array, "m models n"],
    ways: Int[Array, "n stretches"],
    ages: Float[Array, "n"],
    length: Scalar,
    steps: int,
    acceleration: Scalar | None = None,
) -> Outlook:
    """What becomes of ways out when they are followed for `steps` of the scenario's control periods.

    **Arguments:** `guard(world, wish, sides) -> (action, sides)`, the rows; `worlds` and `sides` with axes
    (models, n) behind their own, model i driving the pursuers of `worlds[..., i, :]`; `ways` the way out
    followed in each, `ages` how long (s) it has been followed already, `length` of its stretches (s);
    `acceleration` (m/s^2) of the evader's motors, None: they follow at once.
    """
    key = jax.random.key(0)  # the models do not draw
    lanes = (len(models), len(ways))

    period = scenario.control_period

    def step(carry: Any, _: None) -> tuple[Any, None]:
        worlds, sides, ages, outlook = carry
        numbers = jax.vmap(stretch, in_axes=(0, 0, None))(ways, ages, length)
        wished = wish(scenario, worlds, sides, jnp.broadcast_to(numbers, lanes))
        actions, sides = guard(worlds, wished, sides)
        each = [jax.tree.map(lambda leaf, i=i: leaf[..., i, :], worlds) for i in range(len(models))]
        wheels = jnp.stack(
            [pursue(scenario, model, world, key) for model, world in zip(models, each, strict=True)], axis=-2
        )
        worlds = moved(scenario, worlds, actions, wheels, acceleration)
        least = jnp.minimum(outlook.least, clearance(scenario, worlds))
        time = outlook.time + jnp.where(least > 0.0, period, 0.0)
        return (worlds, sides, ages + period, Outlook(time, least)), None

    begin = Outlook(jnp.zeros(lanes, ages.dtype), jnp.full(lanes, jnp.inf, ages.dtype))
    (_, _, _, outlook), _ = jax.lax.scan(step, (worlds, sides, ages, begin), length=steps)
    return outlook
