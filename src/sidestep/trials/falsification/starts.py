"""Start worlds of attacks: drawn by the scenario, at the edge of the capture set, or searched."""

from __future__ import annotations

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Key, PRNGKeyArray

from sidestep._arrays import AnyArray, Flag, norm, real, select
from sidestep.pursuit.steering import bearing_of
from sidestep.world import Scenario, World
from sidestep.world.capture_geometry import capture_set_distance, to_pursuer_frame

LEAST_MARGIN = 1e-5
"""Least distance (m) of searched starts from the capture set."""
EDGE = 1e-3
"""Largest margin h (m) of starts at the edge."""
_CLEAR = 1e-3
_NEAR_AXIS = 0.1
_WITHIN_EDGE = 3


def admissible(scenario: Scenario, world: World) -> Flag:
    """Whether an episode may start here: outside the capture set and the obstacles, the target not reached.

    As `Scenario.accepts`, but without the separations of random starts.
    """
    free = eqx.tree_at(
        lambda s: (s.initial_separation, s.obstacle_separation, s.target_separation),
        scenario,
        (real(0.0),) * 3,
    )
    return free.accepts(world)


def starts_are_free(scenario: Scenario) -> bool:
    """Whether the scenario fixes no part of the start, so that an attack may choose all of it."""
    starts = (
        scenario.evader_start, scenario.pursuer_starts, scenario.obstacle_starts, scenario.target_start,
    )  # fmt: skip
    return all(start is None for start in starts)


def encode(scenario: Scenario, world: World) -> Float[Array, "n"]:
    """A start world as a vector, relative to the evader's position.

    Per pursuer: margin h (m), the evader's bearing in its frame (rad), its heading (rad). Target: angle (rad)
    and distance (m). Per obstacle: angle (rad), distance (m) and direction of its velocity (rad).
    """

    def pursuer(pose: Array) -> Array:
        z = to_pursuer_frame(world.evader, pose)
        h = capture_set_distance(z, scenario.usable_angle, scenario.capture_distance)
        return jnp.stack([h, bearing_of(z), pose[2]])

    def obstacle(robot: Array) -> Array:
        return jnp.stack([*_polar(robot[:2] - world.evader), bearing_of(robot[2:])])

    parts = [jax.vmap(pursuer)(world.pursuers).reshape(-1), _polar(world.target - world.evader)]
    return jnp.concatenate([*parts, jax.vmap(obstacle)(world.obstacles).reshape(-1)])


def decode(scenario: Scenario, base: World, vector: Float[AnyArray, "n"]) -> World:
    """The start world of a vector of `encode`, with the evader of `base`. Pursuers keep the least
    distance."""
    m, k = scenario.pursuer_count, scenario.obstacle_count
    vector = real(vector)

    def pursuer(entry: Array) -> Array:
        h, bearing, heading = jnp.maximum(entry[0], LEAST_MARGIN), entry[1], entry[2]
        # Solves h = r cos((S - beta')+) - l for the range r.
        off_axis = jnp.arcsin(jnp.clip(jnp.abs(jnp.sin(bearing)), 0.0, 1.0))
        slant = jnp.maximum(scenario.usable_angle - off_axis, 0.0)
        r = (scenario.capture_distance + h) / jnp.cos(slant)
        away = heading + bearing
        return jnp.concatenate([base.evader - r * jnp.stack([jnp.cos(away), jnp.sin(away)]), heading[None]])

    def obstacle(entry: Array, robot: Array) -> Array:
        distance = jnp.maximum(entry[1], scenario.collision_distance + _CLEAR)
        speed = norm(robot[2:])
        drift = speed * jnp.stack([jnp.cos(entry[2]), jnp.sin(entry[2])])
        return jnp.concatenate([base.evader + _cartesian(entry[0], distance), drift])

    split = 3 * m
    target = vector[split : split + 2]
    distance = jnp.maximum(target[1], scenario.reach_distance + _CLEAR)
    return World(
        evader=base.evader,
        pursuers=jax.vmap(pursuer)(vector[:split].reshape(m, 3)),
        obstacles=jax.vmap(obstacle)(vector[split + 2 :].reshape(k, 3), base.obstacles),
        target=base.evader + _cartesian(target[0], distance),
    )


