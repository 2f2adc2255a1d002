"""Counterexamples as small files that can be replayed, with a digest that detects changes."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

import sidestep
from sidestep.learning import LearnedPolicy, load_policy
from sidestep.loop.policies import GOAL_SEEKING, as_policy
from sidestep.loop.rollout import Trajectory, rollout
from sidestep.safety import Shield, make_shield, name_of
from sidestep.store.checkpoints import CheckpointError, read_named, write_arrays
from sidestep.store.files import json_safe
from sidestep.trials.falsification.attackers import Script
from sidestep.world import Scenario, World, load_scenario, scenario_to_dict
from sidestep.world.state import WORLD_FIELDS

_FORMAT = 1
_NEEDED = (
    "scenario", "shield", "policy", "seed", "attack", "version", "dtype", "limit", "outcome", "steps",
    "time", "pursuer_clearance", "obstacle_clearance", "assumption", "words", "guaranteed_clearance",
)  # fmt: skip
CUSTOM = "custom"
"""Stands for a policy or shield without a name."""


class CounterexampleError(ValueError):
    """A counterexample that cannot be used: damaged, edited, or without its policy or shield."""


@dataclass(frozen=True)
class Counterexample:
    """A lost episode, given by its start and the pursuers' wheel speeds.

    **Attributes:** `world` the start; `wheels (t, m, 2)` m/s, one row per control period; `end` evader and
    pursuers at the end, exact; `about` JSON values: `scenario` (its fields), `shield`, `policy`, `seed`,
    `attack`, `version`, `dtype`, `limit` (control periods to play), `outcome`, `steps`, `time` (s),
    `pursuer_clearance` and `obstacle_clearance` (least, m; null without such a robot), the broken
    `assumption` (null: none) with `words`, and `guaranteed_clearance` (m) of a certificate, if any.
    """

    about: Mapping[str, Any]
    world: World
    wheels: Float[np.ndarray, "t m 2"]
    end: Mapping[str, np.ndarray]


@dataclass(frozen=True)
class Replay:
    """A replayed counterexample. `same`: same outcome in the same control period; `exact`: bitwise equal
    end."""

    trajectory: Trajectory
    scenario: Scenario
    same: bool
    exact: bool


def play(
    scenario: Scenario,
    policy: Any,
    shield: Any,
    world: World,
    wheels: Float[np.ndarray, "t m 2"],
    limit: int,
) -> Trajectory:
    """The episode with these wheel speeds (m/s), computed by the control step of all episodes."""
    plan = np.zeros((limit, *wheels.shape[1:]), wheels.dtype)
    plan[: len(wheels)] = wheels[:limit]
    pursuer = Script(jnp.asarray(plan), jnp.zeros((), jnp.int32))
    world = jax.tree.map(jnp.asarray, world)
    return rollout(scenario, policy, shield, pursuer, 0, world, steps=limit)


def shield_name(shield: str | Shield, scenario: Scenario) -> str:
    """The name with which `make_shield` returns this shield, else `custom`."""
    return shield if isinstance(shield, str) else name_of(shield, scenario) or CUSTOM


def policy_digest(policy: LearnedPolicy) -> str:
    """The digest of a trained policy's weights."""
    digest = hashlib.sha256(str(policy.decision_steps).encode())
    for leaf in jax.tree.leaves(eqx.filter(policy, eqx.is_array)):
        digest.update(np.ascontiguousarray(leaf).tobytes())
    return digest.hexdigest()


def describe_policy(policy: Any, source: str | Path | None = None) -> dict[str, Any]:
    """A policy's description in a file: its name, and for a trained policy its run folder and digest."""
    if isinstance(policy, str):
        return {"name": policy}
    if isinstance(policy, LearnedPolicy):
        return {"name": str(source or CUSTOM), "digest": policy_digest(policy)}
    return {"name": CUSTOM}


def make_counterexample(
    scenario: Scenario, trajectory: Trajectory, wheels: Float[np.ndarray, "t m 2"], **about: Any
) -> Counterexample:
    """The counterexample of a `trajectory` that `play` returned for `wheels`; `about` is added to its
    data."""
    steps = trajectory.length
    worlds = trajectory.worlds
    facts = {
        **about,
        "format": _FORMAT,
        "version": sidestep.__version__,
        "scenario": scenario_to_dict(scenario),
        "dtype": str(np.asarray(worlds.evader).dtype),
        "outcome": trajectory.outcome,
        "steps": steps,
        "time": steps * float(scenario.control_period),
        "pursuer_clearance": np.min(np.asarray(trajectory.events.pursuer_clearance)),
        "obstacle_clearance": np.min(np.asarray(trajectory.events.obstacle_clearance)),
    }
    start = jax.tree.map(lambda leaf: np.asarray(leaf[0]), worlds)
    end = {name: np.asarray(getattr(worlds, name)[-1]) for name in ("evader", "pursuers")}
    return Counterexample(json_safe(facts), start, wheels[:steps], end)


