"""What is kept of an episode in which physics moves the robots?"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, final

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PRNGKeyArray

from sidestep._arrays import whole_number
from sidestep.loop import Trajectory
from sidestep.loop.keys import start_and_pursuit
from sidestep.plants.contacts import Contacts
from sidestep.pursuit import Pursuer, pursue
from sidestep.robot import Decision
from sidestep.safety import Status
from sidestep.world import Events, Scenario, World


@dataclass(frozen=True)
class PhysicsEpisode:
    """One episode of T control periods.

    - `trajectory` its truth as a `Trajectory`: worlds at the beginning of each period, the decisions, and
      events from the least distances at every physics step
    - `least_pursuer_distance`, `least_obstacle_distance` (m) over the episode, infinite without such a robot
    - `levels` per period, and `reactions` as pairs of a time (s) and what the decision core said it did
    - `estimate_errors (T,)` m, the largest error of a robot's estimated place as seen from the evader;
      `tracking_errors (T,)`, how far the evader was from what it was told
    - `compute_seconds (T,)` what each decision took
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

    @property
    def outcome(self) -> str:
        """`captured`, `collided`, `reached`, `timed_out`, or `cut` when it was stopped before."""
        return self.trajectory.outcome

    @property
    def duration(self) -> float:
        """Seconds."""
        return self.trajectory.length * float(self.scenario.control_period)

    def to_dict(self) -> dict[str, Any]:
        """Its figures as plain values; None for the distance to robots that there are none of."""
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


def periods_of(scenario: Scenario, steps: int | None) -> int:
    """How many control periods to play at most. **Raises** `ValueError` for fewer than one."""
    return scenario.episode_steps if steps is None else whole_number("steps", steps)


@eqx.filter_jit
def start_of(scenario: Scenario, seed: Array) -> tuple[World, PRNGKeyArray]:
    """The start that `rollout` has with this seed, and the key of its pursuers."""
    start_key, pursuit_key = start_and_pursuit(jax.random.key(seed))
    return scenario.reset(start_key), pursuit_key


@eqx.filter_jit
def steered(scenario: Scenario, pursuer: Pursuer, world: World, key: PRNGKeyArray, period: Array) -> Array:
    """What every pursuer does in a period, (m, 2) m/s."""
    return pursue(scenario, pursuer, world, jax.random.fold_in(key, period))


def events_of(scenario: Scenario, world: World, contacts: Contacts, last: bool) -> dict[str, Any]:
    """What a period brought, in the terms of the plain simulation."""
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
    """How far (m) the place of any robot, seen from the evader, was from where the decision took it to be."""
    if decision.world is None:
        return 0.0
    error = np.linalg.norm(_seen_from_evader(decision.world) - _seen_from_evader(truth), axis=-1)
    return float(np.max(error, initial=0.0))


@final
class Log:
    """What is written down period by period."""

    def __init__(self, start: World):
        self._worlds, self._entries, self._events = [start], [], []
        self._levels: list[str] = []
        self._reactions: list[tuple[float, str]] = []
        self._numbers: list[tuple[float, float, float]] = []

    def add(
        self,
        now: float,
        decision: Decision,
        wheels: Float[np.ndarray, "m 2"],
        after: World,
        events: dict[str, Any],
        estimate_error: float,
        tracking_error: float,
    ) -> None:
        """One period, begun at `now` (s); `after` is the truth at its end."""
        self._worlds.append(after)
        self._events.append(events)
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
        self._numbers.append((estimate_error, tracking_error, float(decision.compute_seconds)))

    def kept(self) -> dict[str, Any]:
        """What a `PhysicsEpisode` has of it, by name."""
        stacked = lambda trees: jax.tree.map(lambda *leaves: jnp.asarray(np.stack(leaves)), *trees)  # noqa: E731
        # On the host first, or JAX would compile a stack of every new length.
        worlds = stacked([jax.tree.map(np.asarray, world) for world in self._worlds])
        numbers = np.array(self._numbers)
        return {
            "trajectory": Trajectory(
                worlds=worlds, events=Events(**stacked(self._events)), **stacked(self._entries)
            ),
            "levels": tuple(self._levels),
            "reactions": tuple(self._reactions),
            "estimate_errors": numbers[:, 0],
            "tracking_errors": numbers[:, 1],
            "compute_seconds": numbers[:, 2],
        }
