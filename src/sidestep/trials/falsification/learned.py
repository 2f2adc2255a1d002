"""A pursuer that TD3 trains to capture the evader behind its shield."""

from __future__ import annotations

from typing import Any, final

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int, PRNGKeyArray

from sidestep._arrays import Scalar, norm, real, select
from sidestep.learning import TD3, Batch, Learner, update
from sidestep.loop.episode import ask
from sidestep.loop.step import CAPTURED, COLLIDED
from sidestep.pursuit import Pursuer
from sidestep.trials.falsification.attackers import escape_margin
from sidestep.trials.falsification.chases import Chase, Target, begin, one_period
from sidestep.world import Scenario, World
from sidestep.world.capture_geometry import capture_set_distance, to_pursuer_frame

OBSERVATIONS = 16
_BONUS, _PER_METRE, _FAR = 10.0, 10.0, 1.0


class PursuerTraining(eqx.Module):
    """Options of the training: `chases` run at once, and the pursuer decides every `decision_steps`
    periods."""

    algorithm: TD3
    chases: int = eqx.field(static=True, default=32)
    decisions: int = eqx.field(static=True, default=100)
    decision_steps: int = eqx.field(static=True, default=4)
    updates: int = eqx.field(static=True, default=4)
    batch_size: int = eqx.field(static=True, default=256)
    capacity: int = eqx.field(static=True, default=100_000)


class Ring(eqx.Module):
    """A ring buffer of transitions; `written` counts all transitions so far."""

    rows: Batch
    written: Int[Array, ""]


class TrainingState(eqx.Module):
    """The state between rounds of training."""

    learner: Learner
    ring: Ring


def untrained(training: PursuerTraining, key: PRNGKeyArray) -> TrainingState:
    """The state of an untrained pursuer."""
    zeros = lambda *shape: jnp.zeros((training.capacity, *shape), real(0.0).dtype)  # noqa: E731
    rows = Batch(zeros(OBSERVATIONS), zeros(2), zeros(), zeros(OBSERVATIONS), zeros())
    learner = training.algorithm.init(OBSERVATIONS, 2, key)
    return TrainingState(learner, Ring(rows, jnp.zeros((), jnp.int32)))


def attacker_observation(scenario: Scenario, world: World) -> Float[Array, "observation"]:
    """The observation of `world.pursuer` in its frame, scaled to about [-1, 1].

    The evader's position on two scales, its margin h on three, its last velocity; positions of the target and
    of the nearest obstacle relative to the evader, and that obstacle's velocity and clearance.
    """
    pose = world.pursuer
    z = to_pursuer_frame(world.evader, pose)
    h = capture_set_distance(z, scenario.usable_angle, scenario.capture_distance)
    turned = lambda vector: to_pursuer_frame(pose[:2] + vector, pose)  # noqa: E731
    squash = lambda vector: vector / (0.3 + norm(vector))  # noqa: E731
    near = jnp.stack([jnp.exp(-jnp.maximum(h, 0.0) / scale) for scale in (0.1, 0.003)])
    obstacle, drift = jnp.zeros(2, z.dtype), jnp.zeros(2, z.dtype)
    clearance = real(_FAR)
    if scenario.obstacle_count > 0:
        offsets = world.obstacles[:, :2] - world.evader
        nearest = jnp.argmin(norm(offsets))
        obstacle, drift = offsets[nearest], world.obstacles[nearest, 2:]
        clearance = norm(obstacle) - scenario.collision_distance
    parts = [
        jnp.tanh(z / scenario.capture_distance),
        squash(z),
        near,
        turned(world.evader_velocity) / scenario.evader_speed,
        squash(turned(world.target - world.evader)),
        squash(turned(obstacle)),
        turned(drift) / scenario.evader_speed,
        jnp.exp(-jnp.maximum(clearance, 0.0) / 0.1)[None],
        jnp.tanh(h / 0.01)[None],
    ]
    return jnp.concatenate(parts)


@final
class _CommandedPursuers(Pursuer):
    """Pursuers that drive given wheel speeds (m/s)."""

    wheels: Float[Array, "*batch m 2"]

    def steer_all(self, scenario: Scenario, world: World) -> Float[Array, "m 2"]:
        return self.wheels

    def steer(self, scenario: Scenario, world: World, key: PRNGKeyArray) -> Float[Array, "2"]:
        return self.wheels[0]


def _distance_to_goal(scenario: Scenario, world: World, goal: str) -> Scalar:
    """The evader's margin or clearance (m), according to the goal; the pursuer's reward is its decrease."""
    margin = jnp.minimum(escape_margin(scenario, world), _FAR)
    gaps = norm(world.obstacles[:, :2] - world.evader) - scenario.collision_distance
    gap = jnp.min(gaps, initial=_FAR)
    return margin if goal == "capture" else gap if goal == "collision" else jnp.minimum(margin, gap)


