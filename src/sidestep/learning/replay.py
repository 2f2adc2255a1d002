"""Replay of world transitions. Batches can be sampled for any target and for proposed or executed actions."""

from __future__ import annotations

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int, PRNGKeyArray

from sidestep._arrays import Flag, Lanes, Scalar, real
from sidestep.learning.players import EVADING, Player
from sidestep.learning.td3 import Batch
from sidestep.learning.variation import FIXED, Variation
from sidestep.world import EvaderModel, Scenario, World
from sidestep.world.robots import closest_approach_straight


class Transition(eqx.Module):
    """One decision of the policy: the world before and after, and the motion between.

    The target has no effect on the motion. A transition is therefore valid for any other target (hindsight,
    Andrychowicz et al., NeurIPS 2017), with an exactly recomputed reward.

    **Attributes:** `path (n+1, 2)` the evader's positions (m) at the control instants, the last one repeated
    after the episode's end; `steps` control periods executed; `proposed (2,)` velocity of the policy and
    `executed (2,)` mean velocity (m/s, world axes); `correction` mean size of the shield's correction (m/s);
    `lost` whether capture or collision ended it; `drawn`, what was drawn for the episode's robots (see
    `Variation`). Where a pursuer learns, `proposed` are its wheel speeds (m/s).
    """

    world: World
    next_world: World
    path: Float[Array, "knots 2 *lanes"]
    steps: Int[Array, "*lanes"]
    proposed: Float[Array, "2 *lanes"]
    executed: Float[Array, "2 *lanes"]
    correction: Lanes
    lost: Bool[Array, "*lanes"]
    drawn: Float[Array, "varied *lanes"] = eqx.field(default_factory=lambda: jnp.zeros(0))


class Replay(eqx.Module):
    """Ring buffer of transitions. `written` counts all transitions so far; slot = count modulo capacity.

    The `worlds` of a training write one transition each per decision, so the next transition of an episode is
    `worlds` counts later. `episode` is the episode of each slot, and `episode_last[e mod len]` the count of
    the newest transition of episode e, so that a later transition of the same episode is found by one
    look-up. World i of n numbers its episodes i, n + i, 2n + i and so on.
    """

    transitions: Transition
    episode: Int[Array, "capacity"]
    episode_last: Int[Array, "episodes"]
    written: Int[Array, ""]
    worlds: int = eqx.field(static=True, default=1)

    @property
    def capacity(self) -> int:
        return self.episode.shape[0]

    @property
    def size(self) -> Int[Array, ""]:
        """Number of transitions that can be sampled."""
        return jnp.minimum(self.written, self.capacity)

    @classmethod
    def init(cls, example: Transition, capacity: int, worlds: int = 1) -> Replay:
        """An empty ring for transitions shaped like `example`, of one world; `capacity` is rounded up to a
        multiple of `worlds`."""
        capacity += -capacity % worlds
        return cls(
            transitions=jax.tree.map(lambda leaf: jnp.zeros((capacity, *leaf.shape), leaf.dtype), example),
            episode=jnp.full((capacity,), -1, int),
            episode_last=jnp.zeros((capacity,), int),
            written=jnp.zeros((), int),
            worlds=worlds,
        )

    def add(self, transition: Transition, episode: Int[Array, "*lanes"], active: Flag) -> Replay:
        """The ring with one more transition of each world; unchanged unless `active`.

        **Arguments:** `transition` and `episode`, how many episodes have ended in its world, of one world or
        of all in lanes.

        An inactive write goes out of bounds and is dropped: a conditional would copy the whole ring under
        `vmap`.
        """
        world, count = jnp.zeros_like(episode), self.written
        if episode.ndim:
            world = jnp.arange(self.worlds, dtype=episode.dtype)
            transition = jax.tree.map(lambda leaf: jnp.moveaxis(leaf, -1, 0), transition)
            count = count + world
        episode = episode * self.worlds + world
        slot = jnp.where(active, count % self.capacity, self.capacity)
        last_slot = jnp.where(active, episode % self.capacity, self.capacity)
        return Replay(
            transitions=jax.tree.map(
                lambda ring, leaf: ring.at[slot].set(leaf, mode="drop"), self.transitions, transition
            ),
            episode=self.episode.at[slot].set(episode, mode="drop"),
            episode_last=self.episode_last.at[last_slot].set(count, mode="drop"),
            written=self.written + self.worlds * active.astype(self.written.dtype),
            worlds=self.worlds,
        )


def reward_along(
    scenario: Scenario, transition: Transition, target: Float[Array, "2"], time_cost: Scalar
) -> tuple[Scalar, Bool[Array, ""]]:
    """Sum of the paper's reward over a decision for the given target (m), less `time_cost` (1/s) times the
    time driven until it is reached, and whether the episode terminates.

    The evader moves straight between control instants, so the least distance to the target is exact. In its
    last period a lost episode gets no bonus for reaching the target.
    """
    knots = transition.path
    count = knots.shape[0] - 1
    index = jnp.arange(count)
    ran = index < transition.steps
    nearest = jax.vmap(closest_approach_straight, in_axes=(0, 0, None))(
        knots[:-1] - target, knots[1:] - knots[:-1], real(1.0)
    )
    is_last_of_lost = transition.lost & (index == transition.steps - 1)
    touches = ran & (nearest <= scenario.reach_distance) & ~is_last_of_lost
    reached = jnp.any(touches)
    first = jnp.where(reached, jnp.argmax(touches), count)
    offset = knots[1:] - target
    distance = jnp.sqrt(jnp.sum(offset**2, axis=-1))
    cost = -scenario.distance_cost * jnp.sum(jnp.where(ran & (index < first), distance, 0.0))
    cost -= time_cost * jnp.sum(jnp.where(ran & (index <= first), scenario.control_period, 0.0))
    return cost + jnp.where(reached, scenario.reach_reward, 0.0), reached | transition.lost


