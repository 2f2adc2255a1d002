"""RViz markers of a decision."""

import math
from typing import Any

import numpy as np
from builtin_interfaces.msg import Duration
from geometry_msgs.msg import Point, Vector3
from std_msgs.msg import ColorRGBA
from visualization_msgs.msg import Marker, MarkerArray

from sidestep_ros.messages import quaternion_of

_ARC = 16
_ARROW_SECONDS = 2.0
_COLOURS = {
    "capture set": (0.80, 0.15, 0.15, 0.9),
    "capture distance": (0.80, 0.15, 0.15, 0.4),
    "collision distance": (0.45, 0.35, 0.10, 0.8),
    "evader": (0.00, 0.45, 0.45, 1.0),
    "nominal": (0.55, 0.55, 0.55, 0.9),
    "safe": (0.00, 0.60, 0.30, 1.0),
    "plan": (0.20, 0.40, 0.90, 0.8),
    "target": (0.90, 0.70, 0.00, 1.0),
}
_LINE = 0.01


def circle(radius: float) -> list[tuple[float, float]]:
    """A closed circle about the origin, m."""
    angles = [2.0 * math.pi * i / (4 * _ARC) for i in range(4 * _ARC + 1)]
    return [(radius * math.cos(angle), radius * math.sin(angle)) for angle in angles]


def capture_set(capture_distance: float, speed_ratio: float) -> list[tuple[float, float]]:
    """Outline (m) of K(l) in the pursuer's frame, x ahead: the hull of the disc of radius l and (+-l/rho, 0).

    For rho >= 1 (the evader is at least as fast) it is the disc.
    """
    if speed_ratio >= 1.0:
        return circle(capture_distance)
    usable = math.acos(speed_ratio)
    steps = [usable + (math.pi - 2.0 * usable) * i / (2 * _ARC) for i in range(2 * _ARC + 1)]
    left = [(capture_distance * math.cos(angle), capture_distance * math.sin(angle)) for angle in steps]
    tip = (capture_distance / speed_ratio, 0.0)
    right = [(-x, -y) for x, y in left]
    return [tip, *left, (-tip[0], 0.0), *right, tip]


class Painter:
    """Markers of one scenario. Outlines are computed once; only their poses change."""

    def __init__(self, scenario: Any, frame: str, period: float):
        self._frame = frame
        seconds = max(3.0 * period, 0.5)
        self._lifetime = Duration(sec=int(seconds), nanosec=int(1e9 * (seconds % 1.0)))
        ratio = float(scenario.evader_speed) / float(scenario.pursuer_speed)
        capture = float(scenario.capture_distance)
        self._capture_set = self._points(capture_set(capture, ratio))
        self._capture = self._points(circle(capture))
        self._collision = self._points(circle(float(scenario.collision_distance)))

    def paint(self, stamp: Any, decision: Any, target: tuple[float, float] | None) -> MarkerArray:
        """Markers of a decision, and of the `target` if there is one; none without an estimated world."""
        world = decision.world
        if world is None:
            return MarkerArray()
        markers = []
        for i, (x, y, heading) in enumerate(_rows(world.pursuers)):
            markers += [
                self._line("capture set", i, stamp, self._capture_set, (x, y), heading),
                self._line("capture distance", i, stamp, self._capture, (x, y)),
            ]
        for i, (x, y, *_) in enumerate(_rows(world.obstacles)):
            markers.append(self._line("collision distance", i, stamp, self._collision, (x, y)))
        start = tuple(np.asarray(world.evader, float).tolist())
        markers.append(self._dot("evader", stamp, start))
        for name, velocity in (("nominal", decision.nominal), ("safe", decision.velocity)):
            markers.append(self._arrow(name, stamp, start, velocity))
        if len(decision.plan) > 1:
            plan = self._points(_rows(decision.plan))
            markers.append(self._line("plan", 0, stamp, plan, (0.0, 0.0)))
        if target is not None:
            markers.append(self._dot("target", stamp, target))
        return MarkerArray(markers=[marker for marker in markers if marker is not None])

    def _points(self, outline: Any) -> list[Point]:
        return [Point(x=float(x), y=float(y)) for x, y in outline]

    def _marker(self, name: str, number: int, kind: int, stamp: Any) -> Marker:
        red, green, blue, alpha = _COLOURS[name]
        marker = Marker(
            ns=name, id=number, type=kind, action=Marker.ADD, lifetime=self._lifetime,
            color=ColorRGBA(r=red, g=green, b=blue, a=alpha),
        )  # fmt: skip
        marker.header.frame_id = self._frame
        marker.header.stamp = stamp
        return marker

    def _line(
        self, name: str, number: int, stamp: Any, points: list[Point], where: Any, heading: float = 0.0
    ) -> Marker | None:
        if not all(map(math.isfinite, (*where, heading))):
            return None
        marker = self._marker(name, number, Marker.LINE_STRIP, stamp)
        marker.scale.x = _LINE
        marker.points = points
        marker.pose.position.x, marker.pose.position.y = where
        marker.pose.orientation = quaternion_of(heading)
        return marker

    def _dot(self, name: str, stamp: Any, where: Any) -> Marker | None:
        if not all(map(math.isfinite, where)):
            return None
        marker = self._marker(name, 0, Marker.SPHERE, stamp)
        marker.scale = Vector3(x=0.06, y=0.06, z=0.06)
        marker.pose.position.x, marker.pose.position.y = where
        return marker

    def _arrow(self, name: str, stamp: Any, start: Any, velocity: Any) -> Marker | None:
        vx, vy = map(float, velocity)
        if not all(map(math.isfinite, (*start, vx, vy))):
            return None
        marker = self._marker(name, 0, Marker.ARROW, stamp)
        marker.scale = Vector3(x=0.015, y=0.04, z=0.05)
        # The arrow's length is the distance driven in 2 s.
        end = start[0] + _ARROW_SECONDS * vx, start[1] + _ARROW_SECONDS * vy
        marker.points = self._points([start, end])
        return marker


def _rows(array: Any) -> list[tuple[float, ...]]:
    # JAX would compile the iteration.
    return [tuple(row) for row in np.asarray(array, float).tolist()]
