"""A pursuer that learns to break the shield: TD3 on chases of the evader as it is, shield and all."""

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


class Lessons(eqx.Module):
    """How the pursuer learns: it decides every `decision_steps` periods, in `chases` at once."""

    algorithm: TD3
    chases: int = eqx.field(static=True, default=32)
    decisions: int = eqx.field(static=True, default=100)
    decision_steps: int = eqx.field(static=True, default=4)
    updates: int = eqx.field(static=True, default=4)
    batch_size: int = eqx.field(static=True, default=256)
    capacity: int = eqx.field(static=True, default=100_000)


class Ring(eqx.Module):
    """The last transitions; `written` counts all there ever were."""

    rows: Batch
    written: Int[Array, ""]


class Pupil(eqx.Module):
    """What is kept between lessons."""

    learner: Learner
    ring: Ring


def new_pupil(lessons: Lessons, key: PRNGKeyArray) -> Pupil:
    """A pursuer that has learned nothing."""
    zeros = lambda *shape: jnp.zeros((lessons.capacity, *shape), real(0.0).dtype)  # noqa: E731
    rows = Batch(zeros(OBSERVATIONS), zeros(2), zeros(), zeros(OBSERVATIONS), zeros())
    learner = lessons.algorithm.init(OBSERVATIONS, 2, key)
    return Pupil(learner, Ring(rows, jnp.zeros((), jnp.int32)))


def look(scenario: Scenario, world: World) -> Float[Array, "observation"]:
    """What a pursuer sees, in its own frame, scaled to about [-1, 1].

    The evader's place, near and far, its margin h near and nearer still, its last velocity; the target and
    the nearest obstacle as seen from the evader, and that obstacle's drift and clearance.
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
class _Held(Pursuer):
    """Wheel speeds of all pursuers decided before, m/s; those of the first for whoever asks."""

    wheels: Float[Array, "*batch m 2"]

    def steer_all(self, scenario: Scenario, world: World) -> Float[Array, "m 2"]:
        return self.wheels

    def steer(self, scenario: Scenario, world: World, key: PRNGKeyArray) -> Float[Array, "2"]:
        return self.wheels[0]


def _promise(scenario: Scenario, world: World, goal: str) -> Scalar:
    """How near the evader is to being lost, m, from below: what the pursuer is paid for lowering."""
    margin = jnp.minimum(escape_margin(scenario, world), _FAR)
    gaps = norm(world.obstacles[:, :2] - world.evader) - scenario.collision_distance
    gap = jnp.min(gaps, initial=_FAR)
    return margin if goal == "capture" else gap if goal == "collision" else jnp.minimum(margin, gap)


@eqx.filter_jit
def lesson(
    target: Target, lessons: Lessons, pupil: Pupil, worlds: World, goal: str, key: PRNGKeyArray
) -> tuple[Pupil, Chase, Float[Array, "chases t m 2"]]:
    """One chase from each start world, learning as it goes.

    Reward: the decrease of what `_promise` measures, and a bonus for the loss. Chase i explores with noise of
    standard deviation up to 0.6, the first with none.

    **Returns** what was learned, the chases at their ends and the wheel speeds (m/s) driven.
    """
    scenario, count = target.scenario, worlds.time.shape[0]
    m, steps = scenario.pursuer_count, lessons.decision_steps
    loud = jnp.linspace(0.0, 0.6, count, dtype=worlds.time.dtype)

    def sees(world: World) -> Float[Array, "m observation"]:
        return jnp.stack([look(scenario, world.seen_by(index)) for index in range(m)])

    def drive(chase: Chase, wheels: Array, key: PRNGKeyArray) -> tuple[Chase, Float[Array, "t m 2"]]:
        task = target.task(_Held(wheels))

        def period(chase: Chase, key: PRNGKeyArray) -> tuple[Chase, Array]:
            deciding = chase.tally.steps % task.decision_steps == 0
            asked = select(deciding, ask(task, chase.episode), chase.episode)
            return one_period(task, Chase(asked, chase.margin), key)

        return jax.lax.scan(period, chase, jax.random.split(key, steps))

    def decision(carry: tuple[Pupil, Chase], key: PRNGKeyArray) -> tuple[tuple[Pupil, Chase], Array]:
        pupil, chases = carry
        noise_key, drive_key, learn_key = jax.random.split(key, 3)
        seen = jax.vmap(sees)(chases.world)
        acted = pupil.learner.actor(seen.reshape(-1, OBSERVATIONS)).reshape(count, m, 2)
        noise = loud[:, None, None] * jax.random.normal(noise_key, acted.shape, dtype=acted.dtype)
        acted = jnp.clip(acted + noise, -1.0, 1.0)
        moved, wheels = jax.vmap(drive)(
            chases, scenario.pursuer_speed * acted, jax.random.split(drive_key, count)
        )
        promise = jax.vmap(lambda world: _promise(scenario, world, goal))
        lost = _lost(moved, goal)
        reward = _PER_METRE * (promise(chases.world) - promise(moved.world)) + jnp.where(lost, _BONUS, 0.0)
        over = (~moved.running).astype(reward.dtype)
        rows = Batch(seen[:, 0], acted[:, 0], reward, jax.vmap(sees)(moved.world)[:, 0], over)
        ring = _remember(pupil.ring, rows, chases.running)
        learner = _study(lessons, pupil.learner, ring, learn_key)
        return (Pupil(learner, ring), moved), wheels

    chases = jax.vmap(lambda world: begin(target, world))(worlds)
    (pupil, chases), wheels = jax.lax.scan(
        decision, (pupil, chases), jax.random.split(key, lessons.decisions)
    )
    # (decisions, chases, steps, m, 2) to (chases, periods, m, 2)
    return pupil, chases, jnp.swapaxes(wheels, 0, 1).reshape(count, -1, m, 2)


def _lost(chases: Chase, goal: str) -> Bool[Array, "chases"]:
    captured, collided = chases.outcome == CAPTURED, chases.outcome == COLLIDED
    return captured if goal == "capture" else collided if goal == "collision" else captured | collided


def _remember(ring: Ring, rows: Batch, running: Bool[Array, "chases"]) -> Ring:
    capacity = ring.rows.reward.shape[0]
    place = (ring.written + jnp.cumsum(running) - 1) % capacity
    place = jnp.where(running, place, capacity)  # beyond the end, and dropped there
    kept = jax.tree.map(lambda whole, row: whole.at[place].set(row, mode="drop"), ring.rows, rows)
    return Ring(kept, ring.written + jnp.sum(running).astype(ring.written.dtype))


def _study(lessons: Lessons, learner: Learner, ring: Ring, key: PRNGKeyArray) -> Learner:
    filled = jnp.minimum(ring.written, ring.rows.reward.shape[0])

    def one(learner: Learner, key: PRNGKeyArray) -> tuple[Learner, Any]:
        draw_key, update_key = jax.random.split(key)
        places = jax.random.randint(draw_key, (lessons.batch_size,), 0, jnp.maximum(filled, 1))
        batch = jax.tree.map(lambda whole: whole[places], ring.rows)
        return update(lessons.algorithm, learner, batch, update_key)[0], None

    def study(learner: Learner) -> Learner:
        return jax.lax.scan(one, learner, jax.random.split(key, lessons.updates))[0]

    return jax.lax.cond(filled >= lessons.batch_size, study, lambda learner: learner, learner)