def _reflect(vectors: Float[Array, "... 2"]) -> Float[Array, "... 2"]:
    return vectors * jnp.array([1.0, -1.0], vectors.dtype)


def mirror_world(world: World, model: EvaderModel | None = None) -> World:
    """The world reflected at its x axis: left and right swap, headings change sign. `model` mirrors the
    evader's state; without a model it is unchanged.

    The robots' motion is symmetric, so the mirror image of a transition is a valid transition.
    """
    state = world.evader_state
    mirrored = None if model is None or state is None else model.mirrored(state)
    obstacles = world.obstacles * jnp.array([1.0, -1.0, 1.0, -1.0], world.obstacles.dtype)
    return World(
        evader=_reflect(world.evader),
        pursuers=world.pursuers * jnp.array([1.0, -1.0, -1.0], world.pursuers.dtype),
        obstacles=obstacles,
        target=_reflect(world.target),
        time=world.time,
        evader_velocity=_reflect(world.evader_velocity),
        wheel_speeds=world.wheel_speeds[..., ::-1],
        evader_state=state if mirrored is None else mirrored,
    )


def _has_mirror_images(model: EvaderModel | None, state: Float[Array, "batch s"] | None) -> bool:
    if model is None or state is None:
        return True
    return eqx.filter_eval_shape(model.mirrored, state[0]) is not None


def sample(
    scenario: Scenario,
    replay: Replay,
    key: PRNGKeyArray,
    batch_size: int,
    *,
    hindsight: Float[Array, ""],
    mirror: Float[Array, ""],
    executed_action: bool,
    correction_penalty: Float[Array, ""],
    time_cost: Float[Array, ""],
    reward_scale: Float[Array, ""],
    player: Player = EVADING,
    variation: Variation = FIXED,
) -> tuple[Batch, World, World, Float[Array, "batch varied"]]:
    """A batch of uniformly sampled transitions, a share `hindsight` of them with a position reached later as
    target.

    The later position is uniform over the rest of the same episode (the "future" strategy). The action is the
    proposed or the executed velocity in the policy's axes *for that target*. The reward is `reward_scale`
    times the sum (less the `time_cost`, see `reward_along`) less `correction_penalty` times the mean
    correction (as a share of v_e), all of it as the `player` sees it.

    **Returns** the batch, the worlds before and after its actions, with the sampled targets and mirrored
    like the batch, so that a shield can be evaluated in them, and what was drawn for their robots.
    """
    index_key, later_key, choice_key, knot_key, mirror_key = jax.random.split(key, 5)
    # Slots count back from the newest, so that sampling is uniform over the stored transitions.
    back = jax.random.randint(index_key, (batch_size,), 1, replay.size + 1)
    count = replay.written - back
    slot = count % replay.capacity
    picked = jax.tree.map(lambda leaf: leaf[slot], replay.transitions)

    last = replay.episode_last[replay.episode[slot] % replay.capacity]
    span = ((last - count) // replay.worlds + 1).astype(reward_scale.dtype)
    ahead = jnp.floor(jax.random.uniform(later_key, (batch_size,), dtype=float) * span).astype(count.dtype)
    later = (jnp.minimum(count + ahead * replay.worlds, last)) % replay.capacity
    # A random control instant of the later decision; the last one is always valid.
    knots = replay.transitions.path[later]
    places = jnp.take_along_axis(
        knots,
        jax.random.randint(knot_key, (batch_size,), 1, replay.transitions.steps[later] + 1)[:, None, None],
        axis=1,
    )[:, 0]
    relabel = jax.random.uniform(choice_key, (batch_size,), dtype=float) < hindsight
    target = jnp.where(relabel[:, None], places, picked.world.target)

    def with_target(world: World) -> World:
        return eqx.tree_at(lambda w: w.target, world, target)

    def rewarded(transition: Transition, target: Float[Array, "2"]) -> tuple[Scalar, Bool[Array, ""]]:
        mine = variation.scenario(scenario, transition.drawn)
        reward, terminated = reward_along(mine, transition, target, time_cost)
        reward -= correction_penalty * transition.correction / mine.evader_speed
        return player.reward(mine, reward, transition.lost.astype(reward.dtype)), terminated

    reward, terminated = jax.vmap(rewarded)(picked, target)
    model = scenario.evader_model
    share = mirror if _has_mirror_images(model, picked.world.evader_state) else 0.0
    flip = jax.random.uniform(mirror_key, (batch_size,), dtype=float) < share
    command = picked.executed if executed_action else picked.proposed
    command = jnp.where(flip[:, None], player.mirrored(command), command)
    world, next_world = (
        jax.tree.map(
            lambda mirrored, seen: jnp.where(jnp.expand_dims(flip, range(1, seen.ndim)), mirrored, seen),
            jax.vmap(lambda one: mirror_world(one, model))(world),
            world,
        )
        for world in (with_target(picked.world), with_target(picked.next_world))
    )

    def seen(world: World, drawn: Float[Array, "varied"]) -> Float[Array, "observation"]:
        return player.observe(variation.scenario(scenario, drawn), world)

    def acted(world: World, command: Float[Array, "2"], drawn: Float[Array, "varied"]) -> Float[Array, "2"]:
        return player.action(variation.scenario(scenario, drawn), world, command)

    drawn = picked.drawn
    batch = Batch(
        observation=jax.vmap(seen)(world, drawn),
        action=jax.vmap(acted)(world, command, drawn),
        reward=reward_scale * reward,
        next_observation=jax.vmap(seen)(next_world, drawn),
        terminated=terminated.astype(reward.dtype),
    )
    return batch, world, next_world, drawn
