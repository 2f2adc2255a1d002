"""What does an episode on the twin look like? Frames and a video, rendered without a screen."""

from __future__ import annotations

import math
from collections.abc import Iterator
from contextlib import closing
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float, UInt8

from sidestep.bridges.twin.episode import TwinEpisode
from sidestep.bridges.twin.library import load_av, load_mujoco, make_renderer
from sidestep.bridges.twin.twin import Twin
from sidestep.views.style import EVADER, OBSTACLE, PURSUER, TARGET
from sidestep.views.video_files import write_video_file

_SIZE = (540, 960)
_RING = 72
_MOST_DECOR = 2000
_TRAIL_STEP = 0.012
_TILT = math.radians(-52.0)
_LINE, _FLAT, _TALL = 0.0045, 0.0008, 0.15


def _rgba(colour: str, alpha: float = 1.0) -> Float[np.ndarray, "4"]:
    return np.array([*(int(colour[i : i + 2], 16) / 255.0 for i in (1, 3, 5)), alpha], np.float32)


class _Decor:
    """Draws what is not a body: distances, paths, the target."""

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

    def disc(self, place: Any, radius: float, rgba: Any) -> None:
        """A flat disc on the floor."""
        self._cylinder(place, 0.002, radius, _FLAT, rgba)

    def post(self, place: Any, radius: float, height: float, rgba: Any) -> None:
        """An upright post."""
        self._cylinder(place, height / 2.0, radius, height / 2.0, rgba)

    def line(self, points: Float[np.ndarray, "n 2"], height: float, width: float, rgba: Any) -> None:
        """A line on the floor through these points."""
        kind = self._mujoco.mjtGeom.mjGEOM_CAPSULE
        for start, end in pairwise(points):
            geom = self._next()
            if geom is None:
                return
            self._mujoco.mjv_initGeom(geom, kind, np.zeros(3), np.zeros(3), np.eye(3).ravel(), rgba)
            self._mujoco.mjv_connector(
                geom, kind, width, np.array([*start, height]), np.array([*end, height])
            )

    def ring(self, place: Any, radius: float, rgba: Any) -> None:
        """A circle on the floor."""
        angles = np.linspace(0.0, 2.0 * math.pi, _RING + 1)
        circle = np.asarray(place)[:2] + radius * np.stack([np.cos(angles), np.sin(angles)], axis=-1)
        self.line(circle, 0.003, _LINE, rgba)


def _thinned(path: Float[np.ndarray, "n 2"]) -> Float[np.ndarray, "m 2"]:
    """A path with points about a centimetre apart."""
    gone = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(path, axis=0), axis=-1))])
    kept = np.unique(np.searchsorted(gone, np.arange(0.0, gone[-1], _TRAIL_STEP)))
    return path[np.append(kept, len(path) - 1)]


def _camera(mujoco: Any, points: Float[np.ndarray, "n 2"], margin: float, field: float, aspect: float) -> Any:
    """Looks down slantwise from the side of negative y, from as near as shows everything.

    **Arguments:** `points` (m) to be seen with `margin` (m) around them; `field` of view from top to bottom
    (rad); `aspect` width over height.
    """
    low, high = points.min(axis=0) - margin, points.max(axis=0) + margin
    middle = np.array([*(low + high) / 2.0, 0.0])
    corners = np.array(
        [[x, y, z] for x in (low[0], high[0]) for y in (low[1], high[1]) for z in (0.0, _TALL)]
    )
    ahead = np.array([0.0, math.cos(_TILT), math.sin(_TILT)])
    up = np.array([0.0, -math.sin(_TILT), math.cos(_TILT)])
    across, upward = np.abs((corners - middle)[:, 0]), np.abs((corners - middle) @ up)
    # |offset| <= tan(half the field) (distance + depth), solved for the distance.
    reach = np.maximum(across / aspect, upward) / math.tan(field / 2.0)
    camera = mujoco.MjvCamera()
    camera.lookat[:] = middle
    camera.azimuth, camera.elevation = 90.0, math.degrees(_TILT)
    camera.distance = float(np.max(reach - (corners - middle) @ ahead))
    return camera


def frames_of(
    episode: TwinEpisode, times: Float[np.ndarray, "n"], size: tuple[int, int] = _SIZE
) -> Iterator[UInt8[np.ndarray, "height width 3"]]:
    """The scene at these times (s), rendered off-screen; `size` is height and width in pixels.

    Circles are the capture distance around each pursuer, the collision distance around each obstacle and the
    distance that counts as reached around the target; lines are the ways taken so far.

    **Raises** `TwinError` naming the Debian packages when this machine cannot render.
    """
    mujoco = load_mujoco()
    twin = Twin(episode.scenario, episode.options, episode.seed)
    scenario = episode.scenario
    capture, collision = float(scenario.capture_distance), float(scenario.collision_distance)
    target = np.asarray(episode.trajectory.worlds.target)[0]
    paths = twin.poses_of(episode.frames)[..., :2]
    pursuers = scenario.pursuer_count
    points = np.concatenate([paths.reshape(-1, 2), target[None]])
    field = math.radians(float(twin.model.vis.global_.fovy))
    camera = _camera(mujoco, points, max(capture, collision) + 0.05, field, size[1] / size[0])
    evader, pursuer, obstacle, green = map(_rgba, (EVADER, PURSUER, OBSTACLE, TARGET))
    with closing(make_renderer(twin.model, *size, _MOST_DECOR)) as renderer:
        for time in times:
            frame = min(int(np.searchsorted(episode.frame_times, time)), len(episode.frames) - 1)
            twin.data.qpos[:] = episode.frames[frame]
            mujoco.mj_kinematics(twin.model, twin.data)
            mujoco.mj_camlight(twin.model, twin.data)
            renderer.update_scene(twin.data, camera)
            decor = _Decor(mujoco, renderer.scene)
            here = paths[frame]
            decor.disc(target, float(scenario.reach_distance), green)
            decor.post(target, 0.006, 0.16, green)
            for place in here[1 : 1 + pursuers]:
                decor.ring(place, capture, pursuer)
            for place in here[1 + pursuers :]:
                decor.ring(place, collision, obstacle)
            for robot, colour in enumerate([evader, *[pursuer] * pursuers]):
                decor.line(_thinned(paths[: frame + 1, robot]), 0.004, 0.0055, colour)
            yield renderer.render()


def write_video(
    episode: TwinEpisode,
    path: str | Path,
    *,
    rate: int = 25,
    speed: float = 1.0,
    size: tuple[int, int] = _SIZE,
) -> Path:
    """Write an episode as an MP4 video (H.264) of `rate` frames per second, `speed` times as fast as it was.

    It ends with one second of the last frame. **Raises** `TwinError` when PyAV or off-screen rendering is
    missing, and as `write_video_file`.
    """
    load_av()
    times = np.arange(0.0, episode.frame_times[-1], speed / rate)
    frames = frames_of(episode, np.append(times, episode.frame_times[-1]), size)
    return write_video_file(path, frames, rate, hold=1.0)
