"""Frames and videos of an episode in MuJoCo, rendered off-screen."""

from __future__ import annotations

import math
from collections.abc import Iterator
from contextlib import closing
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float, UInt8

from sidestep.plants.drawing import Decor, camera_over, rgba, thinned
from sidestep.plants.library import load_av, load_mujoco, make_renderer
from sidestep.views import style
from sidestep.views.video_files import write_video_file

_SIZE = (540, 960)
_MOST_DECOR = 4000


def frames_of(
    episode: Any, times: Float[np.ndarray, "n"], size: tuple[int, int] = _SIZE
) -> Iterator[UInt8[np.ndarray, "height width 3"]]:
    """The scene at these times (s), rendered off-screen; `size` is height and width in pixels.

    Circles show the capture distance around each pursuer, the collision distance around each obstacle and the
    reach distance around the target; lines are the paths so far.

    **Arguments:** `episode` a `TwinEpisode` or a `FlightEpisode`.

    **Raises** `TwinError` naming the Debian packages when this machine cannot render.
    """
    mujoco = load_mujoco()
    plant, scenario = episode.plant(), episode.scenario
    look, data, pursuers = plant.look, plant.data, plant.counts[0]
    capture, collision = float(scenario.capture_distance), float(scenario.collision_distance)
    reach, target = float(scenario.reach_distance), np.asarray(episode.trajectory.worlds.target)[0]
    paths = plant.places_of(episode.frames)
    near = np.linalg.norm(paths - paths[:, :1], axis=-1) < look.near
    near[:, 1 + pursuers :] = True
    field = math.radians(float(plant.model.vis.global_.fovy))
    camera = camera_over(
        mujoco, np.concatenate([paths[near], target[None]]), max(capture, collision) + 0.05, field,
        size[1] / size[0], tall=look.tall, tilt=look.tilt,
    )  # fmt: skip
    evader, pursuer, obstacle, green = map(rgba, (style.EVADER, style.PURSUER, style.OBSTACLE, style.TARGET))
    with closing(make_renderer(plant.model, *size, _MOST_DECOR)) as renderer:
        for time in times:
            frame = min(int(np.searchsorted(episode.frame_times, time)), len(paths) - 1)
            plant.show(episode.frames[frame])
            mujoco.mj_kinematics(plant.model, data)
            mujoco.mj_camlight(plant.model, data)
            renderer.update_scene(data, camera)
            decor = Decor(mujoco, renderer.scene)
            decor.disc(target, reach, green)
            decor.post(target, 0.006, look.post, green)
            if look.height:
                decor.ring(target, reach, green, look.height)
            for place in paths[frame, 1 : 1 + pursuers]:
                decor.ring(place, capture, pursuer, look.height)
            for place in paths[frame, 1 + pursuers :]:
                decor.ring(place, collision, obstacle)
            for robot, colour in enumerate([evader, *[pursuer] * pursuers]):
                decor.line(thinned(paths[: frame + 1, robot]), look.trail[0], look.trail[1], colour)
            yield renderer.render()


def write_video(
    episode: Any,
    path: str | Path,
    *,
    rate: int = 25,
    speed: float = 1.0,
    size: tuple[int, int] = _SIZE,
) -> Path:
    """Write an episode as a video of `rate` frames per second, `speed` times real time: .mp4 (H.264), .gif or
    .webp.

    The last frame is shown for 1 s. **Arguments:** as for `frames_of`. **Raises** `TwinError` when off-screen
    rendering, or PyAV for .mp4, is missing, and as `write_video_file`.
    """
    if Path(path).suffix.lower() == ".mp4":
        load_av()
    times = np.arange(0.0, episode.frame_times[-1], speed / rate)
    frames = frames_of(episode, np.append(times, episode.frame_times[-1]), size)
    return write_video_file(path, frames, rate, hold=1.0)
