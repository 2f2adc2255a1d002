"""Imagined chases: what becomes of a way out if it is followed, against several pursuers at once.

A *way out* is a wished velocity for each of a few stretches of time; what the evader then drives is the
wish passed through the rows of the `game` shield, pursuers first. So an imagined chase keeps from capture
as the real one does, and what remains to be seen is whether obstacles stay clear too.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from sidestep._arrays import Count, Scalar, norm
from sidestep.pursuit import Pursuer, pursue
from sidestep.safety.barriers import PursuitBarrier
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


def wish(scenario: Scenario, world: World, sides: Float[Array, "m"], number: Count) -> Float[Array, "2"]:
    """Velocity (m/s, world axes) of wish `number` in this world.

    The last four are relative to the first pursuer and turn as it turns: along the pursuit barrier's normal,
    which is how the clearance grows fastest; to the left and to the right of its axis, where it must turn
    before it can drive; and a stop, which leaves the choice to the rows.
    """
    angle = 2.0 * jnp.pi * number.astype(world.evader.dtype) / HEADINGS
    held = jnp.stack([jnp.cos(angle), jnp.sin(angle)])
    away, _ = PursuitBarrier().approach(scenario, world.evader, world.pursuer, sides[0])
    heading = world.pursuer[2]
    left = jnp.stack([-jnp.sin(heading), jnp.cos(heading)])
    options = jnp.stack([held, away, left, -left, jnp.zeros_like(held)])
    return scenario.evader_speed * options[jnp.maximum(number - HEADINGS + 1, 0)]


def stretch(way: WayOut, age: Scalar, length: Scalar) -> Count:
    """The wish of a way out that has been followed for `age` (s); its last one from then on."""
    return way[jnp.clip((age / length).astype(jnp.int32), 0, STRETCHES - 1)]


def clearance(scenario: Scenario, world: World, lenience: Scalar) -> Scalar:
    """Distance (m) left before the evader collides or is captured; negative in contact.

    Captures are the rows' business, and a chase imagined in longer periods than the robot's makes them a
    little worse than they are: `lenience` (m) is added to the distance to pursuers.
    """
    to_pursuers = norm(world.pursuers[:, :2] - world.evader) - scenario.capture_distance + lenience
    to_obstacles = norm(world.obstacles[:, :2] - world.evader) - scenario.collision_distance
    return jnp.minimum(jnp.min(to_pursuers, initial=jnp.inf), jnp.min(to_obstacles, initial=jnp.inf))


class Outlook(eqx.Module):
    """What becomes of imagined chases: time (s) until the first contact, all of it where there is none, and
    the smallest clearance (m) on the way, that of the start left out."""

    time: Float[Array, "models n"]
    least: Float[Array, "models n"]


def imagine(
    scenario: Scenario,
    guard: Any,
    models: Sequence[Pursuer],
    worlds: World,
    sides: Float[Array, "models n m"],
    ways: Int[Array, "n stretches"],
    ages: Float[Array, "n"],
    periods: Float[Array, "steps"],
    length: Scalar,
    lenience: Scalar,
) -> Outlook:
    """What becomes of ways out when they are followed.

    **Arguments:** `guard(world, wish, sides) -> (result, sides)`, the rows; `worlds` and `sides` with leading
    axes (models, n), the pursuers of `worlds[i]` being driven by `models[i]`; `ways` the way out followed in
    each, `ages` how long (s) it has been followed already, `length` of its stretches (s); `periods` the
    periods (s) to imagine, one by one; `lenience` see `clearance`.
    """
    key = jax.random.key(0)  # the models do not draw

    def step(carry: Any, period: Scalar) -> tuple[Any, None]:
        worlds, sides, ages, outlook = carry
        paced = eqx.tree_at(lambda scenario: scenario.control_period, scenario, period)
        numbers = jax.vmap(stretch, in_axes=(0, 0, None))(ways, ages, length)

        def decide(world: World, sides: Any, number: Count) -> tuple[Any, Any]:
            result, sides = guard(world, wish(scenario, world, sides, number), sides)
            return result.action, sides

        actions, sides = jax.vmap(jax.vmap(decide), in_axes=(0, 0, None))(worlds, sides, numbers)
        wheels = jnp.stack(
            [
                jax.vmap(lambda world, model=model: pursue(paced, model, world, key))(
                    jax.tree.map(lambda leaf, index=index: leaf[index], worlds)
                )
                for index, model in enumerate(models)
            ]
        )
        move = lambda world, action, wheels: paced.step(world, action, wheels)[0]  # noqa: E731
        worlds = jax.vmap(jax.vmap(move))(worlds, actions, wheels)
        now = jax.vmap(jax.vmap(lambda world: clearance(scenario, world, lenience)))(worlds)
        least = jnp.minimum(outlook.least, now)
        time = outlook.time + jnp.where(least > 0.0, period, 0.0)
        return (worlds, sides, ages + period, Outlook(time, least)), None

    shape = (len(models), len(ways))
    begin = Outlook(jnp.zeros(shape, ages.dtype), jnp.full(shape, jnp.inf, ages.dtype))
    (_, _, _, outlook), _ = jax.lax.scan(step, (worlds, sides, ages, begin), periods)
    return outlook