@eqx.filter_jit
def train(
    target: Target,
    training: PursuerTraining,
    state: TrainingState,
    worlds: World,
    goal: str,
    key: PRNGKeyArray,
) -> tuple[TrainingState, Chase, Float[Array, "chases t m 2"]]:
    """One chase from each start world, with training after every decision.

    Reward: the decrease of `_distance_to_goal`, and a bonus when the goal is reached. The exploration noise
    of the chases has standard deviations from 0 (the first chase) to 0.6.

    **Returns** the training state, the chases at their ends and the commanded wheel speeds (m/s).
    """
    scenario, count = target.scenario, worlds.time.shape[0]
    m, steps = scenario.pursuer_count, training.decision_steps
    deviations = jnp.linspace(0.0, 0.6, count, dtype=worlds.time.dtype)

    def observe_all(world: World) -> Float[Array, "m observation"]:
        return jnp.stack([attacker_observation(scenario, world.seen_by(index)) for index in range(m)])

    def drive(chase: Chase, wheels: Array, key: PRNGKeyArray) -> tuple[Chase, Float[Array, "t m 2"]]:
        task = target.task(_CommandedPursuers(wheels))

        def period(chase: Chase, key: PRNGKeyArray) -> tuple[Chase, Array]:
            deciding = chase.tally.steps % task.decision_steps == 0
            asked = select(deciding, ask(task, chase.episode), chase.episode)
            return one_period(task, Chase(asked, chase.margin), key)

        return jax.lax.scan(period, chase, jax.random.split(key, steps))

    def decision(
        carry: tuple[TrainingState, Chase], key: PRNGKeyArray
    ) -> tuple[tuple[TrainingState, Chase], Array]:
        state, chases = carry
        noise_key, drive_key, learn_key = jax.random.split(key, 3)
        seen = jax.vmap(observe_all)(chases.world)
        actions = state.learner.actor(seen.reshape(-1, OBSERVATIONS)).reshape(count, m, 2)
        noise = deviations[:, None, None] * jax.random.normal(noise_key, actions.shape, dtype=actions.dtype)
        actions = jnp.clip(actions + noise, -1.0, 1.0)
        moved, wheels = jax.vmap(drive)(
            chases, scenario.pursuer_speed * actions, jax.random.split(drive_key, count)
        )
        distance = jax.vmap(lambda world: _distance_to_goal(scenario, world, goal))
        bonus = jnp.where(_goal_reached(moved, goal), _BONUS, 0.0)
        reward = _PER_METRE * (distance(chases.world) - distance(moved.world)) + bonus
        over = (~moved.running).astype(reward.dtype)
        rows = Batch(seen[:, 0], actions[:, 0], reward, jax.vmap(observe_all)(moved.world)[:, 0], over)
        ring = _append(state.ring, rows, chases.running)
        learner = _updated(training, state.learner, ring, learn_key)
        return (TrainingState(learner, ring), moved), wheels

    chases = jax.vmap(lambda world: begin(target, world))(worlds)
    (state, chases), wheels = jax.lax.scan(
        decision, (state, chases), jax.random.split(key, training.decisions)
    )
    # (decisions, chases, steps, m, 2) to (chases, periods, m, 2)
    return state, chases, jnp.swapaxes(wheels, 0, 1).reshape(count, -1, m, 2)


def _goal_reached(chases: Chase, goal: str) -> Bool[Array, "chases"]:
    captured, collided = chases.outcome == CAPTURED, chases.outcome == COLLIDED
    return captured if goal == "capture" else collided if goal == "collision" else captured | collided


def _append(ring: Ring, rows: Batch, running: Bool[Array, "chases"]) -> Ring:
    capacity = ring.rows.reward.shape[0]
    place = (ring.written + jnp.cumsum(running) - 1) % capacity
    place = jnp.where(running, place, capacity)  # out of range, and so dropped
    kept = jax.tree.map(lambda whole, row: whole.at[place].set(row, mode="drop"), ring.rows, rows)
    return Ring(kept, ring.written + jnp.sum(running).astype(ring.written.dtype))


def _updated(training: PursuerTraining, learner: Learner, ring: Ring, key: PRNGKeyArray) -> Learner:
    filled = jnp.minimum(ring.written, ring.rows.reward.shape[0])

    def one(learner: Learner, key: PRNGKeyArray) -> tuple[Learner, Any]:
        draw_key, update_key = jax.random.split(key)
        places = jax.random.randint(draw_key, (training.batch_size,), 0, jnp.maximum(filled, 1))
        batch = jax.tree.map(lambda whole: whole[places], ring.rows)
        return update(training.algorithm, learner, batch, update_key)[0], None

    def update_all(learner: Learner) -> Learner:
        return jax.lax.scan(one, learner, jax.random.split(key, training.updates))[0]

    return jax.lax.cond(filled >= training.batch_size, update_all, lambda learner: learner, learner)
