"""Load scenarios by name or from a file, and validate them."""

from __future__ import annotations

import json
import tomllib
from collections.abc import Mapping
from dataclasses import fields
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from sidestep._bounds import check
from sidestep.store.programs import kept_jit
from sidestep.world.capture_geometry import capture_set_distance, to_pursuer_frame
from sidestep.world.field_names import ScenarioError, unknown_field, without_aliases
from sidestep.world.flyers import Aircraft, Quadrotor
from sidestep.world.model_probe import check_models
from sidestep.world.models import EvaderModel, PursuerModel
from sidestep.world.scenario import Scenario

_QUADROTOR: dict[str, Any] = {
    "evader_model": Quadrotor(),
    "pursuer_model": Aircraft(),
    "evader_speed": 0.8,
    "pursuer_speed": 1.0,
    # Strategies return wheel speeds for this half axle; the aircraft has no axle.
    "pursuer_half_axle": 1.0,
    "capture_distance": 0.17,
    "collision_distance": 0.2,
    "reach_distance": 0.25,
    "obstacle_velocity": (0.0, 0.0),
    "obstacle_count": 3,
    "arena_side": 5.0,
    "initial_separation": 1.2,
    "obstacle_separation": 0.6,
    "target_separation": 3.0,
    "episode_steps": 2400,
}

PRESETS: dict[str, dict[str, Any]] = {
    # The paper's numbers; starts and targets at random. They are the defaults of `Scenario`.
    "paper": {},
    # The paper's fixed test scene (section IV, tests).
    "paper-test": {
        "evader_start": (0.0, 0.0),
        "obstacle_starts": ((1.5, 0.0),),
        "pursuer_starts": ((1.0, -0.5, 0.0),),
        "target_start": (2.5, 0.0),
    },
    # The paper's robots with less room to keep, so that pursuer and obstacle can both be kept away for ever:
    # sidestep comes with their clearance tables.
    "paper-0.10": {"capture_distance": 0.10},
    "paper-0.15": {"capture_distance": 0.15},
    # A small quadrotor among columns, pursued by a faster aircraft with wide turns.
    "quadrotor": _QUADROTOR,
    # A fixed scene of that kind: the aircraft comes head-on, with columns on both sides of the path.
    "quadrotor-test": {
        **_QUADROTOR,
        "evader_start": (0.0, 0.0),
        "obstacle_starts": ((2.0, 0.9), (2.6, -0.8), (4.2, 0.1)),
        "pursuer_starts": ((4.0, -1.2, 2.8),),
        "target_start": (6.0, 0.0),
    },
}

_STARTS = {"pursuer_starts": "pursuer_count", "obstacle_starts": "obstacle_count"}
_MODELS = {"evader_model": EvaderModel, "pursuer_model": PursuerModel}
_NAMED: dict[str, type[EvaderModel] | type[PursuerModel]] = {"quadrotor": Quadrotor, "aircraft": Aircraft}
"""Models that a file can name."""


def _fail(field: str, value: object, allowed: str) -> None:
    raise ScenarioError(f"scenario field '{field}' = {value!r}: {allowed}")


def _check_scene(scenario: Scenario) -> None:
    """**Raises** `ScenarioError` for fixed starts that conflict."""
    evader, target = scenario.evader_start, scenario.target_start
    if scenario.obstacle_starts is not None:
        for obstacle in scenario.obstacle_starts:
            for name, point in (("evader_start", evader), ("target_start", target)):
                if point is not None:
                    gap = float(jnp.linalg.norm(point - obstacle))
                    if gap <= float(scenario.collision_distance):
                        _fail(
                            name,
                            point.tolist(),
                            f"it lies {gap:.4g} m from the obstacle at {obstacle.tolist()}, inside the "
                            f"collision distance {float(scenario.collision_distance):.4g} m; move one",
                        )
    if scenario.pursuer_starts is not None and evader is not None:
        for pose in scenario.pursuer_starts:
            h = float(
                capture_set_distance(
                    to_pursuer_frame(evader, pose), scenario.usable_angle, scenario.capture_distance
                )
            )
            if h <= 0.0:
                _fail(
                    "evader_start",
                    evader.tolist(),
                    f"already captured by the pursuer at {pose.tolist()}: it starts {-h:.4g} m inside the "
                    "capture set, where the pursuer wins at once; start farther away",
                )
    if evader is not None and target is not None:
        gap = float(jnp.linalg.norm(evader - target))
        if gap <= float(scenario.reach_distance):
            _fail(
                "target_start",
                target.tolist(),
                f"the evader starts {gap:.4g} m away, so it is reached already",
            )


def _names_of(field: str) -> list[str]:
    return [name for name, kind in _NAMED.items() if issubclass(kind, _MODELS[field])]


def _model(field: str, value: Any) -> Any:
    """A model, None, or a name in a file: `"quadrotor"`, or `{model = "quadrotor", time_constant = 0.3}`."""
    entry = {"model": value} if isinstance(value, str) else value
    if not isinstance(entry, Mapping) or entry.get("model") not in _names_of(field):
        if not isinstance(value, (_MODELS[field], type(None))):
            _fail(
                field,
                value,
                f"it must be a {_MODELS[field].__name__}, or None for the built-in robot, or by name "
                f"({', '.join(_names_of(field))}). A custom model is code: pass it to load_scenario as an "
                "argument",
            )
        return value
    kind = _NAMED[entry["model"]]
    numbers, known = (
        {name: entry[name] for name in entry if name != "model"},
        [one.name for one in fields(kind)],
    )
    for name in numbers:
        if name not in known:
            _fail(field, value, f"a {entry['model']} has no '{name}'; it has {', '.join(known)}")
    try:
        return kind(**check(kind, numbers))
    except ValueError as error:
        raise ScenarioError(f"scenario field '{field}' = {value!r}: {error}") from None


