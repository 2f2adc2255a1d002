"""What the evader perceives and how its policy speaks: the frame, the observation, the action.

Observation, for m pursuers and k obstacles, in the axes of `scenario.frame`. With `"target"` the x axis
points from the evader at the target, so a rotated world is the same problem; with `"world"` the axes are
the world's. Entries are scaled to about [-1, 1]; p/(1 + |p|) squashes a vector p in metres.

| entries | meaning |
|---|---|
| 2 | tanh(d/2), exp(-d/0.25): far and near view of the distance d to the target (m) |
| 2 | direction of the target (cos, sin); only with `frame="world"` |
| 5 per pursuer | position squashed (2), heading (cos, sin), exp(-c/0.2) for its clearance c (m) |
| 5 per obstacle | position squashed (2), velocity / v_e (2), exp(-c/0.2) for its clearance c (m) |

Pursuers and obstacles come nearest first, so their order in the world does not matter. A policy answers
with an action in [-1, 1]^2 in the same axes; the velocity is v_e times the action, its norm cut to one.
"""

import jax.numpy as jnp
from jaxtyping import Array, Float

from sidestep._arrays import AnyArray, norm, real
from sidestep.world.robots import limit_speed
from sidestep.world.scenario import Scenario
from sidestep.world.state import World

_NEAR_TARGET = 0.25
_NEAR_ROBOT = 0.2


def observation_size(scenario: Scenario) -> int:
    """Number of entries of `observe`: 2 (4 with `frame="world"`) + 5 m + 5 k."""
    return (2 if scenario.frame == "target" else 4) + 5 * (scenario.pursuer_count + scenario.obstacle_count)


def observation_names(scenario: Scenario) -> list[str]:
    """One name per observation entry, in order."""
    names = ["target_far", "target_near"]
    if scenario.frame == "world":
        names += ["target_cos", "target_sin"]
    for i in range(scenario.pursuer_count):
        names += [f"pursuer{i}_{part}" for part in ("x", "y", "cos", "sin", "near")]
    for i in range(scenario.obstacle_count):
        names += [f"obstacle{i}_{part}" for part in ("x", "y", "vx", "vy", "near")]
    return names


def frame_axes(
    scenario: Scenario, evader: Float[AnyArray, "2"], target: Float[AnyArray, "2"]
) -> Float[Array, "2 2"]:
    """Rows are the unit axes of the policy's frame in world coordinates; the world's own at the target."""
    dtype = real(0.0).dtype
    if scenario.frame == "world":
        return jnp.eye(2, dtype=dtype)
    offset = target - evader
    squared = jnp.sum(offset**2)
    apart = squared > 0.0
    ahead = jnp.where(
        apart,
        offset / jnp.sqrt(jnp.where(apart, squared, 1.0)),
        jnp.array([1.0, 0.0], dtype),
    )
    return jnp.stack([ahead, jnp.stack([-ahead[1], ahead[0]])])


def observe(scenario: Scenario, world: World) -> Float[Array, "observation"]:
    """The observation of one world; see the table at the top of this module.

    **Returns** `(observation_size(scenario),)`. `jax.vmap` it over worlds.
    """
    axes = frame_axes(scenario, world.evader, world.target)
    distance = norm(world.target - world.evader)
    parts = [jnp.stack([jnp.tanh(distance / 2.0), jnp.exp(-distance / _NEAR_TARGET)])]
    if scenario.frame == "world":
        parts.append(
            jnp.where(
                distance > 0.0, (world.target - world.evader) / jnp.where(distance > 0.0, distance, 1.0), 0.0
            )
        )

    def block(
        places: Float[Array, "n 2"], extra: Float[Array, "n 2"], contact: Float[Array, ""]
    ) -> Float[Array, "entries"]:
        offsets = places - world.evader
        distances = norm(offsets)
        squashed = (offsets / (1.0 + distances[:, None])) @ axes.T
        near = jnp.exp(-jnp.maximum(distances - contact, 0.0) / _NEAR_ROBOT)
        entries = jnp.concatenate([squashed, extra @ axes.T, near[:, None]], axis=-1)
        if len(places) > 1:
            entries = entries[jnp.argsort(distances)]
        return entries.reshape(-1)

    headings = jnp.stack([jnp.cos(world.pursuers[:, 2]), jnp.sin(world.pursuers[:, 2])], axis=-1)
    parts.append(block(world.pursuers[:, :2], headings, scenario.capture_distance))
    drift = world.obstacles[:, 2:] / scenario.evader_speed
    parts.append(block(world.obstacles[:, :2], drift, scenario.collision_distance))
    return jnp.concatenate(parts)


def to_velocity(scenario: Scenario, world: World, action: Float[AnyArray, "2"]) -> Float[Array, "2"]:
    """The nominal velocity (m/s, world axes) that a policy's action in [-1, 1]^2 asks for."""
    unit = limit_speed(action, real(1.0))
    return scenario.evader_speed * (unit @ frame_axes(scenario, world.evader, world.target))


def to_action(scenario: Scenario, world: World, velocity: Float[AnyArray, "2"]) -> Float[Array, "2"]:
    """The policy action that asks for `velocity` (m/s, world axes): the inverse of `to_velocity`."""
    return frame_axes(scenario, world.evader, world.target) @ (velocity / scenario.evader_speed)


def goal_seeking(observation: Float[AnyArray, "observation"]) -> Float[Array, "2"]:
    """The untrained policy: full speed straight at the target.

    For scenarios with `frame="target"`, where the target lies along x by construction; with
    `frame="world"` use `goal_seeking_world`.
    """
    return jnp.zeros_like(real(observation)[:2]).at[0].set(1.0)


def goal_seeking_world(observation: Float[AnyArray, "observation"]) -> Float[Array, "2"]:
    """`goal_seeking` for scenarios with `frame="world"`: the target's direction is entries 2 and 3."""
    return real(observation)[2:4]
