"""What can robots that are on sale do, by their makers' figures, and what does the model make of that?

A figure of `known_robots.toml` becomes a number of the scenario only where the robot can certainly do no more
(pursuers) or certainly do as much (evaders), so that what is guaranteed in the model is not too much:

- A differential drive in the model takes every |v| + b|omega| <= V. Where the most that a wheel's rim makes
  is known, V is that, at least the top speed and at least b times the top turn rate. Elsewhere both limits
  are taken to be reached together, and V = v_max + b omega_max covers that, whatever b.
- An evader in the model moves as fast in every direction. Mecanum wheels that make s straight ahead allow
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
"""The share of the printed speed that a drive makes in every direction."""

_SEPARATION, _ARENA = 3.0, 15.0
"""Distance of random starts, and side of their square, over the capture distance: as in the paper."""


@dataclass(frozen=True)
class KnownRobot:
    """One robot of `known_robots.toml`. SI units.

    - `role` `"pursuer"` or `"evader"`; `drive` of an evader
    - `radius` (m) of the circle about the tracked point that holds its outline
    - `figures` each with `value`, `sources` and, where it is not simply printed, `how` it was found
    - `unknown` what no source says
    """

    name: str
    title: str
    role: str
    drive: str
    figures: Mapping[str, Mapping[str, Any]]
    unknown: str

    def figure(self, name: str) -> float:
        """A figure's value; `KeyError` where there is none."""
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
    """The robot of that name. **Raises** `ScenarioError` where there is none, or none of that role."""
    named = {robot.name: robot for robot in known_robots().values() if robot.role == role}
    if name not in named:
        other = known_robots().get(name)
        why = f"it is {'an' if other.role == 'evader' else 'a'} {other.role}" if other else "it is not known"
        raise ScenarioError(f"{role} = {name!r}: {why}; known {role}s: {', '.join(named)}")
    return named[name]


def robot_fields(pursuer: str | None = None, evader: str | None = None) -> dict[str, Any]:
    """Fields of robots that are on sale: `load_scenario("paper", **robot_fields("create3", "dingo-o"))`.

    With both, capture is contact, so the capture distance is the sum of their radii (m, between centres), and
    random starts are as far apart for it as in the paper. All else stays the scenario's, obstacles too.

    **Raises** `ScenarioError` for a name that is not known, or that is the other's.
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
