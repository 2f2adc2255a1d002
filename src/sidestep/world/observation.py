"""The policy's frame, observation and action.

Observation, for m pursuers and k obstacles, in the axes of `scenario.frame`. With `"target"` the x axis
points from the evader to the target, so a rotated world gives the same observation; with `"world"` the axes
are the world's. Entries are scaled to about [-1, 1]; "squashed" means p/(1 + |p|) for a vector p in m.

| entries | meaning |
|---|---|
| 2 | tanh(d/2), exp(-d/0.25): far and near view of the distance d to the target (m) |
| 2 | direction of the target (cos, sin); only with `frame="world"` |
| 5 per pursuer | position squashed (2), heading (cos, sin), exp(-c/0.2) for its clearance c (m) |
| 2 more per pursuer | wheel speeds (left, right) of the last period / V; not with `observation="poses"` |
| 5 per obstacle | position squashed (2), velocity / v_e (2), exp(-c/0.2) for its clearance c (m) |
| 6 | v_e, V (in 0.2 m/s), b, l, d_oc (in 0.2 m), obstacle speed / v_e; only with `observation="robots"` |

With `observation="robots"` there are entries for five obstacles, the nearest ones, whatever the scenario's
number; those of obstacles that it lacks, or that are more than 10 m away, are 0. So one policy serves many
robots.

Pursuers and obstacles are sorted, nearest first, so their order in the world has no effect. The policy's
action is in [-1, 1]^2 in the same axes; the velocity is v_e times the action, its norm clipped to 1.
"""

import math
from collections.abc import Callable
from typing import Any

import jax.numpy as jnp
from jaxtyping import Array, Float

from sidestep._arrays import AnyArray, Lanes, Scalar, length, real, stack
from sidestep.world.robots import limit_speed
from sidestep.world.scenario import Scenario
from sidestep.world.state import World

FAR_TARGET, NEAR_TARGET, NEAR_ROBOT = 2.0, 0.25, 0.2
"""Scales (m) of the far and near view of the target, and of clearances."""
_SLOTS, _SEEN = 5, 10.0
"""Obstacles that are seen with `observation="robots"`, and from how near (m)."""
_SPEED, _SIZE = 0.2, 0.2
"""Scales of the robots' speeds (m/s) and sizes (m)."""


def observation_size(scenario: Scenario) -> int:
    """Number of entries of `observe`: 2 (4 with `frame="world"`) + 5 m + 5 k; 2 + 7 m + 5 k with
    `observation="motion"`; 2 + 7 m + 31 with `"robots"`."""
    return len(observation_names(scenario))


def observation_names(scenario: Scenario) -> list[str]:
    """One name per observation entry, in order."""
    names = ["target_far", "target_near"]
    if scenario.frame == "world":
        names += ["target_cos", "target_sin"]
    for i in range(scenario.pursuer_count):
        names += [f"pursuer{i}_{part}" for part in ("x", "y", "cos", "sin", "near")]
        if scenario.observation != "poses":
            names += [f"pursuer{i}_{wheel}" for wheel in ("left", "right")]
    robots = scenario.observation == "robots"
    for i in range(_SLOTS if robots else scenario.obstacle_count):
        names += [f"obstacle{i}_{part}" for part in ("x", "y", "vx", "vy", "near")]
    if robots:
        names += [
            "evader_speed", "pursuer_speed", "pursuer_half_axle", "capture_distance", "collision_distance",
            "obstacle_speed",
        ]  # fmt: skip
    return names


def frame_axes(
    scenario: Scenario, evader: Float[AnyArray, "2 *lanes"], target: Float[AnyArray, "2 *lanes"]
) -> Float[Array, "2 2 *lanes"]:
    """The unit axes of the policy's frame in world coordinates, as rows; the world's axes at the target."""
    if scenario.frame == "world":
        one, none = jnp.ones_like(evader[0]), jnp.zeros_like(evader[0])
        return stack(stack(one, none), stack(none, one))
    x, y = target[0] - evader[0], target[1] - evader[1]
    squared = x * x + y * y
    apart = squared > 0.0
    far = jnp.sqrt(jnp.where(apart, squared, 1.0))
    x, y = jnp.where(apart, x / far, 1.0), jnp.where(apart, y / far, 0.0)
    return stack(stack(x, y), stack(-y, x))


