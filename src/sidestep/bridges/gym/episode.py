"""Episodes of a task, of one world or of many in lanes: how they begin, and what one decision does.

Episode e of an environment with seed s starts as episode e of `sidestep.evaluate(..., key=s)` does, and its
pursuers draw the same numbers.
"""

from __future__ import annotations

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int, UInt32

from sidestep._arrays import AnyArray, Lanes, lane_by_lane, real, select
from sidestep.bridges.gym.task import Task
from sidestep.loop.keys import episode_key, start_and_pursuit
from sidestep.loop.step import control_step, nominal_velocity
from sidestep.pursuit import without_answer
from sidestep.safety import start_in_lanes
from sidestep.world import World, observe, to_action
from sidestep.world.robots import limit_speed


class Episode(eqx.Module):
    """Where an episode is.

    **Attributes:** `world`, the shield's `memory`, the two `words` of the environment's random key, the
    `number` of the episode, the control `periods` that it has lasted.
    """

    world: World
    memory: Any
    words: UInt32[Array, "2 *lanes"]
    number: Int[Array, "*lanes"]
    periods: Int[Array, "*lanes"]


class Decision(eqx.Module):
    """What came of one decision, over all the control periods for which its action was held.

    **Attributes:** `reward` summed; the flags of `Events`; the worst `status`; `intervention` (m/s, mean);
    `proposed` and `executed` (mean) in the policy's units and axes; the least clearances (m); `periods`
    lived through, and `pursuer_invalid` those of them in which a pursuer's wheel speeds were not finite.
    """

    reward: Lanes
    captured: Bool[Array, "*lanes"]
    collided: Bool[Array, "*lanes"]
    reached: Bool[Array, "*lanes"]
    timed_out: Bool[Array, "*lanes"]
    status: Int[Array, "*lanes"]
    intervention: Lanes
    proposed: Float[Array, "2 *lanes"]
    executed: Float[Array, "2 *lanes"]
    pursuer_clearance: Lanes
    obstacle_clearance: Lanes
    periods: Int[Array, "*lanes"]
    pursuer_invalid: Int[Array, "*lanes"]

    @property
    def ended(self) -> Bool[Array, "*lanes"]:
        """Whether the episode is over."""
        return self.captured | self.collided | self.reached | self.timed_out


def _keys(words: Any, number: Any) -> tuple[Any, Any]:
    return start_and_pursuit(episode_key(jax.random.wrap_key_data(words), number))


def begin(task: Task, words: UInt32[AnyArray, "2 *lanes"], number: Int[AnyArray, "*lanes"]) -> Episode:
    """The start of episode `number` of the environment with these words for a random key."""
    lanes = number.ndim
    world = lane_by_lane(lambda *of: task.scenario.reset(_keys(*of)[0]), lanes, words, number)
    return begin_in(task, world, words, number)


def begin_in(
    task: Task, world: World, words: UInt32[AnyArray, "2 *lanes"], number: Int[AnyArray, "*lanes"]
) -> Episode:
    """The same, but in a given world."""
    number = jnp.asarray(number, jnp.int32)
    return Episode(
        world, start_in_lanes(task.shield, world), jnp.asarray(words), number, jnp.zeros_like(number)
    )


def decide(task: Task, episode: Episode, action: Float[AnyArray, "2 *lanes"]) -> tuple[Episode, Decision]:
    """Hold an action in [-1, 1]^2 for `task.decision_steps` control periods, or until the episode ends.

    The velocity that it asks for stays the same in world axes; the shield corrects it in every period.
    """
    scenario, start = task.scenario, episode.world
    action = real(action)
    nominal, finite = nominal_velocity(scenario, start, action), jnp.all(jnp.isfinite(action), axis=0)
    # Unused, and so not computed, where the pursuer draws nothing.
    keys = lane_by_lane(lambda *of: _keys(*of)[1], start.lanes, episode.words, episode.number)

    def period(episode: Episode, apart: Any) -> tuple[Episode, Decision]:
        key = lane_by_lane(jax.random.fold_in, start.lanes, keys, episode.periods)
        world = episode.world if apart is None else episode.world.set_apart(apart)
        world, memory, events, result, wheels = control_step(
            scenario, task.shield, task.pursuer, world, episode.memory, nominal, key
        )
        moved = Episode(world, memory, episode.words, episode.number, episode.periods + 1)
        return moved, Decision(
            reward=task.reward_scale * events.reward,
            captured=events.captured,
            collided=events.collided,
            reached=events.reached,
            timed_out=events.timed_out,
            status=result.status,
            intervention=result.intervention,
            proposed=jnp.where(finite, limit_speed(action, real(1.0)), action),
            executed=result.action,
            pursuer_clearance=events.pursuer_clearance,
            obstacle_clearance=events.obstacle_clearance,
            periods=jnp.ones_like(moved.periods),
            pursuer_invalid=without_answer(wheels).astype(moved.periods.dtype),
        )

    def another(carry: tuple[Episode, Decision], _: None) -> tuple[tuple[Episode, Decision], None]:
        (episode, so_far), over = carry, carry[1].ended
        moved, now = period(episode, over)
        joined = Decision(
            reward=so_far.reward + now.reward,
            captured=now.captured,
            collided=now.collided,
            reached=now.reached,
            timed_out=now.timed_out,
            status=jnp.maximum(so_far.status, now.status),
            intervention=so_far.intervention + now.intervention,
            proposed=so_far.proposed,
            executed=so_far.executed + now.executed,
            pursuer_clearance=jnp.minimum(so_far.pursuer_clearance, now.pursuer_clearance),
            obstacle_clearance=jnp.minimum(so_far.obstacle_clearance, now.obstacle_clearance),
            periods=so_far.periods + 1,
            pursuer_invalid=so_far.pursuer_invalid + now.pursuer_invalid,
        )
        return select(over, carry, (moved, joined)), None

    episode, made = period(episode, None)
    if task.decision_steps > 1:
        (episode, made), _ = jax.lax.scan(another, (episode, made), None, length=task.decision_steps - 1)
    count = made.periods.astype(made.reward.dtype)
    return episode, eqx.tree_at(
        lambda made: (made.intervention, made.executed),
        made,
        (made.intervention / count, to_action(scenario, start, made.executed / count)),
    )


def seen(task: Task, episode: Episode) -> Float[Array, "*lanes observation"]:
    """The observation in single precision, worlds first, as learners take it."""
    return jnp.moveaxis(observe(task.scenario, episode.world), 0, -1).astype(jnp.float32)
