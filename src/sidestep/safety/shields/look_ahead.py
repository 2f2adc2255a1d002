"""What becomes of an escape plan? Imagined chases against several models of the pursuers at once.

The imagined evader drives what the rows of the `game` shield let through, as the real one does. So the rows
keep it from capture, and the look-ahead has to find out whether obstacles stay clear too.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from sidestep._arrays import Lanes, Scalar, length, stack
from sidestep.pursuit import Pursuer, make_pursuer, pursue
from sidestep.safety.shields.escape_plan import SEGMENTS, EscapePlan, choice_at, chosen_velocity
from sidestep.world.scenario import Scenario
from sidestep.world.state import World

_PATH_POINTS = 33


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
    """A robot changes its velocity from `velocity` straight to `wanted` at `acceleration` (m/s^2).

    **Returns** its mean velocity in the period and its velocity at the end, m/s.
    """
    lacking_x, lacking_y = wanted[0] - velocity[0], wanted[1] - velocity[1]
    gained, lacking = acceleration * period, length(lacking_x, lacking_y)
    end = jnp.where(lacking > gained, gained / jnp.where(lacking > gained, lacking, 1.0), 1.0)
    # While it changes, at most for the whole period, the mean is half-way; after that, the end velocity.
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
    """The world one control period later.

    With `acceleration` (m/s^2) the evader starts from `world.evader_velocity` and needs time to reach
    `velocity` (m/s); with None it drives `velocity` at once.
    """
    if acceleration is None:
        return scenario.moved(world, velocity, wheels)
    mean, end = ramp(world.evader_velocity, velocity, acceleration, scenario.control_period)
    return eqx.tree_at(lambda w: w.evader_velocity, scenario.moved(world, mean, wheels), end)


class Outlook(eqx.Module):
    """Result of imagined chases.

    - `time` s until the first contact; the whole time where there is none
    - `least` m, the smallest clearance on the way, without that of the start
    """

    time: Float[Array, "models n"]
    least: Float[Array, "models n"]


def imagine(
    scenario: Scenario,
    guard: Callable[..., Any],
    models: Sequence[Pursuer],
    worlds: World,
    sides: Float[Array, "m models n"],
    plans: Int[Array, "n segments"],
    ages: Float[Array, "n"],
    segment: Scalar,
    steps: int,
    acceleration: Scalar | None = None,
) -> Outlook:
    """Follow n escape plans for `steps` control periods of `scenario`, each against every model.

    **Arguments:**

    - `guard(world, nominal, sides) -> (action, sides)` the rows
    - `worlds`, `sides` with axes (models, n) behind their own; model i drives the pursuers of
      `worlds[..., i, :]`
    - `ages` s, how long each plan has been followed already; `segment` s, the length of its segments
    - `acceleration` m/s^2 of the evader's motors; None: the evader reaches every velocity at once
    """
    key = jax.random.key(0)  # the models do not draw
    lanes = (len(models), len(plans))

    period = scenario.control_period

    def step(carry: Any, _: None) -> tuple[Any, None]:
        worlds, sides, ages, outlook = carry
        choices = jax.vmap(choice_at, in_axes=(0, 0, None))(plans, ages, segment)
        nominal = chosen_velocity(scenario, worlds, sides, jnp.broadcast_to(choices, lanes))
        actions, sides = guard(worlds, nominal, sides)
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


def path(
    scenario: Scenario,
    guard: Callable[..., Any],
    world: World,
    sides: Float[Array, "m"],
    plan: EscapePlan,
    age: Scalar,
    horizon: Scalar,
    acceleration: Scalar | None,
) -> Float[Array, "n 2"]:
    """Positions (m) of an evader that follows one escape plan for `horizon` (s), the present one first.

    The pursuers play `nash`. Other arguments as for `imagine`.
    """
    pursuer, steps = make_pursuer("nash"), _PATH_POINTS - 1
    period = horizon / steps
    paced = eqx.tree_at(lambda scenario: scenario.control_period, scenario, period)

    def step(carry: Any, count: Array) -> Any:
        world, sides = carry
        choice = choice_at(plan, age + period * count, horizon / SEGMENTS)
        action, sides = guard(world, chosen_velocity(paced, world, sides, choice), sides)
        wheels = pursue(paced, pursuer, world, jax.random.key(0))
        world = moved(paced, world, action, wheels, acceleration)
        return (world, sides), world.evader

    _, positions = jax.lax.scan(step, (world, sides), jnp.arange(steps).astype(period.dtype))
    return jnp.concatenate([world.evader[None], positions])
