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
from sidestep.bridges.gym.task import Task as GymTask
from sidestep.loop.episode import Task, advance, continued, hold
from sidestep.loop.keys import episode_key, start_and_pursuit
from sidestep.loop.step import nominal_velocity
from sidestep.safety import Status, start_in_lanes
from sidestep.world import World, observe, to_action
from sidestep.world.robots import limit_speed


class EnvState(eqx.Module):
    """The state of an environment's episode between two decisions.

    **Attributes:** `world`; the shield's `memory`; the two `words` of the environment's random key; the
    `number` of the episode; the control `periods` since its start.
    """

    world: World
    memory: Any
    words: UInt32[Array, "2 *lanes"]
    number: Int[Array, "*lanes"]
    periods: Int[Array, "*lanes"]


class Decision(eqx.Module):
    """The result of one decision, over all control periods for which its action was held.

    **Attributes:** `reward` summed; the flags of `Events`; the worst `status`; `intervention` (m/s, mean);
    `proposed` and `executed` (mean) in the policy's units and axes; the least clearances (m); the number of
    `periods` simulated, and `pursuer_invalid`: those in which a pursuer's wheel speeds were not finite.
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


def begin(task: GymTask, words: UInt32[AnyArray, "2 *lanes"], number: Int[AnyArray, "*lanes"]) -> EnvState:
    """The start of episode `number` of an environment with these words of its random key."""
    lanes = number.ndim
    world = lane_by_lane(lambda *of: task.scenario.reset(_keys(*of)[0]), lanes, words, number)
    return begin_in(task, world, words, number)


def begin_in(
    task: GymTask, world: World, words: UInt32[AnyArray, "2 *lanes"], number: Int[AnyArray, "*lanes"]
) -> EnvState:
    """The start of the episode in a given world."""
    number = jnp.asarray(number, jnp.int32)
    return EnvState(
        world, start_in_lanes(task.shield, world), jnp.asarray(words), number, jnp.zeros_like(number)
    )


def decide(
    task: GymTask, episode: EnvState, action: Float[AnyArray, "2 *lanes"]
) -> tuple[EnvState, Decision]:
    """Hold an action in [-1, 1]^2 for `task.decision_steps` control periods, or until the episode ends.

    The nominal velocity is constant in world axes; the shield filters it in every period.
    """
    scenario, start = task.scenario, episode.world
    action = real(action)
    nominal, finite = nominal_velocity(scenario, start, action), jnp.all(jnp.isfinite(action), axis=0)
    # XLA removes these unless the pursuer draws random numbers.
    keys = lane_by_lane(lambda *of: _keys(*of)[1], start.lanes, episode.words, episode.number)
    run = Task(scenario, None, task.shield, task.pursuer)

    def period(carry: tuple[Any, ...], _: None) -> tuple[tuple[Any, ...], None]:
        going, *so_far = carry
        key = lane_by_lane(jax.random.fold_in, start.lanes, keys, episode.periods + going.tally.steps)
        moved, now = advance(run, going, key)
        events, result = now.events, now.result
        flags = (events.captured, events.collided, events.reached, events.timed_out)
        status, executed, _ = so_far
        more = [jnp.maximum(status, result.status), executed + result.action, flags]
        return (moved, *select(now.running, more, so_far)), None

    going = hold(continued(episode.world, episode.memory), nominal)
    none = jnp.zeros_like(going.running)
    begun = (going, jnp.full_like(going.outcome, Status.OK), jnp.zeros_like(nominal), (none,) * 4)
    (end, status, executed, flags), _ = jax.lax.scan(period, begun, None, length=task.decision_steps)
    tally = end.tally
    count = tally.steps.astype(tally.total_reward.dtype)
    moved = EnvState(end.world, end.memory, episode.words, episode.number, episode.periods + tally.steps)
    return moved, Decision(
        task.reward_scale * tally.total_reward,
        *flags,
        status=status,
        intervention=tally.correction / count,
        proposed=jnp.where(finite, limit_speed(action, real(1.0)), action),
        executed=to_action(scenario, start, executed / count),
        pursuer_clearance=tally.pursuer_clearance,
        obstacle_clearance=tally.obstacle_clearance,
        periods=tally.steps,
        pursuer_invalid=tally.pursuer_invalid,
    )


def seen(task: GymTask, episode: EnvState) -> Float[Array, "*lanes observation"]:
    """The observation in float32, with the axis of lanes first."""
    return jnp.moveaxis(observe(task.scenario, episode.world), 0, -1).astype(jnp.float32)
