"""Write an episode as a log, and read a log as an episode."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from sidestep.bridges.logs.messages import heading_of
from sidestep.bridges.logs.reader import Record, about_of, read_log
from sidestep.bridges.logs.writer import LogWriter, refuse_existing
from sidestep.loop import Trajectory
from sidestep.safety import Status
from sidestep.store.files import whole_file
from sidestep.world import Events, Scenario, World, load_scenario
from sidestep.world.state import WORLD_FIELDS, worlds_of

_EVENTS = (
    "reward", "captured", "collided", "reached", "timed_out", "pursuer_clearance", "obstacle_clearance",
)  # fmt: skip


@dataclass(frozen=True)
class Log:
    """An episode read from a log.

    - `scenario`, `trajectory`; `about`: the writer's metadata
    - `rebuilt`: what the log lacked and was reconstructed, in words; empty for a log of `save_log`
    - `complete`: see `Record`
    """

    scenario: Scenario
    trajectory: Trajectory
    about: Mapping[str, Any]
    rebuilt: tuple[str, ...]
    complete: bool


def save_log(
    trajectory: Trajectory,
    scenario: Scenario,
    path: str | Path,
    *,
    about: Mapping[str, Any] | None = None,
    levels: Sequence[str] | None = None,
    reactions: Sequence[tuple[float, str]] = (),
    overwrite: bool = False,
) -> Path:
    """Write an episode of a simulation or of the twin as an MCAP log; `load_log` reads it without loss.

    **Arguments:** `about` metadata (shield, policy, pursuer, seed, source); `levels` per period and
    `reactions` (time in s, text) of the decision core, if one ran.

    **Raises** as `LogWriter`; the file is then not written.
    """
    worlds = _host(trajectory.worlds)
    # Converted at once: JAX takes a millisecond to index an entry.
    steps = jax.tree.map(np.asarray, eqx.tree_at(lambda t: t.worlds, trajectory, None))
    times = worlds["time"].tolist()
    refuse_existing(path, overwrite)
    with whole_file(path) as beside, LogWriter(beside, scenario, about) as log:
        for period, stamp in enumerate(times):
            _write_world(log, stamp, {name: values[period] for name, values in worlds.items()})
            if period == trajectory.length:
                break
            log.decision(
                stamp,
                nominal=steps.nominal[period],
                velocity=steps.action[period],
                status=int(steps.status[period]),
                slack=float(steps.slack[period]),
                intervention=float(steps.intervention[period]),
                barriers=steps.barriers[period],
                level="normal" if levels is None else levels[period],
                reactions=[text for time, text in reactions if stamp <= time < times[period + 1]],
            )
            for index, speeds in enumerate(steps.wheel_speeds[period]):
                log.wheels(stamp, speeds, index)
            log.events(stamp, {name: float(getattr(steps.events, name)[period]) for name in _EVENTS})
    return Path(path)


def _host(worlds: World) -> dict[str, np.ndarray]:
    return {name: np.asarray(getattr(worlds, name)) for name in WORLD_FIELDS}


def _write_world(log: LogWriter, stamp: float, world: Mapping[str, np.ndarray]) -> None:
    """Poses, and the motion of each robot in the period that ends now."""
    log.pose("evader", stamp, world["evader"], velocity=world["evader_velocity"])
    for index, (pose, wheels) in enumerate(zip(world["pursuers"], world["wheel_speeds"], strict=True)):
        log.pose("pursuer", stamp, pose, index)
        log.driven(stamp, wheels, index)
    for index, obstacle in enumerate(world["obstacles"]):
        log.pose("obstacle", stamp, obstacle[:2], index, obstacle[2:])
    log.target(stamp, world["target"])


def load_log(path: str | Path, scenario: Scenario | None = None) -> Log:
    """Reconstruct an episode from a log of simulation, twin, node or robot.

    A control period begins at each command (`/cmd_vel`), with each robot at its last logged pose. Missing
    data is reconstructed: velocities from poses, events from the distances at these times.

    **Arguments:** `scenario`, if the log does not contain it.

    **Raises** `ValueError` for a file that is not a log, or a log without evader poses or commands.
    """
    record = read_log(path)
    if scenario is None:
        if "scenario" not in record.metadata:
            raise ValueError(f"{path} does not contain its scenario; give one")
        scenario = load_scenario("paper", **json.loads(record.metadata["scenario"]))
    commands = record.topics.get("/cmd_vel", [])
    if not commands or "/evader/pose" not in record.topics:
        raise ValueError(f"{path} holds no episode: /cmd_vel and /evader/pose are needed")
    rebuilt: list[str] = []
    times = _instants(scenario, record, [stamp for stamp, _ in commands])
    worlds = _worlds(scenario, record, times, rebuilt)
    shield = _shield_numbers(scenario, record, times[:-1], rebuilt)
    nominal = _vectors(record, "/cmd_vel_nominal", times[:-1])
    action = _vectors(record, "/cmd_vel", times[:-1])
    if np.isnan(nominal).all():
        rebuilt.append("nominal velocities: the executed ones")
        nominal = action
    trajectory = Trajectory(
        worlds=worlds_of(worlds),
        nominal=jnp.asarray(nominal),
        action=jnp.asarray(action),
        wheel_speeds=jnp.asarray(_commanded_wheels(scenario, record, times[:-1], worlds)),
        events=_events(scenario, record, times, worlds, rebuilt),
        **shield,
    )
    if not record.complete:
        rebuilt.append("the log was cut off: its end is missing")
    return Log(scenario, trajectory, about_of(record), tuple(rebuilt), record.complete)


def _instants(scenario: Scenario, record: Record, starts: list[float]) -> list[float]:
    """Times (s) at which control periods begin; the last period ends with the last pose."""
    last = record.topics["/evader/pose"][-1][0]
    if last <= starts[-1]:
        if len(starts) > 1:
            # No pose was logged after the last command.
            return starts
        return [*starts, starts[-1] + float(scenario.control_period)]
    return [*starts, last]


def _vectors(record: Record, topic: str, times: Sequence[float]) -> np.ndarray:
    """Velocities (m/s) at these times; NaN before the first."""
    found = [record.at(topic, time) for time in times]
    none = (np.nan, np.nan)
    rows = [none if one is None else (one.twist.linear.x, one.twist.linear.y) for one in found]
    return np.array(rows, np.float32).reshape(-1, 2)


def _poses(record: Record, topic: str, times: Sequence[float]) -> np.ndarray:
    """x, y, heading at these times; the first pose before it; NaN for a robot without poses."""
    entries = record.topics.get(topic)
    if not entries:
        return np.full((len(times), 3), np.nan)
    found = [record.at(topic, time) or entries[0][1] for time in times]
    return np.array(
        [(one.pose.position.x, one.pose.position.y, heading_of(one.pose.orientation)) for one in found]
    )


def _numbers(record: Record, topic: str, times: Sequence[float]) -> list[dict[str, float]]:
    """Numbers by name at these times; empty where there is no message."""
    found = [record.at(topic, time) for time in times]
    return [
        {} if one is None else {d.label: value for d, value in zip(one.layout.dim, one.data, strict=True)}
        for one in found
    ]


def _change(values: np.ndarray, times: Sequence[float]) -> np.ndarray:
    """Rate of change over the period that ends at each time; 0 at the first."""
    rates = np.diff(values, axis=0) / np.maximum(np.diff(times), 1e-9)[:, None]
    return np.concatenate([np.zeros_like(values[:1]), rates])


def _worlds(
    scenario: Scenario, record: Record, times: list[float], rebuilt: list[str]
) -> dict[str, np.ndarray]:
    m, k = scenario.pursuer_count, scenario.obstacle_count
    evader = _poses(record, "/evader/pose", times)[:, :2]
    pursuers = np.stack([_poses(record, f"/pursuer_{i}/pose", times) for i in range(m)], axis=1)
    obstacles = np.zeros((len(times), k, 4))
    for i in range(k):
        obstacles[:, i, :2] = _poses(record, f"/obstacle_{i}/pose", times)[:, :2]
        velocity = _vectors(record, f"/obstacle_{i}/velocity", times)
        seen = not np.isnan(velocity).any()
        obstacles[:, i, 2:] = velocity if seen else _change(obstacles[:, i, :2], times)
        if not seen:
            rebuilt.append(f"the velocity of obstacle {i}: from its poses")
    velocity = _vectors(record, "/evader/velocity", times)
    if np.isnan(velocity).any():
        rebuilt.append("the evader's velocity: from its poses")
        velocity = _change(evader, times)
    target = _poses(record, "/target", times)[:, :2]
    if np.isnan(target).any():
        rebuilt.append("the target: the evader's last position")
        target = np.broadcast_to(evader[-1], evader.shape)
    wheels = np.stack([_wheels(record, f"/pursuer_{i}/driven", times) for i in range(m)], axis=1)
    worlds = {
        "evader": evader,
        "pursuers": pursuers,
        "obstacles": obstacles,
        "target": target,
        "time": np.array(times),
        "evader_velocity": velocity,
        "wheel_speeds": np.nan_to_num(wheels),
    }
    return {name: np.asarray(values, np.float32) for name, values in worlds.items()}


def _wheels(record: Record, topic: str, times: Sequence[float]) -> np.ndarray:
    """Wheel speeds (m/s) at these times, NaN where not known."""
    speeds = _numbers(record, topic, times)
    return np.array([(one.get("left", np.nan), one.get("right", np.nan)) for one in speeds]).reshape(-1, 2)


def _commanded_wheels(
    scenario: Scenario, record: Record, times: list[float], worlds: Mapping[str, np.ndarray]
) -> np.ndarray:
    """The pursuers' commanded wheel speeds (m/s); the driven ones where those are not known."""
    commanded = np.stack(
        [_wheels(record, f"/pursuer_{i}/wheel_speeds", times) for i in range(scenario.pursuer_count)], axis=1
    )
    driven = worlds["wheel_speeds"][1:]
    return np.where(np.isnan(commanded), driven, commanded).astype(np.float32)