def freedom(scenario: Scenario, *, edge: bool) -> Float[np.ndarray, "n"]:
    """The initial spread (standard deviation) of a search over each entry of `encode`; 0 for fixed entries.

    With `edge` the margin is searched within 1 mm and the bearing nearby. If the scenario fixes any part of
    the start, all entries are fixed.
    """
    m, k = scenario.pursuer_count, scenario.obstacle_count
    pursuer = np.array([0.5 * EDGE, 0.5 * _NEAR_AXIS, 1.0] if edge else [0.2, 0.6, 1.5])
    target = np.array([1.5, 0.5])
    obstacle = np.array([1.5, 0.3, 1.5 if scenario.obstacle_directions == "random" else 0.0])
    if not starts_are_free(scenario):
        pursuer, target, obstacle = 0.0 * pursuer, 0.0 * target, 0.0 * obstacle
    return np.concatenate([np.tile(pursuer, m), target, np.tile(obstacle, k)])


def at_edge(scenario: Scenario, base: World, key: PRNGKeyArray) -> World:
    """A start with a margin h of at most 1 mm towards every pursuer.

    Half of them lie near the pursuer's axis, a quarter beside it, the rest at any bearing. All else is as in
    `base`, a start drawn by the scenario. If the scenario fixes any part of the start, `base` is returned.
    """
    if not starts_are_free(scenario):
        return base
    m = scenario.pursuer_count

    def draw(key: PRNGKeyArray) -> World:
        h_key, bearing_key, end_key, place_key = jax.random.split(key, 4)
        vector = encode(scenario, base)
        h = jax.random.uniform(h_key, (m,), dtype=float, minval=LEAST_MARGIN, maxval=EDGE)
        anywhere = jax.random.uniform(bearing_key, (m,), dtype=float, minval=-jnp.pi, maxval=jnp.pi)
        where = jax.random.uniform(place_key, (m,), dtype=float)
        middle = jnp.where(where < 0.5, 0.0, jnp.pi / 2.0)
        middle = middle + jnp.where(jax.random.bernoulli(end_key, shape=(m,)), jnp.pi, 0.0)
        bearing = jnp.where(where < 0.75, middle + _NEAR_AXIS / jnp.pi * anywhere, anywhere)
        places = 3 * jnp.arange(m)
        vector = vector.at[places].set(h).at[places + 1].set(bearing)
        return decode(scenario, base, vector)

    # Draw again while the start is inadmissible, as in an obstacle; `base` if none is found.
    worlds = jax.vmap(draw)(jax.random.split(key, _WITHIN_EDGE))
    good = jax.vmap(lambda world: admissible(scenario, world))(worlds)
    chosen = jax.tree.map(lambda leaf: leaf[jnp.argmax(good)], worlds)
    return jax.tree.map(lambda new, old: jnp.where(jnp.any(good), new, old), chosen, base)


@eqx.filter_jit
def draw_starts(scenario: Scenario, keys: Key[Array, "n"], edge: AnyArray) -> World:
    """One start per key; at the edge of the capture set where `edge` is set."""

    def draw(key: PRNGKeyArray, edge: Array) -> World:
        base_key, edge_key = jax.random.split(key)
        base = scenario.reset(base_key)
        return select(edge, at_edge(scenario, base, edge_key), base)

    return jax.vmap(draw)(keys, jnp.asarray(edge))


def _polar(offset: Float[Array, "2"]) -> Float[Array, "2"]:
    return jnp.stack([bearing_of(offset), norm(offset)])


def _cartesian(angle: Float[Array, ""], distance: Float[Array, ""]) -> Float[Array, "2"]:
    return distance * jnp.stack([jnp.cos(angle), jnp.sin(angle)])
