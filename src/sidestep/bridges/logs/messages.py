"""The ROS 2 message definitions of a log.

Names and fields are those of the ROS 2 packages. A log contains them, so that a reader needs no ROS.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from typing import Any, Final

_PARTS: Final = {
    "builtin_interfaces/Time": "int32 sec\nuint32 nanosec",
    "std_msgs/Header": "builtin_interfaces/Time stamp\nstring frame_id",
    "geometry_msgs/Point": "float64 x\nfloat64 y\nfloat64 z",
    "geometry_msgs/Quaternion": "float64 x 0\nfloat64 y 0\nfloat64 z 0\nfloat64 w 1",
    "geometry_msgs/Vector3": "float64 x\nfloat64 y\nfloat64 z",
    "geometry_msgs/Pose": "geometry_msgs/Point position\ngeometry_msgs/Quaternion orientation",
    "geometry_msgs/Twist": "geometry_msgs/Vector3 linear\ngeometry_msgs/Vector3 angular",
    "diagnostic_msgs/KeyValue": "string key\nstring value",
    "diagnostic_msgs/DiagnosticStatus": (
        "byte OK=0\nbyte WARN=1\nbyte ERROR=2\nbyte STALE=3\nbyte level\nstring name\nstring message\n"
        "string hardware_id\ndiagnostic_msgs/KeyValue[] values"
    ),
    "std_msgs/MultiArrayDimension": "string label\nuint32 size\nuint32 stride",
    "std_msgs/MultiArrayLayout": "std_msgs/MultiArrayDimension[] dim\nuint32 data_offset",
}
_MESSAGES: Final = {
    "geometry_msgs/msg/PoseStamped": (
        "std_msgs/Header header\ngeometry_msgs/Pose pose",
        ("std_msgs/Header", "builtin_interfaces/Time", "geometry_msgs/Pose", "geometry_msgs/Point",
         "geometry_msgs/Quaternion"),
    ),
    "geometry_msgs/msg/TwistStamped": (
        "std_msgs/Header header\ngeometry_msgs/Twist twist",
        ("std_msgs/Header", "builtin_interfaces/Time", "geometry_msgs/Twist", "geometry_msgs/Vector3"),
    ),
    "diagnostic_msgs/msg/DiagnosticArray": (
        "std_msgs/Header header\ndiagnostic_msgs/DiagnosticStatus[] status",
        ("std_msgs/Header", "builtin_interfaces/Time", "diagnostic_msgs/DiagnosticStatus",
         "diagnostic_msgs/KeyValue"),
    ),
    "std_msgs/msg/Float64MultiArray": (
        "std_msgs/MultiArrayLayout layout\nfloat64[] data",
        ("std_msgs/MultiArrayLayout", "std_msgs/MultiArrayDimension"),
    ),
}  # fmt: skip

POSE: Final = "geometry_msgs/msg/PoseStamped"
TWIST: Final = "geometry_msgs/msg/TwistStamped"
DIAGNOSTICS: Final = "diagnostic_msgs/msg/DiagnosticArray"
NUMBERS: Final = "std_msgs/msg/Float64MultiArray"


def definition(name: str) -> str:
    """The text of `POSE`, `TWIST`, `DIAGNOSTICS` or `NUMBERS`, with the definitions it depends on."""
    text, parts = _MESSAGES[name]
    return "\n".join([text, *(f"{'=' * 80}\nMSG: {part}\n{_PARTS[part]}" for part in parts)])


def nanoseconds(stamp: float) -> int:
    """A time in s as whole nanoseconds.

    **Raises** `ValueError` outside [0, 2^31) s, the range of MCAP and ROS.
    """
    if not 0.0 <= stamp < 2**31:
        raise ValueError(f"stamp = {stamp!r}: a time in a log must be from 0 to 2^31 s")
    return round(stamp * 1e9)


def _header(stamp: float, frame: str) -> dict[str, Any]:
    seconds, rest = divmod(nanoseconds(stamp), 1_000_000_000)
    return {"stamp": {"sec": seconds, "nanosec": rest}, "frame_id": frame}


def pose(stamp: float, x: float, y: float, heading: float, frame: str) -> dict[str, Any]:
    """A pose in the plane: m, rad."""
    return {
        "header": _header(stamp, frame),
        "pose": {
            "position": {"x": float(x), "y": float(y), "z": 0.0},
            "orientation": {"x": 0.0, "y": 0.0, "z": math.sin(heading / 2.0), "w": math.cos(heading / 2.0)},
        },
    }


def heading_of(orientation: Any) -> float:
    """The heading (rad, in [-pi, pi)) of a quaternion about z."""
    heading = 2.0 * math.atan2(orientation.z, orientation.w)
    return (heading + math.pi) % (2.0 * math.pi) - math.pi


def twist(stamp: float, vx: float, vy: float, frame: str) -> dict[str, Any]:
    """A velocity in the plane: m/s."""
    none = {"x": 0.0, "y": 0.0, "z": 0.0}
    return {
        "header": _header(stamp, frame),
        "twist": {"linear": {"x": float(vx), "y": float(vy), "z": 0.0}, "angular": none},
    }


def diagnostics(stamp: float, level: int, message: str, values: Iterable[tuple[str, Any]]) -> dict[str, Any]:
    """One status of the shield; `level` 0 ok, 1 warning, 2 error."""
    status = {
        "level": level,
        "name": "sidestep: shield",
        "message": message,
        "hardware_id": "evader",
        "values": [{"key": key, "value": str(value)} for key, value in values],
    }
    return {"header": _header(stamp, ""), "status": [status]}


def numbers(names: Sequence[str], data: Sequence[float]) -> dict[str, Any]:
    """Numbers, each with its name as the label of a dimension of size 1."""
    layout = [{"label": name, "size": 1, "stride": 1} for name in names]
    return {"layout": {"dim": layout, "data_offset": 0}, "data": [float(value) for value in data]}