def _shield_numbers(
    scenario: Scenario, record: Record, times: list[float], rebuilt: list[str]
) -> dict[str, Any]:
    messages = _numbers(record, "/shield", times)
    if not any(messages):
        rebuilt.append("the shield's answers: not known")
    count = scenario.pursuer_count + scenario.obstacle_count

    def column(name: str, otherwise: float) -> Any:
        return jnp.asarray([one.get(name, otherwise) for one in messages], jnp.float32)

    barriers = [[one.get(f"h{i}", np.nan) for i in range(count)] for one in messages]
    return {
        "status": jnp.asarray([int(one.get("status", Status.INVALID)) for one in messages], jnp.int32),
        "barriers": jnp.asarray(np.array(barriers, np.float32).reshape(-1, count)),
        "slack": column("slack", np.nan),
        "intervention": column("intervention", 0.0),
    }


def _events(
    scenario: Scenario,
    record: Record,
    times: list[float],
    worlds: Mapping[str, np.ndarray],
    rebuilt: list[str],
) -> Events:
    messages = _numbers(record, "/events", times[:-1])
    if messages and all(messages):
        columns = {name: np.array([one[name] for one in messages]) for name in _EVENTS}
    else:
        rebuilt.append("events: from the distances at the instants of the commands")
        columns = _events_from_poses(scenario, worlds)
    flags = ("captured", "collided", "reached", "timed_out")
    return Events(
        **{
            name: jnp.asarray(values.astype(bool) if name in flags else values.astype(np.float32))
            for name, values in columns.items()
        }
    )


def _events_from_poses(scenario: Scenario, worlds: Mapping[str, np.ndarray]) -> dict[str, np.ndarray]:
    """`Events` of each period, from the poses at its end."""
    evader, target = worlds["evader"][1:], worlds["target"][1:]

    def clearance(places: np.ndarray, contact: Any) -> np.ndarray:
        distances = np.hypot(*np.moveaxis(places[1:, :, :2] - evader[:, None], -1, 0))
        return np.min(distances, axis=1, initial=np.inf) - float(contact)

    to_pursuers = clearance(worlds["pursuers"], scenario.capture_distance)
    to_obstacles = clearance(worlds["obstacles"], scenario.collision_distance)
    distance = np.hypot(*(target - evader).T)
    captured, collided = to_pursuers <= 0.0, to_obstacles <= 0.0
    reached = (distance <= float(scenario.reach_distance)) & ~captured & ~collided
    return {
        "reward": np.where(reached, float(scenario.reach_reward), -float(scenario.distance_cost) * distance),
        "captured": captured,
        "collided": collided,
        "reached": reached,
        "timed_out": np.zeros_like(reached),
        "pursuer_clearance": to_pursuers,
        "obstacle_clearance": to_obstacles,
    }
