"""Many episodes in lanes, with automatic resets: one decision of all lanes in one compiled call.

Drawing a start takes longer than a decision, and with a thousand lanes an episode ends in almost every step.
Each lane therefore keeps its next starts in a buffer. When one lane's buffer is empty, starts are drawn for
all lanes at once.
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
"""When the next episode begins after one has ended: the values of `gymnasium.vector.AutoresetMode`."""
AHEAD = 3
"""Buffered starts per lane."""


class Fleet(eqx.Module):
    """The episodes of all lanes, and which of them have ended."""

    episode: EnvState
    ended: Bool[Array, "lanes"]


class Step(eqx.Module):
    """The result of a step: the current `observation`, the `final` observation of episodes that ended (with
    `SAME_STEP` only), and the `decision`."""

    observation: Float[Array, "lanes observation"]
    final: Float[Array, "lanes observation"] | None
    decision: Decision


def launch(task: Task, words: UInt32[AnyArray, "2 lanes"], number: Int[AnyArray, "lanes"]) -> Fleet:
    """Start the episodes with these numbers in all lanes."""
    return Fleet(begin(task, words, number), jnp.zeros(number.shape, bool))


def place(task: Task, fleet: Fleet, world: World) -> Fleet:
    """Start an episode in each lane in the given worlds (in lanes)."""
    episode = begin_in(task, world, fleet.episode.words, fleet.episode.number)
    return Fleet(episode, jnp.zeros_like(fleet.ended))


class Spares(eqx.Module):
    """Buffered starts of each lane's next episodes: worlds and the shield's memories. Their first axis has
    size `AHEAD`; episode n is at index n modulo `AHEAD`."""

    world: Any
    memory: Any


def no_spares(fleet: Fleet) -> Spares:
    """An empty buffer for this fleet."""
    starts = Spares(fleet.episode.world, fleet.episode.memory)
    return jax.tree.map(lambda leaf: jnp.zeros((AHEAD, *leaf.shape), leaf.dtype), starts)


def draw(
    task: Task,
    fleet: Fleet,
    spares: Spares,
    lanes: Int[AnyArray, "several"],
    numbers: Int[AnyArray, "several"],
) -> Spares:
    """Draw the starts of these episodes into the buffers of these lanes; lanes out of range are ignored."""
    lanes, numbers = jnp.asarray(lanes), jnp.asarray(numbers)
    words = fleet.episode.words[:, jnp.minimum(lanes, fleet.ended.shape[0] - 1)]
    drawn = begin(task, words, numbers)

    def put(old: Any, new: Any) -> Any:
        return old.at[numbers % AHEAD, ..., lanes].set(jnp.moveaxis(new, -1, 0), mode="drop")

    return jax.tree.map(put, spares, Spares(drawn.world, drawn.memory))


def follow(fleet: Fleet, spares: Spares, where: Bool[AnyArray, "lanes"]) -> Fleet:
    """Begin the next episode in these lanes; its start must be in the buffer."""
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
    """One decision in every lane; ended episodes are followed by the next according to `mode`."""
    actions = jnp.moveaxis(jnp.asarray(actions), -1, 0)
    begun, episode, final = fleet.ended, fleet.episode, None
    if mode == NEXT_STEP:
        # Their step is discarded: far from everything, a shield with look-ahead decides quickly.
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
