"""What the page does and an episode does not: it goes on. New targets, obstacles that turn back."""

from __future__ import annotations

import jax.numpy as jnp
from jaxtyping import Float

from sidestep._arrays import AnyArray, Flag, length
from sidestep.world import Scenario, World

PATIENCE = 30.0
"""Time (s) after which an unreached target is replaced, because a pursuer may block it."""
TRIES = 64
"""Places drawn for a new target, of which the first that is clear is taken."""
_EDGE = 0.4
"""Distance (m) beyond the square of the starts at which an obstacle reverses."""
_CLEAR = 1.0
"""Obstacles do not reverse within this distance (m) of the robot."""
_ROOM = 0.15
"""Distance (m) that a new target keeps from robots, beside that of a contact."""


def another_target(
    scenario: Scenario, world: World, draws: Float[AnyArray, "tries 2"]
) -> Float[AnyArray, "2"]:
    """A point (m) in the square of the starts, clear of all robots if one of `draws` is, which are uniform in
    [-1, 1]; else the last of these."""
    places = 0.45 * scenario.arena_side * draws
    x, y = places[:, 0], places[:, 1]
    clear = length(x - world.evader[0], y - world.evader[1]) >= scenario.target_separation
    for robots, contact in (
        (world.obstacles, scenario.collision_distance), (world.pursuers, scenario.capture_distance)
    ):  # fmt: skip
        for robot in robots:
            clear &= length(x - robot[0], y - robot[1]) > contact + _ROOM
    # The number of a place that is not clear is the last one's.
    numbers = jnp.where(clear, jnp.arange(len(draws)), len(draws) - 1)
    return places[jnp.min(numbers)]


def turned_back(scenario: Scenario, world: World) -> Float[AnyArray, "k 4"]:
    """The obstacles; those that leave the arena, because they move straight, reversed."""
    obstacles = world.obstacles
    edge = 0.5 * scenario.arena_side + _EDGE
    away = length(obstacles[:, 0] - world.evader[0], obstacles[:, 1] - world.evader[1]) > _CLEAR
    places, drifts = obstacles[:, :2], obstacles[:, 2:]
    turns = (jnp.abs(places) > edge) & (places * drifts > 0.0) & away[:, None]
    return jnp.concatenate([places, jnp.where(turns, -drifts, drifts)], axis=1)


def is_touching(scenario: Scenario, world: World) -> Flag:
    """Whether the robot is captured or collides as it stands."""
    evader, pursuers, obstacles = world.evader, world.pursuers, world.obstacles
    caught = length(pursuers[:, 0] - evader[0], pursuers[:, 1] - evader[1]) <= scenario.capture_distance
    collided = length(obstacles[:, 0] - evader[0], obstacles[:, 1] - evader[1]) <= scenario.collision_distance
    return jnp.any(caught) | jnp.any(collided)
