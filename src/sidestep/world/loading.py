"""Scenarios by name or from a file, validated before anything runs."""

from __future__ import annotations

import json
import math
import tomllib
from collections.abc import Callable, Mapping
from dataclasses import fields
from pathlib import Path
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from sidestep._arrays import real
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
    # What strategies answer wheel speeds for; the aircraft has no axle.
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
    # A small quadrotor among columns, chased by a faster aircraft that turns slowly.
    "quadrotor": _QUADROTOR,
    # One scene of that kind: the aircraft comes head-on, and columns stand to both sides of the way.
    "quadrotor-test": {
        **_QUADROTOR,
        "evader_start": (0.0, 0.0),
        "obstacle_starts": ((2.0, 0.9), (2.6, -0.8), (4.2, 0.1)),
        "pursuer_starts": ((4.0, -1.2, 2.8),),
        "target_start": (6.0, 0.0),
    },
}

_POSITIVE = {
    "evader_speed", "pursuer_speed", "pursuer_half_axle", "capture_distance", "collision_distance",
    "reach_distance", "control_period", "arena_side",
}  # fmt: skip
_NOT_NEGATIVE = {
    "pursuer_gain", "obstacle_gain", "reach_reward", "distance_cost",
    "initial_separation", "obstacle_separation", "target_separation",
}  # fmt: skip
_COUNTS = {"pursuer_count": 1, "obstacle_count": 0, "episode_steps": 1}
_STARTS = {"pursuer_starts": "pursuer_count", "obstacle_starts": "obstacle_count"}
_CHOICES = {
    "action": ("velocity", "heading"),
    "obstacle_directions": ("fixed", "random"),
    "frame": ("target", "world"),
}
_MODELS = {"evader_model": EvaderModel, "pursuer_model": PursuerModel}
_NAMED: dict[str, type[EvaderModel] | type[PursuerModel]] = {"quadrotor": Quadrotor, "aircraft": Aircraft}
"""Models that a file can name."""
_SHAPES: dict[str, tuple[int | None, ...]] = {
    "obstacle_velocity": (2,),
    "evader_start": (2,),
    "target_start": (2,),
    "pursuer_starts": (None, 3),
    "obstacle_starts": (None, 2),
}


def _fail(field: str, value: object, allowed: str) -> None:
    raise ScenarioError(f"scenario field '{field}' = {value!r}: {allowed}")


def _check_fields(values: Mapping[str, Any]) -> None:
    known = [field.name for field in fields(Scenario)]
    for name in values:
        if name not in known:
            raise ScenarioError(unknown_field(name, known))


def _check_number(name: str, value: Any, test: Callable[[float], bool], allowed: str) -> None:
    try:
        # In the precision that will be used: 1e-60 is 0 in float32, 1e60 infinite.
        with np.errstate(over="ignore"):
            number = float(np.asarray(float(value), dtype=real(0.0).dtype))
    except (TypeError, ValueError):
        return _fail(name, value, f"a number is needed, {allowed}")
    if isinstance(value, bool) or not math.isfinite(number) or not test(number):
        _fail(name, value, f"it must be finite and {allowed}")


def _check_values(values: Mapping[str, Any]) -> None:
    for name, value in values.items():
        if name in _POSITIVE:
            _check_number(name, value, lambda number: number > 0.0, "greater than 0")
        elif name in _NOT_NEGATIVE:
            _check_number(name, value, lambda number: number >= 0.0, "0 or more")
        elif name in _COUNTS:
            least = _COUNTS[name]
            if isinstance(value, bool) or not isinstance(value, (int, np.integer)) or value < least:
                _fail(name, value, f"it must be a whole number of at least {least}")
        elif name in _CHOICES:
            if value not in _CHOICES[name]:
                _fail(name, value, f"it must be one of {', '.join(map(repr, _CHOICES[name]))}")
        elif name in _SHAPES and value is not None:
            shape = _SHAPES[name]
            try:
                array = np.asarray(value, dtype=float)
            except (TypeError, ValueError):
                array = np.asarray(np.nan)
            if name == "obstacle_starts" and array.size == 0:
                array = array.reshape(0, 2)
            fits = array.ndim == len(shape) and all(
                n in (None, m) for n, m in zip(shape, array.shape, strict=True)
            )
            if not fits or not np.all(np.isfinite(array)):
                wanted = " x ".join("n" if n is None else str(n) for n in shape)
                _fail(name, value, f"it must be {wanted} finite numbers")
        elif name in _MODELS:
            if not isinstance(value, (_MODELS[name], type(None))):
                _fail(
                    name,
                    value,
                    f"it must be a {_MODELS[name].__name__}, or None for the built-in robot, or by name "
                    f"({', '.join(_names_of(name))}). One of your own is code: give it to load_scenario "
                    "beside the file",
                )
        elif name == "name" and not isinstance(value, str):
            _fail(name, value, "it must be text")


