"""What does an episode on the twin look like? Frames and a video, rendered without a screen."""

from __future__ import annotations

import math
from collections.abc import Iterator
from contextlib import closing
from pathlib import Path

import numpy as np
from jaxtyping import Float, UInt8

from sidestep.plants.drawing import Decor, camera_over, rgba, thinned
from sidestep.plants.ground.episode import TwinEpisode
from sidestep.plants.ground.twin import Twin
from sidestep.plants.library import load_av, load_mujoco, make_renderer
from sidestep.views.style import EVADER, OBSTACLE, PURSUER, TARGET
from sidestep.views.video_files import write_video_file

_SIZE = (540, 960)
_MOST_DECOR = 2000


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
    camera = camera_over(mujoco, points, max(capture, collision) + 0.05, field, size[1] / size[0])
    evader, pursuer, obstacle, green = map(rgba, (EVADER, PURSUER, OBSTACLE, TARGET))
    with closing(make_renderer(twin.model, *size, _MOST_DECOR)) as renderer:
        for time in times:
            frame = min(int(np.searchsorted(episode.frame_times, time)), len(episode.frames) - 1)
            twin.data.qpos[:] = episode.frames[frame]
            mujoco.mj_kinematics(twin.model, twin.data)
            mujoco.mj_camlight(twin.model, twin.data)
            renderer.update_scene(twin.data, camera)
            decor = Decor(mujoco, renderer.scene)
            here = paths[frame]
            decor.disc(target, float(scenario.reach_distance), green)
            decor.post(target, 0.006, 0.16, green)
            for place in here[1 : 1 + pursuers]:
                decor.ring(place, capture, pursuer)
            for place in here[1 + pursuers :]:
                decor.ring(place, collision, obstacle)
            for robot, colour in enumerate([evader, *[pursuer] * pursuers]):
                decor.line(thinned(paths[: frame + 1, robot]), 0.004, 0.0055, colour)
            yield renderer.render()


def write_video(
    episode: TwinEpisode,
    path: str | Path,
    *,
    rate: int = 25,
    speed: float = 1.0,
    size: tuple[int, int] = _SIZE,
) -> Path:
    """Write an episode as a video of `rate` frames per second, `speed` times as fast as it was: .mp4 (H.264),
    .gif or .webp.

    It ends with one second of the last frame. **Raises** `TwinError` when off-screen rendering, or for .mp4
    PyAV, is missing, and as `write_video_file`.
    """
    if Path(path).suffix.lower() == ".mp4":
        load_av()
    times = np.arange(0.0, episode.frame_times[-1], speed / rate)
    frames = frames_of(episode, np.append(times, episode.frame_times[-1]), size)
    return write_video_file(path, frames, rate, hold=1.0)
