"""Many episodes side by side, each followed by the next: one decision of all of them in one compiled call.

Drawing a start takes longer than a decision, and with a thousand worlds some episode ends almost every time.
So each lane has its next start at hand; new ones are drawn, for all lanes that lack one, only when a lane
ends again before its own has been drawn.
"""

from __future__ import annotations

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int, UInt32

from sidestep._arrays import AnyArray
from sidestep.bridges.gym.episode import Decision, Episode, begin, begin_in, decide, seen, select
from sidestep.bridges.gym.task import Task
from sidestep.world import World

NEXT_STEP, SAME_STEP, DISABLED = "NextStep", "SameStep", "Disabled"
"""When an episode that has ended is followed by the next one: `gymnasium.vector.AutoresetMode`'s values."""
_DRAWN_AT_ONCE = 64


class Fleet(eqx.Module):
    """Lanes of episodes; `spare` the next of each, if `ready`; `ended` lanes whose episode is over."""

    episode: Episode
    spare: Episode
    ready: Bool[Array, "lanes"]
    ended: Bool[Array, "lanes"]


class Step(eqx.Module):
    """What a step shows: `observation` of where the lanes are now, `final` of where those that ended were
    (with `SAME_STEP` only), `begun` lanes that took a new episode's start instead of a decision."""

    observation: Float[Array, "lanes observation"]
    final: Float[Array, "lanes observation"] | None
    decision: Decision
    begun: Bool[Array, "lanes"]


def launch(
    task: Task, words: UInt32[AnyArray, "2 lanes"], number: Int[AnyArray, "lanes"], world: World | None = None
) -> Fleet:
    """All lanes at the start of the episodes with these numbers, or in given worlds (in lanes)."""
    number = jnp.asarray(number, jnp.int32)
    episode = begin(task, words, number) if world is None else begin_in(task, world, words, number)
    none = jnp.zeros(number.shape, bool)
    return Fleet(episode, begin(task, words, number + 1), ~none, none)


def relaunch(task: Task, fleet: Fleet, mask: Bool[AnyArray, "lanes"]) -> Fleet:
    """The lanes in `mask` at the start of their next episodes."""
    mask = jnp.asarray(mask)
    return _followed(_replenished(task, fleet, mask), mask)


def step(task: Task, mode: str, fleet: Fleet, actions: Float[AnyArray, "lanes 2"]) -> tuple[Fleet, Step]:
    """One decision in every lane, and the next episode where one has ended, as `mode` says."""
    actions = jnp.moveaxis(jnp.asarray(actions), -1, 0)
    final = None
    if mode == NEXT_STEP:
        begun = fleet.ended
        fleet = _replenished(task, fleet, begun)
        # What they do is thrown away: it should not cost a shield that thinks long when it is close.
        idle = eqx.tree_at(lambda e: e.world, fleet.episode, fleet.episode.world.set_apart(begun))
        episode, decision = decide(task, idle, actions)
        fleet = _followed(eqx.tree_at(lambda f: f.episode, fleet, episode), begun)
        fleet = eqx.tree_at(lambda f: f.ended, fleet, decision.ended & ~begun)
    else:
        episode, decision = decide(task, fleet.episode, actions)
        fleet = eqx.tree_at(lambda f: (f.episode, f.ended), fleet, (episode, decision.ended))
        begun = jnp.zeros_like(fleet.ended)
        if mode == SAME_STEP:
            final, ended = seen(task, episode), fleet.ended
            fleet = _followed(_replenished(task, fleet, ended), ended)
    return fleet, Step(seen(task, fleet.episode), final, decision, begun)


def _followed(fleet: Fleet, where: Bool[Array, "lanes"]) -> Fleet:
    """The next episode, which must be ready, in these lanes."""
    episode = select(where, fleet.spare, fleet.episode)
    return Fleet(episode, fleet.spare, fleet.ready & ~where, fleet.ended & ~where)


def _replenished(task: Task, fleet: Fleet, where: Bool[Array, "lanes"]) -> Fleet:
    """The same with a next episode in each of these lanes; with one in all lanes, if one of these had none."""
    lanes = fleet.ready.shape[0]
    few = min(lanes, _DRAWN_AT_ONCE)
    words, number = fleet.episode.words, fleet.episode.number

    def lacking(carry: tuple[Episode, Array]) -> Array:
        return jnp.any(where & ~carry[1])

    def draw(carry: tuple[Episode, Array]) -> tuple[Episode, Array]:
        spare, ready = carry
        chosen = jnp.nonzero(~ready, size=few, fill_value=lanes)[0]
        within = jnp.minimum(chosen, lanes - 1)
        drawn = begin(task, words[:, within], number[within] + 1)

        def put(old: Any, new: Any) -> Any:
            return old.at[..., chosen].set(new, mode="drop")

        return jax.tree.map(put, spare, drawn), ready.at[chosen].set(True, mode="drop")

    spare, ready = jax.lax.while_loop(lacking, draw, (fleet.spare, fleet.ready))
    return eqx.tree_at(lambda f: (f.spare, f.ready), fleet, (spare, ready))
