"""Robots on sale: their makers' figures, converted to fields of a scenario.

The conversion of a figure of `known_robots.toml` is conservative: an upper bound of what a pursuer can do, a
lower bound for an evader. Guarantees for the model then hold for the robot.

- A differential drive in the model can do every |v| + b|omega| <= V. If the largest rim speed of a wheel is
  known, V is the largest of it, the top speed and b times the top turn rate. Otherwise both limits are
  assumed to be reached together, V = v_max + b omega_max, for any b.
- An evader in the model is equally fast in every direction. Mecanum wheels with speed s straight ahead allow
  |v_x| + |v_y| <= s, so s/sqrt(2) in every direction.
"""

from __future__ import annotations

import functools
import math
import tomllib
from collections.abc import Mapping
from dataclasses import dataclass
from importlib.resources import files
from typing import Any

from sidestep.world.field_names import ScenarioError

ROLES = ("pursuer", "evader")

_IN_EVERY_DIRECTION = {"mecanum": math.sqrt(0.5)}
"""The share of the printed speed that a drive reaches in every direction."""

_SEPARATION, _ARENA = 3.0, 15.0
"""Separation of random starts, and side of their square, over the capture distance, as in the paper."""


@dataclass(frozen=True)
class KnownRobot:
    """One robot of `known_robots.toml`. SI units.

    - `role` `"pursuer"` or `"evader"`; `drive` of an evader
    - `radius` (m) of the circle about the tracked point that contains its outline
    - `figures` each with `value`, `sources` and, if it is not printed directly, `how` it was found
    - `unknown` figures that no source states
    """

    name: str
    title: str
    role: str
    drive: str
    figures: Mapping[str, Mapping[str, Any]]
    unknown: str

    def figure(self, name: str) -> float:
        """A figure's value. **Raises** `KeyError` for an unknown figure."""
        return self.figures[name]["value"]

    @property
    def radius(self) -> float:
        """m."""
        return self.figure("radius")

    @property
    def half_axle(self) -> float:
        """b of a pursuer, m."""
        return self.figure("wheel_separation") / 2.0

    @property
    def speed(self) -> float:
        """V of a pursuer (wheel rim), v_e of an evader (in every direction), m/s; see the module."""
        top = self.figure("speed")
        if self.role == "evader":
            return top * _IN_EVERY_DIRECTION[self.drive]
        if "wheel_speed" in self.figures:
            return self.figure("wheel_speed")
        return top + self.half_axle * self.figure("turn_rate")

    @property
    def reason(self) -> str:
        """How `speed` follows from the figures, in words."""
        top = self.figure("speed")
        if self.role == "evader":
            return f"{top:g} m/s straight ahead, {self.drive} wheels: {self.speed:.4g} m/s in every direction"
        limits = f"{top:g} m/s and {self.figure('turn_rate'):g} rad/s"
        if "wheel_speed" in self.figures:
            return f"{limits}, no wheel faster than {self.speed:.4g} m/s"
        return f"{limits}, taken to be reached together: V = v + b omega"

    @property
    def fields(self) -> dict[str, Any]:
        """The fields of a scenario that this robot sets."""
        if self.role == "evader":
            return {"evader_speed": self.speed, "evader_model": None}
        return {"pursuer_speed": self.speed, "pursuer_half_axle": self.half_axle, "pursuer_model": None}


@functools.cache
def known_robots() -> dict[str, KnownRobot]:
    """All robots of `known_robots.toml` by name."""
    content = tomllib.loads(files("sidestep.world").joinpath("known_robots.toml").read_text("utf-8"))
    sources = content["sources"]

    def figure(entry: Mapping[str, Any]) -> dict[str, Any]:
        return {**entry, "sources": tuple(sources[key] for key in entry["sources"])}

    return {
        name: KnownRobot(
            name=name,
            title=entry["title"],
            role=entry["role"],
            drive=entry.get("drive", "differential"),
            figures={key: figure(value) for key, value in entry.items() if isinstance(value, dict)},
            unknown=entry["unknown"],
        )
        for name, entry in content["robots"].items()
    }


def find_robot(name: str, role: str) -> KnownRobot:
    """The robot of that name. **Raises** `ScenarioError` for an unknown name, or a robot of another role."""
    named = {robot.name: robot for robot in known_robots().values() if robot.role == role}
    if name not in named:
        other = known_robots().get(name)
        why = f"it is {'an' if other.role == 'evader' else 'a'} {other.role}" if other else "it is not known"
        raise ScenarioError(f"{role} = {name!r}: {why}; known {role}s: {', '.join(named)}")
    return named[name]


def robot_fields(pursuer: str | None = None, evader: str | None = None) -> dict[str, Any]:
    """Scenario fields of robots on sale: `load_scenario("paper", **robot_fields("create3", "dingo-o"))`.

    With both robots, the capture distance is the sum of their radii (m), and separations of random starts are
    in the same ratio to it as in the paper. Other fields, such as obstacles, do not change.

    **Raises** `ScenarioError` for an unknown name, or a robot of the other role.
    """
    robots = [find_robot(name, role) for role, name in zip(ROLES, (pursuer, evader), strict=True) if name]
    fields = {key: value for robot in robots for key, value in robot.fields.items()}
    if len(robots) == 2:
        contact = sum(robot.radius for robot in robots)
        fields |= {
            "capture_distance": contact,
            "initial_separation": _SEPARATION * contact,
            "arena_side": _ARENA * contact,
        }
    return fields
