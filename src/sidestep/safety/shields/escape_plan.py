"""What is an escape plan? A nominal velocity for each of a few segments of time.

The evader does not drive these velocities themselves. Each one passes through the rows of the `game` shield,
pursuers first.
"""

from __future__ import annotations

import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from sidestep._arrays import Count, Lanes, Scalar, stack
from sidestep.safety.barriers.pursuit_barrier import PursuitBarrier
from sidestep.world.scenario import Scenario
from sidestep.world.state import World

HEADINGS = 16
"""Number of world headings, evenly spread, among the choices."""
CHOICES = HEADINGS + 4
"""Number of choices: the headings; away from the pursuer; left and right of its axis; a stop."""
SEGMENTS = 4
"""Number of segments in a plan."""

EscapePlan = Int[Array, "segments"]
"""The choice for each segment, 0 to `CHOICES` - 1."""


def chosen_velocity(
    scenario: Scenario, world: World, sides: Float[Array, "m *lanes"], choice: Int[Array, "*lanes"]
) -> Float[Array, "2 *lanes"]:
    """Nominal velocity (m/s, world axes) of a choice in this world.

    The last four choices are relative to the first pursuer and turn with it: along the normal of the pursuit
    barrier, where the barrier grows fastest; left and right of the pursuer's axis, where the pursuer must
    turn before it can drive; and a stop, which leaves the choice to the rows.
    """
    angle = 2.0 * jnp.pi * choice.astype(world.evader.dtype) / HEADINGS
    fixed = jnp.cos(angle), jnp.sin(angle)
    away, _ = PursuitBarrier().gradient_and_rate(scenario, world.evader, world.pursuer, sides[0])
    heading = world.pursuer[2]
    left = -jnp.sin(heading), jnp.cos(heading)
    relative = choice - HEADINGS
    sign = jnp.where(relative == 1, 1.0, -1.0).astype(away.dtype)

    def component(i: int) -> Lanes:
        chosen = jnp.where(relative == 0, away[i], sign * left[i])
        return jnp.where(relative < 0, fixed[i], jnp.where(relative == 3, 0.0, chosen))

    return scenario.evader_speed * stack(component(0), component(1))


def choice_at(plan: EscapePlan, age: Scalar, segment: Scalar) -> Count:
    """The choice of a plan that has been followed for `age` (s), with segments of `segment` (s).

    After the last segment its choice stays.
    """
    return plan[jnp.clip((age / segment).astype(jnp.int32), 0, SEGMENTS - 1)]
