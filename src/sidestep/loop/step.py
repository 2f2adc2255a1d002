"""One control period. Simulation, training and evaluation all use it.

    world -> observation -> policy -> nominal velocity -> shield -> filtered action
                        pursuers -> wheel speeds --------> world one period later, events

`decide` is the policy's part. It runs every `decision_steps` periods (`decision_steps_of`); in between, the
nominal velocity is constant in world axes. `control_step` is the rest and runs in every period.
"""

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from sidestep._arrays import AnyArray, lane_by_lane, real
from sidestep.pursuit import pursue
from sidestep.safety import filter_in_lanes
from sidestep.world.events import Events
from sidestep.world.observation import observe, to_velocity
from sidestep.world.scenario import Scenario
from sidestep.world.state import World


def decision_steps_of(policy: object) -> int:
    """Control periods between two decisions of a policy: its `decision_steps`, or 1 when it has none.

    **Raises** `ValueError` when that is not a whole number of at least 1.
    """
    steps = getattr(policy, "decision_steps", 1)
    if isinstance(steps, bool) or not isinstance(steps, int) or steps < 1:
        raise ValueError(f"the policy's decision_steps = {steps!r}: it must be a whole number of at least 1")
    return steps


RUNNING = -1
"""Outcome of an episode that has not ended."""
CAPTURED, COLLIDED, REACHED, TIMED_OUT = range(4)
"""Outcomes of an ended episode, as indices into `store.runs.OUTCOMES`."""


def outcome_of(events: Events) -> Int[Array, "*lanes"]:
    """Index into `store.runs.OUTCOMES` of the event that ended the episode in this period, -1 for none."""
    outcome = jnp.full_like(events.captured, RUNNING, jnp.int32)
    flags = (events.captured, events.collided, events.reached, events.timed_out)
    for index in reversed(range(len(flags))):
        outcome = jnp.where(flags[index], index, outcome)
    return outcome


def decide(scenario: Scenario, policy: Callable[..., Any], world: World) -> Float[Array, "2 *lanes"]:
    """The nominal velocity (m/s, world axes) of `policy(observation)` in `world`, or in each world in lanes.

    A non-finite action gives a nominal velocity of NaN, so that the shield reports invalid input. The physics
    would take it for a stop.

    **Raises** `ValueError` when the policy's action does not have shape (2,).
    """

    def ask(observation: Float[Array, "observation"]) -> Float[Array, "2"]:
        action = jnp.asarray(policy(observation))
        if action.shape != (2,):
            raise ValueError(
                f"a policy must answer one observation with an action of shape (2,), not {action.shape}"
            )
        return real(action)

    return nominal_velocity(scenario, world, lane_by_lane(ask, world.lanes, observe(scenario, world)))


def nominal_velocity(
    scenario: Scenario, world: World, action: Float[AnyArray, "2 *lanes"]
) -> Float[Array, "2 *lanes"]:
    """`to_velocity`, but NaN for a non-finite action, so that shields report invalid input."""
    finite = jnp.isfinite(action[0]) & jnp.isfinite(action[1])
    return jnp.where(finite, to_velocity(scenario, world, action), jnp.nan)


def control_step(
    scenario: Scenario,
    shield: Callable[..., Any],
    pursuer: Callable[..., Any],
    world: World,
    memory: Any,
    nominal: Float[AnyArray, "2 *lanes"],
    key: Any,
) -> tuple[World, Any, Events, Any, Float[Array, "m 2 *lanes"]]:
    """One control period: the shield filters `nominal`, the pursuers decide, the robots move.

    Evader and pursuers decide simultaneously from the same world; neither knows the other's new command, but
    for a pursuer that `knows_velocity`: the worst that a sampled shield may meet.

    Many worlds may be stepped in lanes, with their axis last; on a CPU this is several times faster than
    `jax.vmap` over this function. Then `memory` and `key` have one entry per lane.

    **Arguments:** `shield(world, nominal, memory) -> (ShieldResult, memory)`;
    `pursuer(scenario, world, key) -> wheel speeds (2,)` in m/s; `nominal` velocity in m/s, world axes.

    **Returns** the world one period later, the shield's new memory, the `Events` of the period, the
    `ShieldResult`, and the pursuers' commanded wheel speeds (m, 2) in m/s, see `pursue`.
    """
    result, memory = filter_in_lanes(shield, world, nominal, memory)
    seen = world
    if getattr(pursuer, "knows_velocity", False):
        seen = eqx.tree_at(lambda world: world.evader_velocity, world, result.action)
    wheel_speeds = pursue(scenario, pursuer, seen, key)
    moved, events = scenario.step(world, result.action, wheel_speeds)
    return moved, memory, events, result, wheel_speeds