def _build(values: dict[str, Any]) -> Scenario:
    known = [field.name for field in fields(Scenario)]
    for name in values:
        if name not in known:
            raise ScenarioError(unknown_field(name, known))
    values = {name: _model(name, value) if name in _MODELS else value for name, value in values.items()}
    values = check(Scenario, values, label="scenario field '{}'", error=ScenarioError)
    for name, value in values.items():
        if isinstance(value, np.ndarray):
            values[name] = jnp.asarray(value, dtype=float)
    for starts, count in _STARTS.items():
        if values.get(starts) is None:
            continue
        given = len(values[starts])
        wanted = values.setdefault(count, given)
        if wanted > given:
            _fail(count, wanted, f"only {given} fixed starts are given in '{starts}'; give {wanted}, or none")
        values[starts] = values[starts][:wanted]
    scenario = Scenario(**values)
    wrong = check_models(scenario)
    if wrong:
        raise ScenarioError("; ".join(wrong))
    _check_scene(scenario)
    if not bool(_some_start_exists(scenario)):
        raise ScenarioError(
            "no start satisfies this scenario: 4096 random draws were all rejected. The square of side "
            f"'arena_side' = {float(scenario.arena_side):.4g} m is too small for 'initial_separation' = "
            f"{float(scenario.initial_separation):.4g} m, 'obstacle_separation' = "
            f"{float(scenario.obstacle_separation):.4g} m, 'target_separation' = "
            f"{float(scenario.target_separation):.4g} m and {scenario.obstacle_count} obstacles of "
            f"'collision_distance' = {float(scenario.collision_distance):.4g} m; enlarge it or lower one "
            "of them"
        )
    return scenario


@kept_jit
def _some_start_exists(scenario: Scenario) -> jax.Array:
    keys = jax.random.split(jax.random.key(0), 4096)
    return jnp.any(jax.vmap(lambda key: scenario.accepts(scenario._draw(key)))(keys))


def load_scenario(name_or_path: str | Path, **overrides: Any) -> Scenario:
    """A validated scenario: a preset (a key of `PRESETS`) or a TOML or JSON file, with overrides.

    A file holds fields of `Scenario`; an optional `preset` names the one it starts from (`paper` otherwise).
    A run's `config.json` works too: its `scenario` entry is used. If `obstacle_count` or `pursuer_count` is
    less than the number of fixed starts, the first ones are kept. Flying robots have names, in files too:
    `evader_model = "quadrotor"`, `pursuer_model = {model = "aircraft", turning_radius = 3.0}`. In files and
    overrides, `wheel_separation` (m, as in data sheets of differential drives) may replace
    `pursuer_half_axle`, which is half of it.

    **Raises** `ScenarioError` (a `ValueError`) naming the field, its value and what is allowed.
    """
    values: dict[str, Any]
    if str(name_or_path) in PRESETS:
        values = {**PRESETS[str(name_or_path)], "name": str(name_or_path)}
    else:
        path = Path(name_or_path)
        if not path.is_file():
            raise ScenarioError(
                f"no scenario '{name_or_path}': neither a preset ({', '.join(PRESETS)}) nor a file. "
                "A file is TOML or JSON with fields of sidestep.Scenario."
            )
        try:
            text = path.read_text(encoding="utf-8")
            content = json.loads(text) if path.suffix == ".json" else tomllib.loads(text)
        except (UnicodeDecodeError, json.JSONDecodeError, tomllib.TOMLDecodeError) as error:
            raise ScenarioError(f"scenario file {path} cannot be read: {error}") from None
        if not isinstance(content, dict):
            raise ScenarioError(
                f"scenario file {path} must hold fields and their values, not a {type(content).__name__}"
            )
        if isinstance(content.get("scenario"), dict):
            content = content["scenario"]
        preset = content.pop("preset", "paper")
        if preset not in list(PRESETS):
            _fail("preset", preset, f"it must be one of {', '.join(PRESETS)}")
        values = _changed({"name": path.stem, **PRESETS[preset]}, content)
    return _build(_changed(values, overrides))


def _changed(values: Mapping[str, Any], changes: Mapping[str, Any]) -> dict[str, Any]:
    """`values` with `changes`; new starts also set the number of robots."""
    kept, changes = dict(values), without_aliases(changes)
    for starts, count in _STARTS.items():
        if changes.get(starts) is not None:
            kept.pop(count, None)
    return {**kept, **changes}


def scenario_to_dict(scenario: Scenario) -> dict[str, Any]:
    """All fields as JSON values, from which `load_scenario` rebuilds the scenario.

    Custom robots (`evader_model`, `pursuer_model`) are code. They are described by a text, and must be passed
    to `load_scenario` again. Robots with a name are rebuilt.
    """

    def plain(value: Any) -> Any:
        for name, kind in _NAMED.items():
            if isinstance(value, kind):
                return {"model": name, **{one.name: plain(getattr(value, one.name)) for one in fields(value)}}
        if isinstance(value, (jax.Array, np.ndarray)):
            # The shortest decimal with the same float value: 0.1574, not 0.15739999711513519.
            return np.asarray(value).astype(str).astype(float).tolist()
        return repr(value) if isinstance(value, tuple(_MODELS.values())) else value

    return {field.name: plain(getattr(scenario, field.name)) for field in fields(scenario)}
