"""Many chases at once, each against its own pursuer, recorded so that any of them can be played again."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int, Key, PRNGKeyArray

from sidestep._arrays import Count, real
from sidestep.loop.step import RUNNING, control_step, decide, decision_steps_of, outcome_of
from sidestep.trials.falsification.attackers import escape_margin
from sidestep.world import Scenario, World

GOALS = ("capture", "collision", "both")
"""What an attack may want."""

_FAINT = 0.02


class Target(eqx.Module):
    """What is attacked: the evader's `policy` behind its `shield` in a `scenario`."""

    scenario: Scenario
    policy: Callable[..., Any]
    shield: Any


class Chase(eqx.Module):
    """A chase on its way. `outcome` is -1 while it runs; the rest is the least so far, in m.

    `margin` is the least h (see `escape_margin`) at the end of a control period.
    """

    world: World
    memory: Any
    nominal: Float[Array, "*batch 2"]
    steps: Int[Array, "*batch"]
    outcome: Int[Array, "*batch"]
    pursuer_clearance: Float[Array, "*batch"]
    obstacle_clearance: Float[Array, "*batch"]
    margin: Float[Array, "*batch"]


def begin(target: Target, world: World) -> Chase:
    """A chase that starts in `world`."""
    far = real(jnp.inf)
    return Chase(
        world=world,
        memory=target.shield.init(world),
        nominal=jnp.zeros_like(world.evader),
        steps=jnp.zeros((), jnp.int32),
        outcome=jnp.full((), RUNNING, jnp.int32),
        pursuer_clearance=far,
        obstacle_clearance=far,
        margin=far,
    )


def forget(chases: Chase) -> Chase:
    """The same chases with nothing remembered of how close they were."""
    far = jnp.full_like(chases.margin, jnp.inf)
    return eqx.tree_at(
        lambda chase: (chase.pursuer_clearance, chase.obstacle_clearance, chase.margin), chases, (far,) * 3
    )


def one_period(
    target: Target, pursuer: Callable[..., Any], chase: Chase, nominal: Array, key: PRNGKeyArray
) -> tuple[Chase, Float[Array, "m 2"]]:
    """A chase one control period later, and the wheel speeds (m/s) asked for; one that ended stays."""
    scenario, running = target.scenario, chase.outcome == RUNNING
    world, memory, events, _, wheels = control_step(
        scenario, target.shield, pursuer, chase.world.set_apart(~running), chase.memory, nominal, key
    )
    moved = Chase(
        world=world,
        memory=memory,
        nominal=nominal,
        steps=chase.steps + 1,
        outcome=outcome_of(events),
        pursuer_clearance=jnp.minimum(chase.pursuer_clearance, events.pursuer_clearance),
        obstacle_clearance=jnp.minimum(chase.obstacle_clearance, events.obstacle_clearance),
        margin=jnp.minimum(chase.margin, escape_margin(scenario, world)),
    )
    pick = lambda new, old: jnp.where(running, new, old)  # noqa: E731
    return jax.tree.map(pick, moved, chase), jnp.where(running, wheels, 0.0)


def run(
    target: Target,
    strategy: Callable[[Any], Callable[..., Any]],
    parts: Any,
    chases: Chase,
    begun: Count,
    periods: int,
    keys: Key[Array, "n"],
) -> tuple[Chase, Float[Array, "chases t m 2"]]:
    """Each chase up to `periods` control periods further, or to its end.

    **Arguments:** chase i is hunted by `strategy(parts[i])`, a pursuer; `begun` control periods have passed
    before, in all of them; `keys` one random key a chase. To be compiled by the caller.

    **Returns** the chases, and the wheel speeds (m/s) that were asked for, 0 after a chase's end.
    """
    scenario, decision_steps = target.scenario, decision_steps_of(target.policy)
    count = chases.steps.shape[0]

    def period(part: Any, chase: Chase, nominal: Array, key: PRNGKeyArray) -> tuple[Chase, Array]:
        return one_period(target, strategy(part), chase, nominal, key)

    def more(carry: tuple[Array, Chase, Array]) -> Array:
        index, chases, _ = carry
        return (index < periods) & jnp.any(chases.outcome == RUNNING)

    def advance(carry: tuple[Array, Chase, Array]) -> tuple[Array, Chase, Array]:
        index, chases, wheels = carry
        now = begun + index
        nominal = jax.lax.cond(
            now % decision_steps == 0,
            lambda: jax.vmap(lambda world: decide(scenario, target.policy, world))(chases.world),
            lambda: chases.nominal,
        )
        step_keys = jax.vmap(jax.random.fold_in, in_axes=(0, None))(keys, now)
        chases, asked = jax.vmap(period)(parts, chases, nominal, step_keys)
        return index + 1, chases, wheels.at[:, index].set(asked)

    wheels = jnp.zeros((count, periods, scenario.pursuer_count, 2), chases.margin.dtype)
    _, chases, wheels = jax.lax.while_loop(more, advance, (jnp.zeros((), jnp.int32), chases, wheels))
    return chases, wheels


@eqx.filter_jit
def run_from(
    target: Target,
    strategy: Callable[[Any], Callable[..., Any]],
    parts: Any,
    worlds: World,
    periods: int,
    keys: Key[Array, "n"],
) -> tuple[Chase, Float[Array, "chases t m 2"]]:
    """`run` from given start worlds, compiled."""
    chases = jax.vmap(lambda world: begin(target, world))(worlds)
    return run(target, strategy, parts, chases, jnp.zeros((), jnp.int32), periods, keys)


def shortfall(goal: str, chases: Chase) -> Float[Array, "chases"]:
    """How far each chase is from what an attack wants, m; below 0 when it has it, or is sure to get it.

    For a capture the margin h counts, since below 0 a capture can be forced, and faintly the clearance
    itself, so that it then is. For a collision the clearance from obstacles counts, and faintly the margin,
    since a pinned evader is one that can be steered.
    """
    capture = chases.margin + _FAINT * chases.pursuer_clearance
    collision = chases.obstacle_clearance + _FAINT * jnp.maximum(chases.margin, 0.0)
    if goal == "capture":
        return capture
    if goal == "collision":
        return collision
    return jnp.minimum(capture, collision)
