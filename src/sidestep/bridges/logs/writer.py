"""Write a log while a simulation, twin, node or robot runs."""

from __future__ import annotations

import contextlib
import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np

import sidestep
from sidestep._arrays import AnyArray
from sidestep._packages import needed
from sidestep.bridges.logs import messages
from sidestep.safety import Status
from sidestep.store.files import OutputError, is_stream, json_safe, writing
from sidestep.world import Scenario
from sidestep.world.loading import scenario_to_dict

METADATA = "sidestep"
"""Name of the metadata record."""
FRAME = "map"
"""Default frame of all poses and velocities: world axes."""
Numbers: TypeAlias = Sequence[float] | AnyArray
"""A few numbers: a list, or an array of NumPy or JAX."""
_CHUNK = 32_768
_LEVELS = {Status.OK: 0, Status.CORRECTED: 0, Status.INFEASIBLE: 1, Status.INVALID: 2}


class LogWriter:
    """Writes an MCAP file of ROS 2 messages; a context manager.

    Times are in s, of any clock that does not run backwards; positions in m, velocities in m/s, in the axes
    of `frame`. Data reaches the disk in chunks of 32 kB, about one second of a robot's messages. A file cut
    off by a crash lacks at most the last chunk, and `load_log` reads the rest.

    **Arguments:** `scenario` and `about` (shield, policy, pursuer, seed, source) are stored as metadata.

    **Raises** `ValueError` if `path` exists and `overwrite` is not set, or if mcap is not installed;
    `OutputError`, a `ValueError` too, when the system refuses to write.
    """

    def __init__(
        self,
        path: str | Path,
        scenario: Scenario,
        about: Mapping[str, Any] | None = None,
        *,
        frame: str = FRAME,
        overwrite: bool = False,
    ):
        ros2 = needed("mcap_ros2.writer", "logs", "logs need")
        self.path = Path(path)
        refuse_existing(path, overwrite)
        self._frame = frame
        with writing(self.path):
            self.path.parent.mkdir(parents=True, exist_ok=True)
            self._file = open(self.path, "wb")  # noqa: SIM115
        self._schemas: dict[str, Any] = {}
        self._counts: dict[str, int] = {}
        record = {
            "sidestep": sidestep.__version__,
            "scenario": json.dumps(scenario_to_dict(scenario)),
            "about": json.dumps(json_safe(about or {})),
        }
        try:
            with writing(self.path):
                self._writer = ros2.Writer(self._file, chunk_size=_CHUNK)
                self._writer.add_metadata(METADATA, record)
                self._file.flush()
        except BaseException:
            self._give_up()
            if not is_stream(self.path):
                self.path.unlink(missing_ok=True)
            raise

    def __enter__(self) -> LogWriter:
        return self

    def __exit__(self, *error: object) -> None:
        try:
            self.close()
        except OutputError:
            # Report the first error.
            if error[0] is None:
                raise

    def close(self) -> None:
        """Write the index for random access and close the file. A second call does nothing."""
        if self._file.closed:
            return
        try:
            with writing(self.path):
                self._writer.finish()
                self._file.close()
        except OutputError:
            self._give_up()
            raise

    def _give_up(self) -> None:
        # Closing tries to write once more, and closes the file even if that fails.
        with contextlib.suppress(OSError):
            self._file.close()

    def write(self, topic: str, kind: str, stamp: float, message: Mapping[str, Any]) -> None:
        """Write a message of a kind defined in `messages`."""
        if kind not in self._schemas:
            self._schemas[kind] = self._writer.register_msgdef(kind, messages.definition(kind))
        count = self._counts.get(topic, 0)
        self._counts[topic] = count + 1
        with writing(self.path):
            self._writer.write_message(
                topic, self._schemas[kind], message, log_time=messages.nanoseconds(stamp), sequence=count
            )
            # A complete chunk goes to the operating system, so it survives a crash of this process.
            self._file.flush()

    def pose(
        self,
        robot: str,
        stamp: float,
        pose: Numbers,
        index: int = 0,
        velocity: Numbers | None = None,
    ) -> None:
        """The pose of a robot: `robot` is `"evader"`, `"pursuer"` or `"obstacle"`; `pose` is x, y (m) and
        optionally a heading (rad); `velocity` (m/s) if known.

        Topics `/evader/pose`, `/pursuer_0/pose`, `/obstacle_0/pose`, `/obstacle_0/velocity` and so on.
        """
        name = "evader" if robot == "evader" else f"{robot}_{index}"
        x, y, heading = (*_plain(pose), 0.0)[:3]
        self.write(f"/{name}/pose", messages.POSE, stamp, messages.pose(stamp, x, y, heading, self._frame))
        if velocity is not None:
            self._twist(f"/{name}/velocity", stamp, velocity)

    def target(self, stamp: float, target: Numbers) -> None:
        """The evader's target (m). Topic `/target`."""
        x, y = _plain(target)
        message = messages.pose(stamp, x, y, 0.0, self._frame)
        self.write("/target", messages.POSE, stamp, message)

    def wheels(self, stamp: float, speeds: Numbers, index: int = 0) -> None:
        """A pursuer's commanded rim speeds (left, right; m/s). Topics `/pursuer_0/wheel_speeds` and so on."""
        message = messages.numbers(("left", "right"), _plain(speeds))
        self.write(f"/pursuer_{index}/wheel_speeds", messages.NUMBERS, stamp, message)

    def driven(self, stamp: float, speeds: Numbers, index: int = 0) -> None:
        """A pursuer's driven rim speeds (left, right; m/s) of the past period. Topics `/pursuer_0/driven` and
        so on."""
        self.write(
            f"/pursuer_{index}/driven",
            messages.NUMBERS,
            stamp,
            messages.numbers(("left", "right"), _plain(speeds)),
        )

    def decision(
        self,
        stamp: float,
        *,
        nominal: Numbers,
        velocity: Numbers,
        status: int,
        slack: float,
        intervention: float,
        barriers: Numbers,
        level: str = "normal",
        reactions: Sequence[str] = (),
        **more: float,
    ) -> None:
        """The nominal action and the shield's answer; `more` holds other numbers, such as `latency`.

        Topics `/cmd_vel_nominal`, `/cmd_vel`, `/diagnostics`, and `/shield` with the numbers: status, slack,
        intervention, those of `more`, and the barriers h0, h1, ... (m; pursuers first).
        """
        self._twist("/cmd_vel_nominal", stamp, nominal)
        self._twist("/cmd_vel", stamp, velocity)
        floats = {"slack": slack, "intervention": intervention, **more}
        bars = {f"h{index}": value for index, value in enumerate(_plain(barriers))}
        values = {"status": float(status), **floats, **bars}
        self.write("/shield", messages.NUMBERS, stamp, messages.numbers(list(values), list(values.values())))
        word = Status.NAMES[int(status)]
        severity = max(_LEVELS[int(status)], 0 if level == "normal" else 1)
        message = "; ".join([f"{word}, {level}", *reactions])
        listed = [
            ("status", word),
            ("level", level),
            *((key, f"{value:.6g}") for key, value in floats.items()),
        ]
        self.write(
            "/diagnostics",
            messages.DIAGNOSTICS,
            stamp,
            messages.diagnostics(stamp, severity, message, listed),
        )

    def events(self, stamp: float, events: Mapping[str, float]) -> None:
        """The `Events` of the simulated period that begins at `stamp`. Topic `/events`."""
        self.write("/events", messages.NUMBERS, stamp, messages.numbers(list(events), list(events.values())))

    def world(self, stamp: float, world: Any) -> None:
        """All poses and the target of a `World`."""
        self.pose("evader", stamp, world.evader)
        for index, pose in enumerate(np.asarray(world.pursuers).tolist()):
            self.pose("pursuer", stamp, pose, index)
        for index, (x, y, vx, vy) in enumerate(np.asarray(world.obstacles).tolist()):
            self.pose("obstacle", stamp, (x, y), index, (vx, vy))
        self.target(stamp, world.target)

    def onboard(self, stamp: float, decision: Any) -> None:
        """A `Decision` of `sidestep.robot`, with the estimated world it was made from, if any."""
        if decision.world is not None:
            self.world(stamp, decision.world)
        self.decision(
            stamp,
            nominal=decision.nominal,
            velocity=decision.velocity,
            status=int(decision.status),
            slack=float(decision.slack),
            intervention=float(decision.intervention),
            barriers=decision.barriers,
            level=decision.level,
            reactions=decision.reactions,
            clearance=float(decision.clearance),
            latency=float(decision.latency),
        )

    def _twist(self, topic: str, stamp: float, velocity: Numbers) -> None:
        vx, vy = _plain(velocity)
        self.write(topic, messages.TWIST, stamp, messages.twist(stamp, vx, vy, self._frame))


def refuse_existing(path: str | Path, overwrite: bool) -> None:
    """**Raises** `ValueError` if the file exists and `overwrite` is not set."""
    if Path(path).exists() and not overwrite and not is_stream(path):
        raise ValueError(f"{path} exists already; give the log another name")


def _plain(values: Numbers) -> list[float]:
    return np.asarray(values, float).tolist()
