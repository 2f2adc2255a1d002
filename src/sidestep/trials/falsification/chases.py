"""Many chases at once, each with its own pursuer, recorded so that each can be replayed."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int, Key, PRNGKeyArray

from sidestep._arrays import Count, real
from sidestep.loop import episode
from sidestep.loop.episode import Episode, Tally, Task, advance, ask
from sidestep.trials.falsification.attackers import escape_margin
from sidestep.world import Scenario, World

GOALS = ("capture", "collision", "both")
"""What an attack may aim for."""

_FAINT = 0.02


class Target(eqx.Module):
    """The evader under attack: its `policy` behind its `shield` in a `scenario`."""

    scenario: Scenario
    policy: Callable[..., Any]
    shield: Any

    def task(self, pursuer: Callable[..., Any]) -> Task:
        """The task of this evader against a pursuer."""
        return Task(self.scenario, self.policy, self.shield, pursuer)


class Chase(eqx.Module):
    """An episode, and its `margin`: the least h (m, see `escape_margin`) at the ends of its periods."""

    episode: Episode
    margin: Float[Array, "*batch"]

    @property
    def world(self) -> World:
        """The current world."""
        return self.episode.world

    @property
    def outcome(self) -> Int[Array, "*batch"]:
        """`RUNNING` or an index into `OUTCOMES`."""
        return self.episode.outcome

    @property
    def running(self) -> Bool[Array, "*batch"]:
        """Whether it has not ended."""
        return self.episode.running

    @property
    def tally(self) -> Tally:
        """The episode's tally so far."""
        return self.episode.tally


def begin(target: Target, world: World) -> Chase:
    """A chase that starts in `world`."""
    return Chase(episode.begin(target.shield, world), real(jnp.inf))


def forget(chases: Chase) -> Chase:
    """The chases with their least clearances and margins reset."""
    far = jnp.full_like(chases.margin, jnp.inf)
    parts = lambda chase: (chase.tally.pursuer_clearance, chase.tally.obstacle_clearance, chase.margin)  # noqa: E731
    return eqx.tree_at(parts, chases, (far,) * 3)


def one_period(task: Task, chase: Chase, key: PRNGKeyArray) -> tuple[Chase, Float[Array, "m 2"]]:
    """Advance a chase by one control period; returns it and the commanded wheel speeds (m/s). A chase that
    has ended does not change."""
    after, period = advance(task, chase.episode, key)
    margin = jnp.minimum(chase.margin, escape_margin(task.scenario, period.after))
    margin = jnp.where(period.running, margin, chase.margin)
    return Chase(after, margin), jnp.where(period.running, period.wheel_speeds, 0.0)


def run(
    target: Target,
    strategy: Callable[[Any], Callable[..., Any]],
    parts: Any,
    chases: Chase,
    begun: Count,
    periods: int,
    keys: Key[Array, "n"],
) -> tuple[Chase, Float[Array, "chases t m 2"]]:
    """Advance each chase by `periods` control periods, or to its end. The caller compiles this function.

    **Arguments:** the pursuer of chase i is `strategy(parts[i])`; `begun` control periods have passed before,
    the same number in all chases; `keys` one random key per chase.

    **Returns** the chases, and the commanded wheel speeds (m/s), 0 after a chase's end.
    """
    count = chases.margin.shape[0]

    def period(part: Any, chase: Chase, key: PRNGKeyArray) -> tuple[Chase, Array]:
        return one_period(target.task(strategy(part)), chase, key)

    def decided(now: Array, chases: Chase) -> Chase:
        task = target.task(strategy)
        due = now % task.decision_steps == 0
        nominal = jax.lax.cond(
            due,
            lambda: jax.vmap(lambda chase: ask(task, chase.episode).nominal)(chases),
            lambda: chases.episode.nominal,
        )
        return eqx.tree_at(lambda chases: chases.episode.nominal, chases, nominal)

    def more(carry: tuple[Array, Chase, Array]) -> Array:
        index, chases, _ = carry
        return (index < periods) & jnp.any(chases.running)

    def go_on(carry: tuple[Array, Chase, Array]) -> tuple[Array, Chase, Array]:
        index, chases, wheels = carry
        now = begun + index
        step_keys = jax.vmap(jax.random.fold_in, in_axes=(0, None))(keys, now)
        chases, asked = jax.vmap(period)(parts, decided(now, chases), step_keys)
        return index + 1, chases, wheels.at[:, index].set(asked)

    wheels = jnp.zeros((count, periods, target.scenario.pursuer_count, 2), chases.margin.dtype)
    _, chases, wheels = jax.lax.while_loop(more, go_on, (jnp.zeros((), jnp.int32), chases, wheels))
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
    """Distance (m) of each chase from the attack's goal; below 0 when it is reached, or can be forced.

    For a capture this is the margin h, since below 0 a capture can be forced, with a small weight on the
    clearance, so that it happens. For a collision it is the clearance from obstacles, with a small weight on
    the margin, since a pinned evader can be steered.
    """
    capture = chases.margin + _FAINT * chases.tally.pursuer_clearance
    collision = chases.tally.obstacle_clearance + _FAINT * jnp.maximum(chases.margin, 0.0)
    if goal == "capture":
        return capture
    if goal == "collision":
        return collision
    return jnp.minimum(capture, collision)
