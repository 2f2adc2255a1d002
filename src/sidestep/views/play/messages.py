"""What may a visitor say? Every message is read here, and nothing unread goes any further."""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

from sidestep.safety.shields.catalogue import SHIELDS
from sidestep.views.play.helm import STRATEGIES
from sidestep.views.play.sliders import Slider

FARTHEST = 50.0
"""m; no place farther from the origin is taken."""
PACES = (0.02, 4.0)
"""Least and most seconds of the world in one second of the visitor's."""
YOU = "you"
"""The pursuer that is the visitor."""


class MessageError(ValueError):
    """A message that is not understood; the text says why."""


@dataclass(frozen=True)
class Drive:
    """`wheels` with shares in [-1, 1] of the left and right one, `point` with a place (m), or `none`."""

    mode: str
    wanted: tuple[float, float]


@dataclass(frozen=True)
class Seen:
    """The last frame that has been drawn."""

    frame: int


@dataclass(frozen=True)
class Pause:
    """Stop or go on."""

    paused: bool


@dataclass(frozen=True)
class Step:
    """One control period while paused."""


@dataclass(frozen=True)
class Pace:
    """Seconds of the world in one second of the visitor's."""

    pace: float


@dataclass(frozen=True)
class Reset:
    """A new start; `again`: the last one once more."""

    again: bool


@dataclass(frozen=True)
class Pick:
    """Another shield or another pursuer."""

    shield: str | None
    pursuer: str | None


@dataclass(frozen=True)
class Numbers:
    """Sliders that were moved, by name; `defaults`: all others back to where they were."""

    values: Mapping[str, float]
    defaults: bool


@dataclass(frozen=True)
class Move:
    """Something was dragged to a place (m), or turned (rad)."""

    what: str
    index: int
    place: tuple[float, float]
    heading: float | None


@dataclass(frozen=True)
class Show:
    """Which parts of a frame that cost something are wanted."""

    rows: bool
    plan: bool


@dataclass(frozen=True)
class Restore:
    """The state of a link: picks, all numbers that differ, and the scene if there is one."""

    pick: Pick
    numbers: Numbers
    scene: Mapping[str, tuple[tuple[float, ...], ...]] | None


Message = Drive | Seen | Pause | Step | Pace | Reset | Pick | Numbers | Move | Show | Restore


