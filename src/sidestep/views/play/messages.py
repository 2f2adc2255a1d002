"""The messages of a visitor, with their validation."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Annotated, Literal

import msgspec
from msgspec import Meta

from sidestep._bounds import one_of, taken
from sidestep.safety.shields.catalogue import SHIELDS
from sidestep.views.play.control import STRATEGIES
from sidestep.views.play.sliders import PACES, YOU, Slider

FARTHEST = 50.0
"""Largest distance (m) of a position from the origin."""
Share = Annotated[float, Meta(ge=-1.0, le=1.0)]
Metres = Annotated[float, Meta(ge=-FARTHEST, le=FARTHEST)]
Place = tuple[Metres, Metres]
Pose = tuple[Metres, Metres, Metres]
Drifting = tuple[Metres, Metres, Metres, Metres]


class MessageError(ValueError):
    """An invalid message; the text says why."""


class _Message(msgspec.Struct, forbid_unknown_fields=True, tag=str.lower):
    """A JSON object with these entries, and the lower-case name of the class as its `type`."""


class Drive(_Message):
    """Drive to a point (m), or with shares in [-1, 1] of the left and right wheel speed, or stop."""

    wheels: tuple[Share, Share] | None = None
    toward: Place | None = None


class Seen(_Message):
    """Acknowledges the last frame that has been drawn."""

    frame: Annotated[int, Meta(ge=0, le=2**53)]


class Pause(_Message):
    """Pause or continue."""

    paused: bool


class Step(_Message):
    """Advance by one control period while paused."""


class Pace(_Message):
    """Set the simulated seconds per second."""

    pace: Annotated[float, Meta(ge=PACES[0], le=PACES[1])]


class Reset(_Message):
    """Begin a new episode; `again`: with the same start."""

    again: bool = False


class Pick(_Message):
    """Choose another shield or pursuer."""

    shield: str | None = None
    pursuer: str | None = None


class Numbers(_Message, tag="set"):
    """Values of moved sliders, by name; `defaults`: all others are reset."""

    values: dict[str, float] = msgspec.field(default_factory=dict)
    defaults: bool = False


class Move(_Message):
    """Move a robot to a position (m), or rotate it (rad)."""

    what: Literal["evader", "target", "pursuer", "obstacle"]
    to: Place
    index: Annotated[int, Meta(ge=0)] = 0
    heading: Annotated[float, Meta(ge=-7.0, le=7.0)] | None = None


class Show(_Message):
    """Choose the expensive parts of frames."""

    rows: bool
    plan: bool


class Scene(msgspec.Struct, forbid_unknown_fields=True):
    """The positions of all robots: m, rad, m/s."""

    evader: tuple[Place]
    target: tuple[Place]
    pursuers: tuple[Pose, ...]
    obstacles: tuple[Drifting, ...]


class Restore(_Message):
    """Restore the state of a link: shield and pursuer, all changed numbers, and optionally the scene."""

    shield: str | None = None
    pursuer: str | None = None
    values: dict[str, float] = msgspec.field(default_factory=dict)
    scene: Scene | None = None


Message = Drive | Seen | Pause | Step | Pace | Reset | Pick | Numbers | Move | Show | Restore
_DECODER = msgspec.json.Decoder(Message)
_SHIELD, _PURSUER = one_of(*SHIELDS), one_of(YOU, *STRATEGIES)


@dataclass(frozen=True)
class Reader:
    """Reads messages for a scenario with these sliders and numbers of robots."""

    sliders: Mapping[str, Slider]
    pursuers: int
    obstacles: int
    longest: int

    def read(self, text: str | bytes | None) -> Message:
        """The message of one text frame.

        **Raises** `MessageError` for anything else than a message of the protocol.
        """
        if not isinstance(text, str):
            raise MessageError("messages are text")
        # A character may have several bytes; the cheap test comes first.
        if len(text) > self.longest or len(text.encode("utf-8", "replace")) > self.longest:
            raise MessageError(f"a message has at most {self.longest} bytes")
        try:
            message = _DECODER.decode(text)
        except (msgspec.MsgspecError, ValueError, RecursionError) as error:
            raise MessageError(f"not understood: {error}"[:200]) from None
        if isinstance(message, Pick | Restore):
            for name, value, allowed in (
                ("shield", message.shield, _SHIELD), ("pursuer", message.pursuer, _PURSUER)
            ):  # fmt: skip
                if value is not None:
                    taken(name, value, allowed, MessageError)
        if isinstance(message, Numbers | Restore):
            for name, value in message.values.items():
                slider = self.sliders.get(name)
                if slider is None:
                    raise MessageError(f"unknown number: {name[:40]}")
                if not slider.low <= value <= slider.high:
                    raise MessageError(f"{name}: a number from {slider.low:g} to {slider.high:g} is needed")
        if isinstance(message, Move):
            count = {"pursuer": self.pursuers, "obstacle": self.obstacles}.get(message.what, 1)
            if message.index >= count:
                raise MessageError(f"there is no {message.what} {message.index}")
        if isinstance(message, Restore) and message.scene is not None:
            self._check(message.scene)
        return message

    def _check(self, scene: Scene) -> None:
        for name, count in (("pursuers", self.pursuers), ("obstacles", self.obstacles)):
            if len(getattr(scene, name)) != count:
                raise MessageError(f"scene: {count} of {name} are needed here")
        top = self.sliders["obstacle_speed"].high
        if any(math.hypot(*obstacle[2:]) > 1.001 * top for obstacle in scene.obstacles):
            raise MessageError(f"scene: obstacles drift at {top:g} m/s at most")
