"""Shapes drawn in addition to the bodies, and the camera."""

from __future__ import annotations

import math
from itertools import pairwise
from typing import Any, final

import numpy as np
from jaxtyping import Float

_RING = 72
_TRAIL_STEP = 0.012
_LINE, _FLAT = 0.0045, 0.0008


def rgba(colour: str, alpha: float = 1.0) -> Float[np.ndarray, "4"]:
    """Red, green, blue and alpha, 0 to 1, of a colour `#rrggbb`."""
    return np.array([*(int(colour[i : i + 2], 16) / 255.0 for i in (1, 3, 5)), alpha], np.float32)


def mjcf_colour(colour: str, alpha: float = 1.0) -> str:
    """A colour `#rrggbb` in MJCF notation."""
    return " ".join(f"{channel:.4f}" for channel in rgba(colour, alpha))


def studio(*, shadows: int, view: str, tiles: int) -> str:
    """Light, sky and the material of a tiled floor as MJCF: `shadows`, size of the shadow map in pixels;
    `view`, attributes of MJCF's `map`; `tiles` per metre."""
    return f"""\
  <visual>
    <global offwidth="1920" offheight="1200"/>
    <quality shadowsize="{shadows}" offsamples="4"/>
    <map {view}/>
    <headlight ambient="0.4 0.4 0.4" diffuse="0.2 0.2 0.2" specular="0 0 0"/>
  </visual>
  <asset>
    <texture name="sky" type="skybox" builtin="flat" rgb1="1 1 1" width="16" height="16"/>
    <texture name="tiles" type="2d" builtin="flat" mark="edge" rgb1="0.9 0.9 0.89" markrgb="0.7 0.7 0.69"
             width="128" height="128"/>
    <material name="floor" texture="tiles" texrepeat="{tiles} {tiles}" texuniform="true" reflectance="0"
              specular="0"/>
  </asset>"""


@final
class Decor:
    """Draws shapes that are not bodies: distances, paths, the target."""

    def __init__(self, mujoco: Any, scene: Any):
        self._mujoco, self._scene = mujoco, scene

    def _next(self) -> Any:
        if self._scene.ngeom >= self._scene.maxgeom:
            return None
        self._scene.ngeom += 1
        return self._scene.geoms[self._scene.ngeom - 1]

    def _cylinder(self, place: Any, height: float, radius: float, half: float, rgba: Any) -> None:
        geom = self._next()
        if geom is not None:
            centre = np.array([place[0], place[1], height])
            size = np.array([radius, half, 0.0])
            kind = self._mujoco.mjtGeom.mjGEOM_CYLINDER
            self._mujoco.mjv_initGeom(geom, kind, size, centre, np.eye(3).ravel(), rgba)

    def disc(self, place: Any, radius: float, rgba: Any, height: float = 0.002) -> None:
        """A flat disc on the floor, or `height` (m) above it."""
        self._cylinder(place, height, radius, _FLAT, rgba)

    def post(self, place: Any, radius: float, height: float, rgba: Any) -> None:
        """An upright post."""
        self._cylinder(place, height / 2.0, radius, height / 2.0, rgba)

    def line(self, points: Float[np.ndarray, "n 2"], height: float, width: float, rgba: Any) -> None:
        """A line at this height (m) through these points."""
        kind = self._mujoco.mjtGeom.mjGEOM_CAPSULE
        for start, end in pairwise(points):
            geom = self._next()
            if geom is None:
                return
            self._mujoco.mjv_initGeom(geom, kind, np.zeros(3), np.zeros(3), np.eye(3).ravel(), rgba)
            self._mujoco.mjv_connector(
                geom, kind, width, np.array([*start, height]), np.array([*end, height])
            )

    def ring(self, place: Any, radius: float, rgba: Any, height: float = 0.0) -> None:
        """A circle on the floor, or `height` (m) above it."""
        angles = np.linspace(0.0, 2.0 * math.pi, _RING + 1)
        circle = np.asarray(place)[:2] + radius * np.stack([np.cos(angles), np.sin(angles)], axis=-1)
        self.line(circle, height or 0.003, _LINE, rgba)


def thinned(path: Float[np.ndarray, "n 2"]) -> Float[np.ndarray, "m 2"]:
    """The path with points about 1 cm apart."""
    gone = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(path, axis=0), axis=-1))])
    kept = np.unique(np.searchsorted(gone, np.arange(0.0, gone[-1], _TRAIL_STEP)))
    return path[np.append(kept, len(path) - 1)]


def camera_over(
    mujoco: Any,
    points: Float[np.ndarray, "n 2"],
    margin: float,
    field: float,
    aspect: float,
    *,
    tall: float = 0.15,
    tilt: float = math.radians(-52.0),
) -> Any:
    """A camera that looks down from the side of negative y, as near as it can be to show all points.

    **Arguments:** `points` (m) to show, with `margin` (m) around them; vertical `field` of view (rad);
    `aspect`, width over height; `tall`, height (m) of the bodies; `tilt` (rad) of the view.
    """
    low, high = points.min(axis=0) - margin, points.max(axis=0) + margin
    middle = np.array([*(low + high) / 2.0, 0.0])
    corners = np.array([[x, y, z] for x in (low[0], high[0]) for y in (low[1], high[1]) for z in (0.0, tall)])
    ahead = np.array([0.0, math.cos(tilt), math.sin(tilt)])
    up = np.array([0.0, -math.sin(tilt), math.cos(tilt)])
    across, upward = np.abs((corners - middle)[:, 0]), np.abs((corners - middle) @ up)
    # |offset| <= tan(half the field) (distance + depth), solved for the distance.
    reach = np.maximum(across / aspect, upward) / math.tan(field / 2.0)
    camera = mujoco.MjvCamera()
    camera.lookat[:] = middle
    camera.azimuth, camera.elevation = 90.0, math.degrees(tilt)
    camera.distance = float(np.max(reach - (corners - middle) @ ahead))
    return camera