def _check_scene(scenario: Scenario) -> None:
    """Conflicts between fixed starts, each named."""
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
    """The model that a file names: `"quadrotor"`, or `{model = "quadrotor", time_constant = 0.3}`."""
    told = {"model": value} if isinstance(value, str) else value
    if not isinstance(told, Mapping) or told.get("model") not in _names_of(field):
        return value
    numbers = {name: number for name, number in told.items() if name != "model"}
    kind = _NAMED[told["model"]]
    for name, number in numbers.items():
        known = [one.name for one in fields(kind)]
        if name not in known:
            _fail(field, value, f"a {told['model']} has no '{name}'; it has {', '.join(known)}")
        if isinstance(number, bool) or not isinstance(number, (int, float)):
            _fail(field, value, f"'{name}' must be a number")
    try:
        return kind(**numbers)
    except ValueError as error:
        raise ScenarioError(f"scenario field '{field}' = {value!r}: {error}") from None


def _build(values: dict[str, Any]) -> Scenario:
    _check_fields(values)
    values = {name: _model(name, value) if name in _MODELS else value for name, value in values.items()}
    _check_values(values)
    for name in _SHAPES:
        if values.get(name) is not None:
            array = np.asarray(values[name], dtype=float)
            # Only `obstacle_starts` may be empty.
            values[name] = jnp.asarray(array if array.size else array.reshape(0, 2), dtype=float)
    for starts, count in _STARTS.items():
        if values.get(starts) is None:
            continue
        given = len(values[starts])
        wanted = values.setdefault(count, given)
        if wanted > given:
            _fail(count, wanted, f"only {given} fixed starts are given in '{starts}'; give {wanted}, or none")
        values[starts] = values[starts][:wanted]
    for count in _COUNTS:
        if count in values:
            values[count] = int(values[count])
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


@eqx.filter_jit
def _some_start_exists(scenario: Scenario) -> jax.Array:
    keys = jax.random.split(jax.random.key(0), 4096)
    return jnp.any(jax.vmap(lambda key: scenario.accepts(scenario._draw(key)))(keys))


def load_scenario(name_or_path: str | Path, **overrides: Any) -> Scenario:
    """A validated scenario: a preset (a key of `PRESETS`) or a TOML or JSON file, with overrides.

    A file holds fields of `Scenario`; an optional `preset` names the one it starts from (`paper`
    otherwise). A run's `config.json` can be given too: its `scenario` entry is used. Reducing
    `obstacle_count` or `pursuer_count` below the fixed starts keeps the first ones. The robots that fly are
    known by name, in files too: `evader_model = "quadrotor"`, `pursuer_model = {model = "aircraft",
    turning_radius = 3.0}`. In files and overrides alike, `wheel_separation` (m, what data sheets of
    differential drives print) may stand for `pursuer_half_axle`, which is half of it.

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
    """`values` with `changes`; starts that are given anew bring their own number with them."""
    kept, changes = dict(values), without_aliases(changes)
    for starts, count in _STARTS.items():
        if changes.get(starts) is not None:
            kept.pop(count, None)
    return {**kept, **changes}


def scenario_to_dict(scenario: Scenario) -> dict[str, Any]:
    """All fields as plain JSON values; `load_scenario` rebuilds the same scenario from them.

    Robots of one's own (`evader_model`, `pursuer_model`) are code, and stand there as text that says what
    they were: `load_scenario` then asks for them. Those known by name it finds by itself.
    """

    def plain(value: Any) -> Any:
        for name, kind in _NAMED.items():
            if isinstance(value, kind):
                return {"model": name, **{one.name: plain(getattr(value, one.name)) for one in fields(value)}}
        if isinstance(value, (jax.Array, np.ndarray)):
            # The shortest decimal that rounds to the stored float: 0.1574, not 0.15739999711513519.
            return np.asarray(value).astype(str).astype(float).tolist()
        return repr(value) if isinstance(value, tuple(_MODELS.values())) else value

    return {field.name: plain(getattr(scenario, field.name)) for field in fields(scenario)}
