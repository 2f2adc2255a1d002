"""Many episodes side by side, each followed by the next: one decision of all of them in one compiled call.

Drawing a start takes longer than a decision, and with a thousand worlds some episode ends almost every time.
So each lane has its next starts at hand, and new ones are drawn, for all lanes at once, only when a lane has
used up its own.
"""

from __future__ import annotations

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int, UInt32

from sidestep._arrays import AnyArray, select
from sidestep.bridges.gym.episode import Decision, EnvState, begin, begin_in, decide, seen
from sidestep.bridges.gym.task import Task
from sidestep.world import World

NEXT_STEP, SAME_STEP, DISABLED = "NextStep", "SameStep", "Disabled"
"""When an episode that has ended is followed by the next one: `gymnasium.vector.AutoresetMode`'s values."""
AHEAD = 3
"""Next episodes that each lane has at hand."""


class Fleet(eqx.Module):
    """Lanes of episodes, and which of them have ended."""

    episode: EnvState
    ended: Bool[Array, "lanes"]


class Step(eqx.Module):
    """What a step shows: `observation` of where the lanes are now, `final` of where those that ended were
    (with `SAME_STEP` only), and what the `decision` came to."""

    observation: Float[Array, "lanes observation"]
    final: Float[Array, "lanes observation"] | None
    decision: Decision


def launch(task: Task, words: UInt32[AnyArray, "2 lanes"], number: Int[AnyArray, "lanes"]) -> Fleet:
    """All lanes at the start of the episodes with these numbers."""
    return Fleet(begin(task, words, number), jnp.zeros(number.shape, bool))


def place(task: Task, fleet: Fleet, world: World) -> Fleet:
    """All lanes at the start of an episode in given worlds (in lanes)."""
    episode = begin_in(task, world, fleet.episode.words, fleet.episode.number)
    return Fleet(episode, jnp.zeros_like(fleet.ended))


class Spares(eqx.Module):
    """Worlds in which the next episodes of each lane start, and the shield's memories there: `AHEAD` of them
    in front of all other axes, that of episode n at n modulo `AHEAD`."""

    world: Any
    memory: Any


def no_spares(fleet: Fleet) -> Spares:
    """Room for them."""
    starts = Spares(fleet.episode.world, fleet.episode.memory)
    return jax.tree.map(lambda leaf: jnp.zeros((AHEAD, *leaf.shape), leaf.dtype), starts)


def draw(
    task: Task,
    fleet: Fleet,
    spares: Spares,
    lanes: Int[AnyArray, "several"],
    numbers: Int[AnyArray, "several"],
) -> Spares:
    """The spares with the starts of these episodes of these lanes among them; lanes that do not exist draw
    nothing."""
    lanes, numbers = jnp.asarray(lanes), jnp.asarray(numbers)
    words = fleet.episode.words[:, jnp.minimum(lanes, fleet.ended.shape[0] - 1)]
    drawn = begin(task, words, numbers)

    def put(old: Any, new: Any) -> Any:
        return old.at[numbers % AHEAD, ..., lanes].set(jnp.moveaxis(new, -1, 0), mode="drop")

    return jax.tree.map(put, spares, Spares(drawn.world, drawn.memory))


def follow(fleet: Fleet, spares: Spares, where: Bool[AnyArray, "lanes"]) -> Fleet:
    """The next episode, which must be among the spares, in these lanes."""
    where, now = jnp.asarray(where), fleet.episode
    slot = (now.number + 1) % AHEAD
    spare = jax.tree.map(lambda leaf: leaf[0], spares)
    for index in range(1, AHEAD):
        spare = select(slot == index, jax.tree.map(lambda leaf: leaf[index], spares), spare)  # noqa: B023
    world, memory = select(where, (spare.world, spare.memory), (now.world, now.memory))
    episode = EnvState(
        world,
        memory,
        now.words,
        now.number + where.astype(now.number.dtype),
        jnp.where(where, 0, now.periods),
    )
    return Fleet(episode, fleet.ended & ~where)


def step(
    task: Task, mode: str, fleet: Fleet, spares: Spares | None, actions: Float[AnyArray, "lanes 2"]
) -> tuple[Fleet, Step]:
    """One decision in every lane, and the next episode where one has ended, as `mode` says."""
    actions = jnp.moveaxis(jnp.asarray(actions), -1, 0)
    begun, episode, final = fleet.ended, fleet.episode, None
    if mode == NEXT_STEP:
        # What they do is thrown away: it should not cost a shield that thinks long when it is close.
        episode = eqx.tree_at(lambda e: e.world, episode, episode.world.set_apart(begun))
    episode, decision = decide(task, episode, actions)
    fleet = Fleet(episode, decision.ended)
    if mode == NEXT_STEP:
        assert spares is not None
        fleet = follow(Fleet(episode, decision.ended & ~begun), spares, begun)
        decision = jax.tree.map(lambda leaf: jnp.where(begun, jnp.zeros((), leaf.dtype), leaf), decision)
    elif mode == SAME_STEP:
        assert spares is not None
        final, ended = seen(task, episode), fleet.ended
        fleet = Fleet(follow(fleet, spares, ended).episode, ended)
    return fleet, Step(seen(task, fleet.episode), final, decision)
