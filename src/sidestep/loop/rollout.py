"""Record one episode period by period."""

from __future__ import annotations

import json
import zipfile
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from io import BytesIO
from pathlib import Path
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int, PRNGKeyArray

from sidestep._arrays import whole_number
from sidestep.loop.episode import Episode, Task, advance, ask_in_time, begin
from sidestep.loop.keys import as_key, start_and_pursuit
from sidestep.loop.policies import as_policy
from sidestep.loop.step import RUNNING, outcome_of
from sidestep.pursuit import as_pursuer
from sidestep.safety import Shield, as_shield
from sidestep.store.files import json_safe, write_bytes
from sidestep.store.runs import OUTCOMES
from sidestep.world import Events, Scenario, World, load_scenario, scenario_to_dict
from sidestep.world.state import worlds_of

_METADATA = "told"


class Trajectory(eqx.Module):
    """One episode of T control periods. Period t begins in world t and ends in world t + 1.

    **Attributes:** `worlds` with a leading axis of T + 1. All others have one of T: `nominal` and `action`
    velocities (m/s, world axes), the pursuers' commanded `wheel_speeds` (m, 2) in m/s (a pursuer stands still
    if they are not finite), `status` (see `Status`), `barriers` (m + k) in m, `slack` and `intervention` in
    m/s, `events`.
    """

    worlds: World
    nominal: Float[Array, "*batch 2"]
    action: Float[Array, "*batch 2"]
    wheel_speeds: Float[Array, "*batch m 2"]
    status: Int[Array, "*batch"]
    barriers: Float[Array, "*batch n"]
    slack: Float[Array, "*batch"]
    intervention: Float[Array, "*batch"]
    events: Events

    @property
    def length(self) -> int:
        """Control periods T."""
        return int(self.status.shape[0])

    @property
    def pursuer_invalid(self) -> int:
        """Number of control periods in which a pursuer's wheel speeds were not finite."""
        return int(np.sum(~np.all(np.isfinite(self.wheel_speeds), axis=(-2, -1))))

    @property
    def outcome(self) -> str:
        """How the episode ended (see `OUTCOMES`); `cut` if the recording ended earlier."""
        index = int(outcome_of(jax.tree.map(lambda leaf: jnp.asarray(leaf[-1]), self.events)))
        return "cut" if index == RUNNING else OUTCOMES[index]


@eqx.filter_jit
def _record(task: Task, world: World, key: PRNGKeyArray, steps: int) -> tuple[Int[Array, ""], Trajectory]:
    """Record until the episode ends, or for `steps` periods; entries beyond the returned length are zero."""

    def period(count: Array, episode: Episode) -> tuple[Episode, Trajectory]:
        episode, period = advance(task, ask_in_time(task, episode, count), jax.random.fold_in(key, count))
        result = period.result
        return episode, Trajectory(
            worlds=period.after,
            nominal=period.nominal,
            action=result.action,
            wheel_speeds=period.wheel_speeds,
            status=result.status,
            barriers=result.barriers,
            slack=result.slack,
            intervention=result.intervention,
            events=period.events,
        )

    def more(carry: tuple[Array, Episode, Trajectory]) -> Array:
        return (carry[0] < steps) & carry[1].running

    def store(carry: tuple[Array, Episode, Trajectory]) -> tuple[Array, Episode, Trajectory]:
        count, episode, record = carry
        episode, entry = period(count, episode)
        return count + 1, episode, jax.tree.map(lambda whole, one: whole.at[count].set(one), record, entry)

    count, episode = jnp.zeros((), jnp.int32), begin(task.shield, world, task.policy)
    shapes = eqx.filter_eval_shape(period, count, episode)[1]
    record = jax.tree.map(lambda leaf: jnp.zeros((steps, *leaf.shape), leaf.dtype), shapes)
    count, _, record = jax.lax.while_loop(more, store, (count, episode, record))
    worlds = jax.tree.map(lambda first, rest: jnp.concatenate([first[None], rest]), world, record.worlds)
    return count, eqx.tree_at(lambda record: record.worlds, record, worlds)


@eqx.filter_jit
def _reset(scenario: Scenario, key: PRNGKeyArray) -> World:
    return scenario.reset(key)


