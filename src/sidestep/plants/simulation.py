"""The simulation as a plant, without motors and noise."""

from __future__ import annotations

import math
from typing import final

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from sidestep._arrays import real
from sidestep.plants.contacts import Contacts
from sidestep.plants.library import check_robots
from sidestep.plants.plant import Plant
from sidestep.plants.sensors import Measurement
from sidestep.world import Events, Scenario, World
from sidestep.world.robots import closest_approach_straight


@eqx.filter_jit
def _step(
    scenario: Scenario, world: World, velocity: Array, wheels: Array, duration: Array, time: Array
) -> tuple[World, Events, Array]:
    """`Scenario.step` over `duration` (s), ending at `time` (s), and the least distance (m) to the target."""
    held = eqx.tree_at(lambda scenario: scenario.control_period, scenario, duration)
    moved, events = held.step(world, velocity, wheels)
    chord, once = moved.evader - world.evader, jnp.ones_like(duration)
    to_target = closest_approach_straight(world.evader - world.target, chord, once)
    return eqx.tree_at(lambda moved: moved.time, moved, time), events, to_target


@final
class Simulation(Plant):
    """`Scenario.step` as a plant: exact motion over any duration, and exact current poses.

    **Arguments:** `heading` (rad) of the evader at the start. It follows the turn rate and has no effect on
    the motion.
    """

    def __init__(self, scenario: Scenario, heading: float = 0.0):
        self.scenario, self._first_heading = scenario, heading
        self.pose_rate = 1.0 / float(scenario.control_period)

    def reset(self, world: World, seed: int | None = None) -> None:
        check_robots(world, self.scenario.pursuer_count, self.scenario.obstacle_count)
        self._world, self._time, self._heading = world, 0.0, self._first_heading
        self.command(np.zeros(2), np.zeros((len(world.pursuers), 2)))
        # Compile here, not in the loop.
        self._moved(float(self.scenario.control_period))

    def command(
        self, velocity: Float[np.ndarray, "2"], wheel_speeds: Float[np.ndarray, "m 2"], turn_rate: float = 0.0
    ) -> None:
        self._commanded, self._turn_rate = (real(velocity), real(wheel_speeds)), turn_rate

    def _moved(self, duration: float) -> tuple[World, Events, Array]:
        times = real(duration), real(self._time + duration)
        return _step(self.scenario, self._world, *self._commanded, *times)

    def advance(self, duration: float) -> Contacts:
        self._world, events, to_target = self._moved(duration)
        self._time += duration
        self._heading = math.remainder(self._heading + self._turn_rate * duration, 2.0 * math.pi)
        return Contacts(
            pursuer_distance=float(events.pursuer_clearance + self.scenario.capture_distance),
            obstacle_distance=float(events.obstacle_clearance + self.scenario.collision_distance),
            target_distance=float(to_target),
            captured=bool(events.captured),
            collided=bool(events.collided),
            reached=bool(events.reached),
        )

    def measurements(self) -> list[Measurement]:
        """The current poses, at every call."""
        world = self._world
        groups = {
            "evader": [(*world.evader, self._heading)],
            "pursuer": np.asarray(world.pursuers),
            "obstacle": [(x, y, 0.0) for x, y, *_ in np.asarray(world.obstacles)],
        }
        return [
            Measurement(robot, index, self._time, (float(x), float(y), float(heading)))
            for robot, group in groups.items()
            for index, (x, y, heading) in enumerate(group)
        ]

    @property
    def time(self) -> float:
        return self._time

    @property
    def world(self) -> World:
        return self._world