def observe(scenario: Scenario, world: World) -> Float[Array, "observation *lanes"]:
    """The observation of one world, or of each of many in lanes; see the table at the top of this module.

    **Returns** `(observation_size(scenario),)`. Use `jax.vmap` for worlds with their axis first.
    """
    axes = frame_axes(scenario, world.evader, world.target)
    x, y = world.target[0] - world.evader[0], world.target[1] - world.evader[1]
    distance = length(x, y)
    entries = [jnp.tanh(distance / FAR_TARGET), jnp.exp(-distance / NEAR_TARGET)]
    if scenario.frame == "world":
        far = jnp.where(distance > 0.0, distance, 1.0)
        entries += [jnp.where(distance > 0.0, x / far, 0.0), jnp.where(distance > 0.0, y / far, 0.0)]

    def along(x: Lanes, y: Lanes) -> tuple[Lanes, Lanes]:
        return axes[0, 0] * x + axes[0, 1] * y, axes[1, 0] * x + axes[1, 1] * y

    def block(
        robots: Float[AnyArray, "n d *lanes"],
        extra: Callable[[Any], tuple[Lanes, Lanes]],
        contact: Scalar,
        more: Callable[[Any], list[Lanes]] = lambda robot: [],
        reach: float = math.inf,
    ) -> list[Lanes]:
        """Entries of all robots of a kind; `extra` gives each robot's second vector, in world axes, and
        `more` what comes last. Those of robots beyond `reach` (m) are 0."""
        distances = [length(robot[0] - world.evader[0], robot[1] - world.evader[1]) for robot in robots]
        if len(distances) > 1:
            order = jnp.argsort(jnp.stack(distances), axis=0)
            robots = jnp.take_along_axis(robots, order[:, None], axis=0)
            distances = jnp.take_along_axis(jnp.stack(distances), order, axis=0)
        entries = []
        for robot, distance in zip(robots, distances, strict=True):
            squash = 1.0 / (1.0 + distance)
            mine = [
                *along((robot[0] - world.evader[0]) * squash, (robot[1] - world.evader[1]) * squash),
                *along(*extra(robot)),
                jnp.exp(-jnp.maximum(distance - contact, 0.0) / NEAR_ROBOT),
                *more(robot),
            ]
            if reach < math.inf:
                mine = [jnp.where(distance < reach, entry, 0.0) for entry in mine]
            entries += mine
        return entries

    def heading(robot: Any) -> tuple[Lanes, Lanes]:
        return jnp.cos(robot[2]), jnp.sin(robot[2])

    def drift(robot: Any) -> tuple[Lanes, Lanes]:
        return robot[2] / scenario.evader_speed, robot[3] / scenario.evader_speed

    def wheels(robot: Any) -> list[Lanes]:
        return [jnp.clip(wheel / scenario.pursuer_speed, -1.0, 1.0) for wheel in robot[3:]]

    pursuers = world.pursuers
    if scenario.observation != "poses":
        pursuers = jnp.concatenate([pursuers, world.wheel_speeds], axis=1)
    entries += block(pursuers, heading, scenario.capture_distance, wheels)
    if scenario.observation != "robots":
        return stack(*entries, *block(world.obstacles, drift, scenario.collision_distance))
    shown = block(world.obstacles, drift, scenario.collision_distance, reach=_SEEN)[: 5 * _SLOTS]
    missing = [jnp.zeros_like(distance)] * (5 * _SLOTS - len(shown))
    return stack(*entries, *shown, *missing, *_robots(scenario))


def _robots(scenario: Scenario) -> list[Scalar]:
    """The robots' speeds and sizes, scaled."""
    drift = length(scenario.obstacle_velocity[0], scenario.obstacle_velocity[1])
    return [
        scenario.evader_speed / _SPEED,
        scenario.pursuer_speed / _SPEED,
        scenario.pursuer_half_axle / _SIZE,
        scenario.capture_distance / _SIZE,
        scenario.collision_distance / _SIZE,
        drift / scenario.evader_speed,
    ]


def to_velocity(
    scenario: Scenario, world: World, action: Float[AnyArray, "2 *lanes"]
) -> Float[Array, "2 *lanes"]:
    """The nominal velocity (m/s, world axes) of a policy's action in [-1, 1]^2."""
    forward, aside = limit_speed(action, real(1.0))
    ahead, left = frame_axes(scenario, world.evader, world.target)
    speed = scenario.evader_speed
    return stack(
        speed * (forward * ahead[0] + aside * left[0]), speed * (forward * ahead[1] + aside * left[1])
    )


def to_action(
    scenario: Scenario, world: World, velocity: Float[AnyArray, "2 *lanes"]
) -> Float[Array, "2 *lanes"]:
    """The policy's action for `velocity` (m/s, world axes): the inverse of `to_velocity`."""
    ahead, left = frame_axes(scenario, world.evader, world.target)
    x, y = velocity[0] / scenario.evader_speed, velocity[1] / scenario.evader_speed
    return stack(ahead[0] * x + ahead[1] * y, left[0] * x + left[1] * y)


def goal_seeking(observation: Float[AnyArray, "observation"]) -> Float[Array, "2"]:
    """The untrained policy: full speed straight at the target.

    For scenarios with `frame="target"`, where the target lies along x by construction; with
    `frame="world"` use `goal_seeking_world`.
    """
    return jnp.zeros_like(real(observation)[:2]).at[0].set(1.0)


def goal_seeking_world(observation: Float[AnyArray, "observation"]) -> Float[Array, "2"]:
    """`goal_seeking` for scenarios with `frame="world"`: the target's direction is entries 2 and 3."""
    return real(observation)[2:4]
