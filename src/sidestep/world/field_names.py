"""Names that data sheets use for scenario fields, as aliases or as hints in error messages."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any

from sidestep._bounds import Bound, did_you_mean, taken


class ScenarioError(ValueError):
    """A scenario that cannot be run: the message names the field, its value and what is allowed."""


ALIASES: dict[str, tuple[str, float]] = {"wheel_separation": ("pursuer_half_axle", 0.5)}
"""Alias -> field, and the factor on its value."""

_SPEEDS = (
    "say whose: 'evader_speed' (in every direction) or 'pursuer_speed' (the largest rim speed of a wheel, "
    "|v| + b|omega|)"
)
_TRACK = "the distance between a pursuer's left and right wheels is 'wheel_separation'"
_SIZE = (
    "distances are between centres: 'capture_distance' (to touch: the sum of both robots' radii) and "
    "'collision_distance' (evader and obstacle)"
)
_TURNING = (
    "a differential drive turns at up to 'pursuer_speed' / 'pursuer_half_axle'; other robots are covered "
    "by a larger 'pursuer_speed', see docs/certificate.md"
)
_PERIOD = "the time between two decisions is 'control_period', in s"
_ERRORS = (
    "errors and delays are not part of a scenario: they are options of certify (--position-error, "
    "--heading-error, --delay, --tracking-error) and of sidestep.safety.Budget"
)
_ADVICE = {
    **dict.fromkeys(
        (
            "speed", "max_speed", "maximum_speed", "top_speed", "velocity", "max_velocity", "max_vel",
            "max_vel_x", "max_linear_velocity", "maximum_linear_velocity", "linear_velocity", "v_max",
            "max_translational_velocity", "maximum_translational_velocity",
        ),
        _SPEEDS,
    ),
    **dict.fromkeys(
        (
            "wheel_speed", "rim_speed", "max_wheel_speed", "wheel_velocity", "pursuer_max_speed",
            "pursuer_velocity", "pursuer_top_speed",
        ),
        "the largest rim speed of the pursuer's wheels is 'pursuer_speed'",
    ),
    **dict.fromkeys(
        ("evader_max_speed", "evader_velocity", "evader_top_speed", "robot_speed"),
        "the evader's speed in every direction is 'evader_speed'",
    ),
    **dict.fromkeys(
        (
            "track", "track_width", "wheel_track", "wheel_distance", "wheels_separation", "wheel_spacing",
            "axle_length", "axle_width", "axle_track", "distance_between_wheels", "half_axle", "axle",
        ),
        f"{_TRACK}; half of it is 'pursuer_half_axle'",
    ),
    **dict.fromkeys(
        ("wheelbase", "wheel_base"),
        f"{_TRACK}, if that is meant; the distance from front to rear axle is not used",
    ),
    **dict.fromkeys(
        (
            "radius", "robot_radius", "evader_radius", "pursuer_radius", "footprint", "diameter", "length",
            "width", "size", "capture_radius", "collision_radius", "safety_distance",
        ),
        _SIZE,
    ),
    **dict.fromkeys(
        (
            "omega_max", "max_omega", "turn_rate", "max_turn_rate", "yaw_rate", "max_yaw_rate",
            "angular_velocity", "max_angular_velocity", "maximum_angular_velocity", "max_vel_theta",
            "max_rotational_velocity", "maximum_rotational_velocity", "turning_radius",
        ),
        _TURNING,
    ),
    **dict.fromkeys(
        ("period", "dt", "time_step", "timestep", "rate", "frequency", "hz", "control_rate", "sample_time"),
        _PERIOD,
    ),
    **dict.fromkeys(
        ("delay", "latency", "position_error", "heading_error", "tracking_error", "noise", "sensor_noise"),
        _ERRORS,
    ),
    **dict.fromkeys(
        ("target_radius", "goal_radius", "goal_tolerance", "goal_distance", "arrival_distance"),
        "a target counts as reached from 'reach_distance' on",
    ),
    **dict.fromkeys(
        ("arena", "arena_size", "arena_width", "world_size"),
        "the square that starts and targets are drawn in is 'arena_side'",
    ),
}  # fmt: skip
"""Hints for common names that are not fields and whose spelling is not near to the right field."""


def without_aliases(values: Mapping[str, Any], *, zero: bool = False) -> dict[str, Any]:
    """`values` with aliases replaced by fields: `wheel_separation=0.16` becomes `pursuer_half_axle=0.08`.

    **Arguments:** `zero` whether 0 is allowed (for certificates only).

    **Raises** `ScenarioError` for a value that is not a number above 0, or an alias together with its field.
    """
    plain = dict(values)
    for alias, (field, factor) in ALIASES.items():
        if alias not in plain:
            continue
        value = plain.pop(alias)
        if field in plain:
            raise ScenarioError(
                f"'{alias}' = {value!r} and '{field}' = {plain[field]!r} are both given, but they are "
                f"equivalent ('{field}' is {factor:g} times '{alias}'): give one of them"
            )
        bound = Bound(least=0.0) if zero else Bound(above=0.0)
        try:
            plain[field] = factor * taken(f"scenario field '{alias}'", value, bound)
        except ValueError as error:
            raise ScenarioError(str(error)) from None
    return plain


def unknown_field(name: str, known: Iterable[str]) -> str:
    """The error message for a name that is neither a field nor an alias."""
    names = sorted([*known, *ALIASES])
    meant = _ADVICE.get(name.lower().replace("-", "_"))
    hint = f": {meant}." if meant else did_you_mean(name, names)
    return f"unknown scenario field '{name}'{hint} Known fields: {', '.join(names)}."