def write_counterexample(path: str | Path, counterexample: Counterexample) -> None:
    """Write it as an `.npz` of plain arrays with a digest of its content, whole or not at all."""
    text = json.dumps(counterexample.about, allow_nan=False, sort_keys=True)
    arrays = {
        "about": np.frombuffer(text.encode(), np.uint8),
        "wheels": counterexample.wheels,
        **{f"start_{name}": np.asarray(getattr(counterexample.world, name)) for name in WORLD_FIELDS},
        **{f"end_{name}": value for name, value in counterexample.end.items()},
    }
    write_arrays(Path(path), arrays)


def read_counterexample(path: str | Path) -> Counterexample:
    """Read a file of `write_counterexample`.

    **Raises** `CounterexampleError` when the file is missing, damaged, edited or of another format.
    """
    path = Path(path)
    if not path.is_file():
        raise CounterexampleError(f"{path} does not exist: give the .npz file of a counterexample")
    try:
        named, _ = read_named(path)
        arrays = {name.strip("[]'\""): array for name, array in named.items()}
        about = json.loads(bytes(arrays["about"]))
        if not isinstance(about, dict) or about.get("format") != _FORMAT:
            raise CounterexampleError(f"{path} was written by another version of sidestep")
        missing = [name for name in _NEEDED if name not in about]
        if missing:
            raise CounterexampleError(f"{path} lacks {', '.join(missing)}")
        with jax.enable_x64(about["dtype"] == "float64"):
            world = World(**{name: jnp.asarray(arrays[f"start_{name}"]) for name in WORLD_FIELDS})
        world = jax.tree.map(np.asarray, world)
        end = {name: arrays[f"end_{name}"] for name in ("evader", "pursuers")}
        return Counterexample(about, world, arrays["wheels"], end)
    except CheckpointError as error:
        raise CounterexampleError(
            f"{error}; a counterexample cannot be edited, and a damaged one cannot be trusted"
        ) from None
    except (KeyError, TypeError, UnicodeDecodeError, json.JSONDecodeError) as error:
        raise CounterexampleError(f"{path} holds no counterexample: {error}") from None


def replay(
    counterexample: Counterexample, *, policy: Any = None, shield: str | Shield | None = None
) -> Replay:
    """Replay a counterexample with the control step of all episodes.

    **Arguments:** `policy` and `shield`, by default those the counterexample names; required if it names
    none. A trained policy must have the stored weights.

    **Raises** `CounterexampleError` when policy or shield is unavailable or a different one.
    """
    about = counterexample.about
    with jax.enable_x64(about["dtype"] == "float64"):
        scenario = load_scenario("paper", **about["scenario"])
        if shield is None and about["shield"] == CUSTOM:
            raise CounterexampleError("its shield has no name: give the shield")
        shield = make_shield(about["shield"], scenario) if shield is None else shield
        trajectory = play(
            scenario,
            as_policy(_policy_of(about["policy"], policy), scenario),
            shield,
            counterexample.world,
            counterexample.wheels,
            about["limit"],
        )
    same = trajectory.outcome == about["outcome"] and trajectory.length == about["steps"]
    exact = same and all(
        np.array_equal(np.asarray(getattr(trajectory.worlds, name)[-1]), value)
        for name, value in counterexample.end.items()
    )
    return Replay(trajectory, scenario, same, exact)


def _policy_of(reference: Mapping[str, Any], given: Any) -> Any:
    name, digest = reference["name"], reference.get("digest")
    policy = given if given is not None else name
    if isinstance(policy, str) and policy == CUSTOM:
        raise CounterexampleError("its policy has no name: give the policy")
    if isinstance(policy, Path) or (isinstance(policy, str) and policy != GOAL_SEEKING):
        try:
            policy = load_policy(policy)
        except ValueError as error:
            raise CounterexampleError(
                f"its policy cannot be had: {error}; give the run with --policy"
            ) from None
    if digest is not None and (not isinstance(policy, LearnedPolicy) or policy_digest(policy) != digest):
        raise CounterexampleError(
            f"the policy {name} is no longer the one that this counterexample was found with; "
            "give that run with --policy"
        )
    return policy
