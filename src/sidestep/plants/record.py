"""The record of an episode on a plant."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, final

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from sidestep.loop import Trajectory
from sidestep.plants.contacts import Contacts
from sidestep.plants.plant import Plant
from sidestep.robot import Decision
from sidestep.safety import Status
from sidestep.store.runs import OUTCOMES
from sidestep.world import Events, Scenario, World


@dataclass(frozen=True)
class PlantEpisode:
    """One episode of T control periods.

    - `trajectory`: true worlds at the beginning of each period, the decisions, and events from the least
      distances over each period
    - `least_pursuer_distance`, `least_obstacle_distance` (m) over the episode, infinite without such a robot
    - `levels` per period, and `reactions` of the decision core as pairs of time (s) and text
    - `estimate_errors (T,)` m, the largest error of a robot's estimated position relative to the evader;
      `tracking_errors (T,)`, the plant's `tracking_error` at the end of each period
    - `compute_seconds (T,)` of each decision
    - `frames` of the plant, for `write_video`, and `frame_times` s
    """

    scenario: Scenario
    seed: int
    trajectory: Trajectory
    least_pursuer_distance: float
    least_obstacle_distance: float
    levels: tuple[str, ...]
    reactions: tuple[tuple[float, str], ...]
    estimate_errors: Float[np.ndarray, "t"]
    tracking_errors: Float[np.ndarray, "t"]
    compute_seconds: Float[np.ndarray, "t"]
    frames: Any
    frame_times: Float[np.ndarray, "n"]

    @property
    def outcome(self) -> str:
        """`captured`, `collided`, `reached`, `timed_out`, or `cut` if stopped early."""
        return self.trajectory.outcome

    @property
    def duration(self) -> float:
        """Seconds."""
        return self.trajectory.length * float(self.scenario.control_period)

    def to_dict(self) -> dict[str, Any]:
        """The numbers as JSON values; None for a distance without such a robot."""
        status = np.asarray(self.trajectory.status)
        return {
            "seed": self.seed,
            "outcome": self.outcome,
            "duration": self.duration,
            "least_pursuer_distance": _finite(self.least_pursuer_distance),
            "least_obstacle_distance": _finite(self.least_obstacle_distance),
            "infeasible_periods": int(np.sum(status == Status.INFEASIBLE)),
            "periods": self.trajectory.length,
            "pursuer_invalid": self.trajectory.pursuer_invalid,
            "periods_not_normal": sum(level != "normal" for level in self.levels),
            "reactions": sorted({text for _, text in self.reactions}),
            "estimate_error_p99": float(np.quantile(self.estimate_errors, 0.99)),
            "tracking_error_p99": float(np.quantile(self.tracking_errors, 0.99)),
            "compute_seconds_p50": float(np.quantile(self.compute_seconds, 0.5)),
            "compute_seconds_p99": float(np.quantile(self.compute_seconds, 0.99)),
        }


def _finite(distance: float) -> float | None:
    return distance if np.isfinite(distance) else None


def events_of(scenario: Scenario, world: World, contacts: Contacts, last: bool) -> dict[str, Any]:
    """The `Events` fields of a period."""
    distance = float(np.hypot(*(np.asarray(world.evader) - np.asarray(world.target))))
    cost = -float(scenario.distance_cost) * distance
    over = last and not (contacts.captured or contacts.collided or contacts.reached)
    return {
        "reward": np.float32(scenario.reach_reward if contacts.reached else cost),
        "captured": np.bool_(contacts.captured),
        "collided": np.bool_(contacts.collided),
        "reached": np.bool_(contacts.reached),
        "timed_out": np.bool_(over),
        "pursuer_clearance": np.float32(contacts.pursuer_distance - float(scenario.capture_distance)),
        "obstacle_clearance": np.float32(contacts.obstacle_distance - float(scenario.collision_distance)),
    }


def _seen_from_evader(world: World) -> Float[np.ndarray, "n 2"]:
    places = np.concatenate([np.asarray(world.pursuers)[:, :2], np.asarray(world.obstacles)[:, :2]])
    return places - np.asarray(world.evader)


def estimate_error(decision: Decision, truth: World) -> float:
    """Largest error (m) of the decision's estimate of a robot's position relative to the evader."""
    if decision.world is None:
        return 0.0
    error = np.linalg.norm(_seen_from_evader(decision.world) - _seen_from_evader(truth), axis=-1)
    return float(np.max(error, initial=0.0))


@final
class Log:
    """Records an episode period by period; `world` is the true world after the last period."""

    def __init__(self, plant: Plant):
        self._plant, self.world = plant, plant.world
        self._worlds, self._entries, self._events = [self.world], [], []
        self._levels: list[str] = []
        self._reactions: list[tuple[float, str]] = []
        self._numbers: list[tuple[float, ...]] = []

    def add(
        self, now: float, decision: Decision, wheels: Float[np.ndarray, "m 2"], contacts: Contacts
    ) -> bool:
        """Record one period, begun at `now` (s); returns whether the episode ended in it."""
        plant, before = self._plant, self.world
        self.world = plant.world
        self._worlds.append(self.world)
        last = len(self._worlds) > plant.scenario.episode_steps
        self._events.append(events_of(plant.scenario, self.world, contacts, last))
        self._entries.append(
            {
                "nominal": np.asarray(decision.nominal, np.float32),
                "action": np.asarray(decision.velocity, np.float32),
                "wheel_speeds": wheels,
                "status": np.int32(decision.status),
                "barriers": np.asarray(decision.barriers, np.float32),
                "slack": np.float32(decision.slack),
                "intervention": np.float32(np.nan_to_num(decision.intervention)),
            }
        )
        self._levels.append(decision.level)
        self._reactions += [(now, text) for text in decision.reactions]
        distances = (contacts.pursuer_distance, contacts.obstacle_distance)
        error = estimate_error(decision, before)
        self._numbers.append((*distances, error, plant.tracking_error, float(decision.compute_seconds)))
        return any(self._events[-1][name] for name in OUTCOMES)

    def episode(self, seed: int) -> PlantEpisode:
        """The recorded episode."""
        stacked = lambda trees: jax.tree.map(lambda *leaves: jnp.asarray(np.stack(leaves)), *trees)  # noqa: E731
        # Stack on the host: JAX would compile a program for every new length.
        worlds = stacked([jax.tree.map(np.asarray, world) for world in self._worlds])
        pursuer, obstacle, estimates, tracking, seconds = np.array(self._numbers).T
        return PlantEpisode(
            scenario=self._plant.scenario,
            seed=seed,
            trajectory=Trajectory(
                worlds=worlds, events=Events(**stacked(self._events)), **stacked(self._entries)
            ),
            least_pursuer_distance=float(np.min(pursuer)),
            least_obstacle_distance=float(np.min(obstacle)),
            levels=tuple(self._levels),
            reactions=tuple(self._reactions),
            estimate_errors=estimates,
            tracking_errors=tracking,
            compute_seconds=seconds,
            frames=self._plant.frames,
            frame_times=np.array(self._plant.frame_times),
        )
