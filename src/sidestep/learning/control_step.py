"""One control period of everything: the way that simulation, training and evaluation all take.

    world -> observation -> policy -> nominal velocity -> shield -> filtered action
                        pursuers -> wheel speeds --------> world one period later, events

`decide` is the policy's part and runs every `decision_steps` periods (`decision_steps_of`), its nominal
velocity being held in world axes in between; `control_step` is the rest and runs in every period.
"""

from collections.abc import Callable
from typing import Any

import jax.numpy as jnp
from jaxtyping import Array, Float, Int, PRNGKeyArray

from sidestep._arrays import AnyArray, real
from sidestep.pursuit import pursue
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


def outcome_of(events: Events) -> Int[Array, ""]:
    """Index into `records.OUTCOMES` of what ended the episode in this period, -1 if nothing did."""
    flags = jnp.stack([events.captured, events.collided, events.reached, events.timed_out])
    return jnp.where(jnp.any(flags), jnp.argmax(flags), RUNNING).astype(jnp.int32)


def decide(scenario: Scenario, policy: Callable[..., Any], world: World) -> Float[Array, "2"]:
    """The nominal velocity (m/s, world axes) that `policy(observation)` asks for in `world`.

    An action that is not finite gives a nominal velocity of NaN, so that the shield sees it and reports
    invalid input; the physics alone would take it for a stop.

    **Raises** `ValueError` when the policy's action does not have shape (2,).
    """
    action = jnp.asarray(policy(observe(scenario, world)))
    if action.shape != (2,):
        raise ValueError(
            f"a policy must answer one observation with an action of shape (2,), not {action.shape}"
        )
    action = real(action)
    return jnp.where(jnp.all(jnp.isfinite(action)), to_velocity(scenario, world, action), jnp.nan)


def control_step(
    scenario: Scenario,
    shield: Callable[..., Any],
    pursuer: Callable[..., Any],
    world: World,
    memory: Any,
    nominal: Float[AnyArray, "2"],
    key: PRNGKeyArray,
) -> tuple[World, Any, Events, Any, Float[Array, "m 2"]]:
    """One control period: the shield corrects `nominal`, the pursuers answer, the physics moves.

    Evader and pursuers act at once, on the same world: neither sees the other's new command.

    **Arguments:** `shield(world, nominal, memory) -> (ShieldResult, memory)`;
    `pursuer(scenario, world, key) -> wheel speeds (2,)` in m/s; `nominal` velocity in m/s, world axes.

    **Returns** the world one period later, the shield's new memory, the `Events` of the period, the
    `ShieldResult`, and the wheel speeds (m, 2) in m/s that the pursuers asked for.
    """
    result, memory = shield(world, nominal, memory)
    wheel_speeds = pursue(scenario, pursuer, world, key)
    moved, events = scenario.step(world, result.action, wheel_speeds)
    return moved, memory, events, result, wheel_speeds