def rollout(
    scenario: Scenario,
    policy: str | Callable[..., Any],
    shield: str | Shield,
    pursuer: str | Callable[..., Any],
    key: PRNGKeyArray | int,
    world: World | None = None,
    *,
    steps: int | None = None,
) -> Trajectory:
    """Run one episode and record it.

    With `episode_key(key, i)` it replays episode i of `evaluate(..., key)`.

    **Arguments:** as for `evaluate`; `world` to start in, by default drawn by the scenario; `steps` the
    largest number of control periods (default: the scenario's `episode_steps`).

    **Raises** as `evaluate`.
    """
    steps = scenario.episode_steps if steps is None else whole_number("steps", steps)
    policy = as_policy(policy, scenario, in_episode=True)
    shield = as_shield(shield, scenario)
    pursuer = as_pursuer(pursuer)
    start_key, pursuit_key = start_and_pursuit(as_key(key))
    world = _reset(scenario, start_key) if world is None else world
    count, record = _record(Task(scenario, policy, shield, pursuer), world, pursuit_key, steps)
    length = int(count)
    # Slice on the host: JAX would compile a program per leaf for every new length.
    cut = lambda leaf, end: jnp.asarray(np.asarray(leaf)[:end])  # noqa: E731
    worlds = jax.tree.map(lambda leaf: cut(leaf, length + 1), record.worlds)
    record = jax.tree.map(lambda leaf: cut(leaf, length), eqx.tree_at(lambda r: r.worlds, record, None))
    return eqx.tree_at(lambda r: r.worlds, record, worlds, is_leaf=lambda leaf: leaf is None)


def _named_leaves(tree: Any) -> dict[str, Any]:
    leaves, _ = jax.tree_util.tree_flatten_with_path(tree)
    return {jax.tree_util.keystr(path, simple=True, separator="."): leaf for path, leaf in leaves}


@dataclass(frozen=True)
class Recording:
    """A trajectory with its `scenario` (None: unknown) and metadata `about` it."""

    trajectory: Trajectory
    scenario: Scenario | None
    about: Mapping[str, Any]


def save_trajectory(
    path: str | Path,
    trajectory: Trajectory,
    scenario: Scenario | None = None,
    about: Mapping[str, Any] | None = None,
) -> None:
    """Write a trajectory as a NumPy archive of plain arrays, whole or not at all.

    **Arguments:** `scenario` of the recording; `about`, metadata as JSON values by name, such as `shield`.
    `load_episode` returns both.
    """
    buffer = BytesIO()
    arrays: dict[str, Any] = {name: np.asarray(leaf) for name, leaf in _named_leaves(trajectory).items()}
    if scenario is not None:
        metadata = json_safe({"scenario": scenario_to_dict(scenario), "about": about or {}})
        arrays[_METADATA] = np.frombuffer(json.dumps(metadata).encode(), np.uint8)
    np.savez_compressed(buffer, **arrays)
    write_bytes(path, buffer.getvalue())


def load_trajectory(path: str | Path) -> Trajectory:
    """Read a file of `save_trajectory`. **Raises** `ValueError` when the file is no such archive."""
    return load_episode(path).trajectory


def _without_code(scenario: Mapping[str, Any]) -> dict[str, Any]:
    models = ("evader_model", "pursuer_model")
    nameless = {name: None for name in models if not isinstance(scenario.get(name), Mapping)}
    return {**scenario, **nameless}


def load_episode(path: str | Path) -> Recording:
    """Read a file of `save_trajectory`, with its scenario and metadata. **Raises** as `load_trajectory`."""
    try:
        with np.load(BytesIO(Path(path).read_bytes()), allow_pickle=False) as archive:
            arrays = {name: jnp.asarray(archive[name]) for name in archive.files if name != _METADATA}
            metadata = json.loads(bytes(archive[_METADATA])) if _METADATA in archive.files else {}
        places = {name: arrays.pop(name) for name in list(arrays) if name.startswith("worlds.")}
        events = {name: arrays.pop(name) for name in list(arrays) if name.startswith("events.")}
        trajectory = Trajectory(
            worlds=worlds_of({name.removeprefix("worlds."): values for name, values in places.items()}),
            events=Events(**{name.removeprefix("events."): values for name, values in events.items()}),
            **arrays,
        )
        # Custom robots without a name are code, which a recording does not need. Robots with a name are kept,
        # because the sets in figures depend on them.
        scenario = load_scenario("paper", **_without_code(metadata["scenario"])) if metadata else None
        return Recording(trajectory, scenario, metadata.get("about", {}))
    except (KeyError, TypeError, ValueError, EOFError, zipfile.BadZipFile) as error:
        raise ValueError(f"{path} holds no recorded trajectory: {error}") from error
