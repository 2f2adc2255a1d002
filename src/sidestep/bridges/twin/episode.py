"""What happens in one episode on the twin, with the very decision core that a robot runs?"""

from __future__ import annotations

import operator
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PRNGKeyArray

from sidestep.bridges.onboard import Decision, Onboard, OnboardSettings
from sidestep.bridges.twin.options import TwinOptions
from sidestep.bridges.twin.twin import Contacts, Twin
from sidestep.learning.records import OUTCOMES
from sidestep.pursuit import Pursuer, as_pursuer, pursue
from sidestep.safety import Budget, Shield, Status
from sidestep.trials import Trajectory
from sidestep.trials.keys import start_and_pursuit
from sidestep.world import Events, Scenario, World

LAG = 0.02
"""Delay (s) that the motors' lag counts as."""
"""What the shield allows for (m) beyond the sensors' noise: estimates that lag, motors that need time."""


@dataclass(frozen=True)
class TwinEpisode:
    """One episode of T control periods on the twin.

    - `trajectory` its truth as a `Trajectory`: worlds at the beginning of each period, the decisions, and
      events from the least distances at every physics step
    - `least_pursuer_distance`, `least_obstacle_distance` (m) over the episode, infinite without such a robot
    - `levels` per period, and `reactions` as pairs of a time (s) and what the decision core said it did
    - `estimate_errors (T,)` m, the largest error of a robot's estimated place as seen from the evader;
      `tracking_errors (T,)` m/s, how far the mean velocity of a period was from the command
    - `compute_seconds (T,)` what each decision took
    - `frames` and `frame_times` positions at 100 Hz, for `write_video`
    """

    scenario: Scenario
    options: TwinOptions
    seed: int
    trajectory: Trajectory
    least_pursuer_distance: float
    least_obstacle_distance: float
    levels: tuple[str, ...]
    reactions: tuple[tuple[float, str], ...]
    estimate_errors: Float[np.ndarray, "t"]
    tracking_errors: Float[np.ndarray, "t"]
    compute_seconds: Float[np.ndarray, "t"]
    frames: Float[np.ndarray, "n nq"]
    frame_times: Float[np.ndarray, "n"]

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
            "periods_not_normal": sum(level != "normal" for level in self.levels),
            "reactions": sorted({text for _, text in self.reactions}),
            "estimate_error_p99": float(np.quantile(self.estimate_errors, 0.99)),
            "tracking_error_p99": float(np.quantile(self.tracking_errors, 0.99)),
            "compute_seconds_p50": float(np.quantile(self.compute_seconds, 0.5)),
            "compute_seconds_p99": float(np.quantile(self.compute_seconds, 0.99)),
        }


def _finite(distance: float) -> float | None:
    return distance if np.isfinite(distance) else None


@eqx.filter_jit
def _steer(scenario: Scenario, pursuer: Pursuer, world: World, key: PRNGKeyArray, period: Array) -> Array:
    return pursue(scenario, pursuer, world, jax.random.fold_in(key, period))


@eqx.filter_jit
def _start(scenario: Scenario, seed: Array) -> tuple[World, PRNGKeyArray]:
    start_key, pursuit_key = start_and_pursuit(jax.random.key(seed))
    return scenario.reset(start_key), pursuit_key


def settings_for(options: TwinOptions) -> OnboardSettings:
    """What the decision core is told of the twin's sensors and motors.

    Filters average the noise, and predict the pursuer to when a command acts: a standard deviation is allowed
    for in place, a quarter of one in heading, and the delay of the poses without that of the motors, which is
    modelled. That is what the paper's numbers leave some use of, not what bounds the errors (`bounded_errors`
    does): an evader that keeps more is led round in circles and does not arrive, one that keeps less is
    caught.
    """
    sensors = options.sensors
    return OnboardSettings(
        budget=Budget(
            position_error=sensors.position_noise,
            heading_error=0.25 * sensors.heading_noise,
            delay=sensors.bounds()["delay"] + options.actuation_delay,
        ),
        position_noise=sensors.position_noise,
        heading_noise=sensors.heading_noise,
        actuation_delay=options.actuation_delay,
        motor_lag=options.lag,
        motor_acceleration=options.acceleration,
        predict_pursuer=True,
    )


def run_twin(
    scenario: Scenario,
    policy: str | Callable[..., Any],
    shield: str | Shield,
    pursuer: str | Callable[..., Any],
    seed: int = 0,
    options: TwinOptions | None = None,
    steps: int | None = None,
    *,
    settings: OnboardSettings | None = None,
    world: World | None = None,
) -> TwinEpisode:
    """One episode, as `twin_episode` with a decision core of its own; for many, compile one and use that.

    **Arguments:** `policy` and `shield` as for `evaluate`; `settings` of the decision core, see
    `settings_for`; the rest as for `twin_episode`.
    """
    options = options or TwinOptions()
    onboard = Onboard(scenario, shield, policy, settings or settings_for(options))
    return twin_episode(onboard, pursuer, seed, options, steps, world=world)