@dataclass(frozen=True)
class Reader:
    """Reads the messages of visitors to a scenario with these sliders and so many robots."""

    sliders: Mapping[str, Slider]
    pursuers: int
    obstacles: int
    longest: int

    def read(self, text: str | bytes | None) -> Message:
        """The message of one text frame.

        **Raises** `MessageError` for whatever is not exactly a message of the protocol.
        """
        if not isinstance(text, str):
            raise MessageError("messages are text")
        # Characters may take several bytes; the cheap test comes first.
        if len(text) > self.longest or len(text.encode("utf-8", "replace")) > self.longest:
            raise MessageError(f"a message has at most {self.longest} bytes")
        try:
            value = json.loads(text, parse_constant=_no_constant)
        except (ValueError, RecursionError):
            raise MessageError("a message is one JSON object") from None
        if not isinstance(value, dict):
            raise MessageError("a message is one JSON object")
        kind = value.pop("type", None)
        read = self._readers.get(kind) if isinstance(kind, str) else None
        if read is None:
            raise MessageError("unknown type of message")
        message = read(value)
        if value:
            raise MessageError(f"unknown entries: {', '.join(sorted(value))[:80]}")
        return message

    @property
    def _readers(self) -> dict[str, Callable[[dict[str, Any]], Message]]:
        return {
            "drive": self._drive,
            "seen": lambda value: Seen(_whole(value, "frame", 0, 2**53)),
            "pause": lambda value: Pause(_flag(value, "paused")),
            "step": lambda value: Step(),
            "pace": lambda value: Pace(_number(value.pop("pace", None), "pace", *PACES)),
            "reset": lambda value: Reset(_flag(value, "again", False)),
            "pick": self._pick,
            "set": self._numbers,
            "move": self._move,
            "show": lambda value: Show(_flag(value, "rows"), _flag(value, "plan")),
            "restore": self._restore,
        }

    def _drive(self, value: dict[str, Any]) -> Drive:
        if "wheels" in value:
            left, right = _numbers(value.pop("wheels"), "wheels", 2, -1.0, 1.0)
            return Drive("wheels", (left, right))
        if "toward" in value:
            x, y = _numbers(value.pop("toward"), "toward", 2, -FARTHEST, FARTHEST)
            return Drive("point", (x, y))
        return Drive("none", (0.0, 0.0))

    def _pick(self, value: dict[str, Any]) -> Pick:
        shield, pursuer = value.pop("shield", None), value.pop("pursuer", None)
        if shield is not None:
            _choice(shield, "shield", tuple(SHIELDS))
        if pursuer is not None:
            _choice(pursuer, "pursuer", (YOU, *STRATEGIES))
        return Pick(shield, pursuer)

    def _numbers(self, value: dict[str, Any]) -> Numbers:
        values = value.pop("values", {})
        if not isinstance(values, dict):
            raise MessageError("values: an object of names and numbers is needed")
        checked = {}
        for name, number in values.items():
            slider = self.sliders.get(name)
            if slider is None:
                raise MessageError(f"unknown number: {str(name)[:40]}")
            checked[name] = _number(number, name, slider.low, slider.high)
        return Numbers(checked, _flag(value, "defaults", False))

    def _move(self, value: dict[str, Any]) -> Move:
        what = value.pop("what", None)
        _choice(what, "what", ("evader", "target", "pursuer", "obstacle"))
        count = {"pursuer": self.pursuers, "obstacle": self.obstacles}.get(what, 1)
        if count == 0:
            raise MessageError(f"there is no {what}")
        index = _whole({"index": value.pop("index", 0)}, "index", 0, count - 1)
        x, y = _numbers(value.pop("to", None), "to", 2, -FARTHEST, FARTHEST)
        heading = value.pop("heading", None)
        if heading is not None:
            heading = _number(heading, "heading", -7.0, 7.0)
        return Move(what, index, (x, y), heading)

    def _restore(self, value: dict[str, Any]) -> Restore:
        pick, numbers = self._pick(value), self._numbers(value)
        scene = value.pop("scene", None)
        return Restore(pick, numbers, None if scene is None else self._scene(scene))

    def _scene(self, scene: Any) -> dict[str, tuple[tuple[float, ...], ...]]:
        if not isinstance(scene, dict):
            raise MessageError("scene: an object is needed")
        wanted = {"evader": (1, 2), "target": (1, 2), "pursuers": (self.pursuers, 3),
                  "obstacles": (self.obstacles, 4)}  # fmt: skip
        if set(scene) != set(wanted):
            raise MessageError(f"scene: it must have {', '.join(wanted)} and no more")
        checked = {}
        for name, (count, size) in wanted.items():
            robots = scene[name]
            if not isinstance(robots, list) or len(robots) != count:
                raise MessageError(f"scene: {count} of {name} are needed here")
            checked[name] = tuple(_numbers(one, name, size, -FARTHEST, FARTHEST) for one in robots)
        top = self.sliders["obstacle_speed"].high
        if any(math.hypot(*drift) > 1.001 * top for *_, a, b in checked["obstacles"] for drift in ((a, b),)):
            raise MessageError(f"scene: obstacles drift at {top:g} m/s at most")
        return checked


def _no_constant(name: str) -> float:
    raise ValueError(name)


def _choice(value: Any, name: str, allowed: tuple[str, ...]) -> None:
    if not isinstance(value, str) or value not in allowed:
        raise MessageError(f"{name}: one of {', '.join(allowed)} is needed")


def _flag(value: dict[str, Any], name: str, default: bool | None = None) -> bool:
    flag = value.pop(name, default)
    if not isinstance(flag, bool):
        raise MessageError(f"{name}: true or false is needed")
    return flag


def _number(value: Any, name: str, low: float, high: float) -> float:
    # A whole number too large for a float is compared as it is.
    if isinstance(value, bool) or not isinstance(value, (int, float)) or not low <= value <= high:
        raise MessageError(f"{name}: a number from {low:g} to {high:g} is needed")
    return float(value)


def _whole(value: dict[str, Any], name: str, low: int, high: int) -> int:
    number = value.pop(name, None)
    if isinstance(number, bool) or not isinstance(number, int) or not low <= number <= high:
        raise MessageError(f"{name}: a whole number from {low} to {high} is needed")
    return number


def _numbers(value: Any, name: str, count: int, low: float, high: float) -> tuple[float, ...]:
    if not isinstance(value, list) or len(value) != count:
        raise MessageError(f"{name}: {count} numbers are needed")
    return tuple(_number(one, name, low, high) for one in value)
