"""What does a flight look like? Frames and a video, rendered without a screen."""

from __future__ import annotations

import math
from collections.abc import Iterator
from contextlib import closing
from pathlib import Path

import numpy as np
from jaxtyping import Float, UInt8

from sidestep.plants.air.episode import FlightEpisode
from sidestep.plants.air.flight import Flight
from sidestep.plants.drawing import Decor, camera_over, rgba, thinned
from sidestep.plants.library import load_mujoco, make_renderer
from sidestep.views.style import EVADER, OBSTACLE, PURSUER, TARGET
from sidestep.views.video_files import write_video_file

_SIZE = (540, 960)
_MOST_DECOR = 4000
_TILT = math.radians(-42.0)
_TRAIL, _NEAR = 0.006, 2.0


def frames_of(
    episode: FlightEpisode, times: Float[np.ndarray, "n"], size: tuple[int, int] = _SIZE
) -> Iterator[UInt8[np.ndarray, "height width 3"]]:
    """The scene at these times (s), rendered off-screen; `size` is height and width in pixels.

    Circles are the capture distance around each aircraft at its height, the collision distance around each
    column, and the distance that counts as reached around the target; lines are the ways taken so far.

    **Raises** `TwinError` naming the Debian packages when this machine cannot render.
    """
    mujoco = load_mujoco()
    scenario, height = episode.scenario, episode.options.height
    flight = Flight(scenario, episode.options, episode.seed)
    capture, collision = float(scenario.capture_distance), float(scenario.collision_distance)
    target = np.asarray(episode.trajectory.worlds.target)[0]
    m, k = flight.counts
    own = np.array([positions[:2] for positions, _, _ in episode.frames])
    others = np.array([places[:, :2] for _, places, _ in episode.frames]).reshape(len(own), m + k, 2)
    margin, aspect = max(capture, collision) + 0.05, size[1] / size[0]
    # Of the aircraft only where it is near: it flies wide circles.
    flown = others[:, :m][np.linalg.norm(others[:, :m] - own[:, None], axis=-1) < _NEAR]
    points = np.concatenate([own, flown, others[:, m:].reshape(-1, 2), target[None]])
    field = math.radians(float(flight.model.vis.global_.fovy))
    camera = camera_over(mujoco, points, margin, field, aspect, tall=1.5 * height, tilt=_TILT)
    evader, pursuer, obstacle, green = map(rgba, (EVADER, PURSUER, OBSTACLE, TARGET))
    with closing(make_renderer(flight.model, *size, _MOST_DECOR)) as renderer:
        for time in times:
            frame = min(int(np.searchsorted(episode.frame_times, time)), len(own) - 1)
            flight.data.qpos[:], flight.data.mocap_pos[:], flight.data.mocap_quat[:] = episode.frames[frame]
            mujoco.mj_kinematics(flight.model, flight.data)
            mujoco.mj_camlight(flight.model, flight.data)
            renderer.update_scene(flight.data, camera)
            decor = Decor(mujoco, renderer.scene)
            reach = float(scenario.reach_distance)
            decor.disc(target, reach, green)
            decor.post(target, 0.006, height, green)
            decor.ring(target, reach, green, height)
            for place in others[frame, :m]:
                decor.ring(place, capture, pursuer, height)
            for place in others[frame, m:]:
                decor.ring(place, collision, obstacle)
            for path, colour in [(own, evader), *((others[:, index], pursuer) for index in range(m))]:
                decor.line(thinned(path[: frame + 1]), height, _TRAIL, colour)
            yield renderer.render()


def write_video(
    episode: FlightEpisode,
    path: str | Path,
    *,
    rate: int = 25,
    speed: float = 1.0,
    size: tuple[int, int] = _SIZE,
) -> Path:
    """Write a flight as a video of `rate` frames per second, `speed` times as fast as it was: .mp4, .gif or
    .webp.

    It ends with one second of the last frame. **Raises** `TwinError` when off-screen rendering is missing,
    and as `write_video_file`.
    """
    times = np.arange(0.0, episode.frame_times[-1], speed / rate)
    frames = frames_of(episode, np.append(times, episode.frame_times[-1]), size)
    return write_video_file(path, frames, rate, hold=1.0)