def twin_episode(
    onboard: Onboard,
    pursuer: str | Callable[..., Any],
    seed: int = 0,
    options: TwinOptions | None = None,
    steps: int | None = None,
    *,
    world: World | None = None,
) -> TwinEpisode:
    """One episode: measurements, the decision core's command and the pursuers', physics, once per period.

    Start, measurements and random pursuers follow from `seed`; the start is that of `rollout` with this
    seed. Sensors have been on for half a second when the clock starts.

    **Arguments:** `onboard` the decision core, with a policy; it is reset. `pursuer` as for `evaluate`;
    `steps` at most this many control periods (the scenario's `episode_steps` if not given); `world` to start
    in.

    **Raises** `ValueError` as `evaluate`, and `TwinError` when MuJoCo is missing.
    """
    scenario = onboard.scenario
    limit = scenario.episode_steps if steps is None else operator.index(steps)
    if limit < 1:
        raise ValueError(f"steps = {steps!r}: it must be a whole number of at least 1")
    strategy = as_pursuer(pursuer)
    twin = Twin(scenario, options, seed)
    drawn, key = _start(scenario, jnp.asarray(seed, jnp.uint32))
    twin.reset(drawn if world is None else world)
    onboard.reset()
    truth = twin.world
    onboard.target = (float(truth.target[0]), float(truth.target[1]))
    period = float(scenario.control_period)
    log = _Log(truth)
    for count in range(limit):
        now = twin.time
        for robot, index, stamp, pose in twin.measurements():
            onboard.see(robot, stamp, pose if robot != "obstacle" else pose[:2], index)
        decision = onboard.decide(now)
        seen = truth
        if twin.options.pursuer_sees == "measurements" and decision.world is not None:
            seen = decision.world
        wheels = np.asarray(_steer(scenario, strategy, seen, key, jnp.asarray(count, jnp.uint32)))
        twin.command(decision.velocity, wheels)
        contacts = twin.advance((count + 1) * period - now)
        before, truth = truth, twin.world
        events = _events(scenario, truth, contacts, count + 1 >= scenario.episode_steps)
        log.add(now, before, decision, wheels, truth, events, period)
        if any(events[name] for name in OUTCOMES):
            break
    return log.episode(scenario, twin, seed)


def _events(scenario: Scenario, world: World, contacts: Contacts, last: bool) -> dict[str, Any]:
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


def _relative(world: World) -> Float[np.ndarray, "n 2"]:
    places = np.concatenate([np.asarray(world.pursuers)[:, :2], np.asarray(world.obstacles)[:, :2]])
    return places - np.asarray(world.evader)


class _Log:
    """What is written down period by period."""

    def __init__(self, start: World):
        self._worlds, self._entries, self._events = [start], [], []
        self._levels: list[str] = []
        self._reactions: list[tuple[float, str]] = []
        self._numbers: list[tuple[float, float, float]] = []

    def add(
        self,
        now: float,
        before: World,
        decision: Decision,
        wheels: Float[np.ndarray, "m 2"],
        after: World,
        events: dict[str, Any],
        period: float,
    ) -> None:
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
        error = np.zeros(0)
        if decision.world is not None:
            error = np.linalg.norm(_relative(decision.world) - _relative(before), axis=-1)
        driven = (np.asarray(after.evader) - np.asarray(before.evader)) / period
        self._numbers.append(
            (
                float(np.max(error, initial=0.0)),
                float(np.hypot(*(driven - np.asarray(decision.velocity)))),
                float(decision.compute_seconds),
            )
        )

    def episode(self, scenario: Scenario, twin: Twin, seed: int) -> TwinEpisode:
        stacked = lambda trees: jax.tree.map(lambda *leaves: jnp.asarray(np.stack(leaves)), *trees)  # noqa: E731
        # On the host first, or JAX would compile a stack of every new length.
        worlds = stacked([jax.tree.map(np.asarray, world) for world in self._worlds])
        entries = stacked(self._entries)
        numbers = np.array(self._numbers)
        pursuer, obstacle = twin.least_distances
        return TwinEpisode(
            scenario=scenario,
            options=twin.options,
            seed=seed,
            trajectory=Trajectory(worlds=worlds, events=Events(**stacked(self._events)), **entries),
            least_pursuer_distance=pursuer,
            least_obstacle_distance=obstacle,
            levels=tuple(self._levels),
            reactions=tuple(self._reactions),
            estimate_errors=numbers[:, 0],
            tracking_errors=numbers[:, 1],
            compute_seconds=numbers[:, 2],
            frames=np.array(twin.frames),
            frame_times=np.array(twin.frame_times),
        )
