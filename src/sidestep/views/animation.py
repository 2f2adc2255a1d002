"""Videos of episodes: the world, the pursuer's frame, and the shield's trace."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from pathlib import Path

import numpy as np

from sidestep._bounds import SPEED_UP, Bound, taken
from sidestep.loop import Trajectory
from sidestep.views.scene import LEVELS
from sidestep.views.stage import Stage
from sidestep.views.video_files import HOLD, VideoError, check_video, write_video_file
from sidestep.world import Scenario

_NARROWEST, _WIDEST_PIXELS = 160, 4096
_RATES = {".mp4": 30, ".gif": 20, ".webp": 20}
_WIDTHS = {".mp4": 1280, ".gif": 720, ".webp": 720}


def animate(
    scenario: Scenario,
    trajectory: Trajectory,
    path: str | Path,
    *,
    shield: str = "",
    title: str | None = None,
    speed: float = 1.0,
    rate: int | None = None,
    width: int | None = None,
    hold: float = 1.5,
    levels: Sequence[float] = LEVELS,
    progress: Callable[[int, int], None] | None = None,
) -> Path:
    """Write an episode as a video: .mp4 (H.264), .gif or .webp, according to the suffix of `path`.

    Left the world, right the evader in the frame of the nearest pursuer, below the barriers and the
    corrections over time. `Motion` interpolates between control periods. The video ends with the outcome.

    **Arguments:**

    - `shield`: its name, for texts and for the barrier whose levels are drawn
    - `title`: replaces the shield's
    - `speed`: factor on real time
    - `rate`: pictures per second (30; 20 for .gif and .webp)
    - `width` in pixels (1280; 720 for .gif and .webp); the height is 9/16 of it
    - `hold`: time (s) for which the last picture stays
    - `levels` (m, above 0) of the barrier to draw besides level 0; without them a .gif or .webp is half as
      large
    - `progress(done, total)`: called with numbers of pictures

    **Returns** the path. An existing file is replaced when the new one is complete. **Raises** `VideoError`
    before any work for an invalid number, when the file cannot be written, or when a package is missing (the
    extra `[video]`).
    """
    path = check_video(path)
    suffix = path.suffix.lower()
    rate = _RATES[suffix] if rate is None else rate
    width = _WIDTHS[suffix] if width is None else width
    check_numbers(path, speed=speed, rate=rate, width=width, hold=hold, levels=levels)
    stage = Stage(scenario, trajectory, shield=shield, title=title, speed=speed, width=width, levels=levels)
    duration = stage.motion.duration
    times = [*np.arange(0.0, duration - 1e-6, speed / rate), duration]

    def pictures() -> Iterator[np.ndarray]:
        for number, time in enumerate(times, start=1):
            # The last picture shows the outcome, and stays for the hold.
            yield stage.picture(float(time), end=number == len(times))
            if progress is not None:
                progress(number, len(times))

    def samples() -> Iterator[np.ndarray]:
        yield from (stage.picture(time) for time in np.linspace(0.0, duration, 6))
        yield stage.picture(duration, end=True)

    chosen_from = None if suffix == ".mp4" else samples()
    return write_video_file(path, pictures(), rate, hold=hold, samples=chosen_from)


def check_numbers(
    path: Path,
    *,
    speed: float,
    rate: int | None = None,
    width: int | None = None,
    hold: float = 0.0,
    levels: Sequence[float] = LEVELS,
) -> None:
    """**Raises** `VideoError` if `animate` does not accept these arguments for this file."""
    # Browsers slow down faster GIFs.
    most = 50 if path.suffix.lower() == ".gif" else 120
    for name, value, bound in (
        ("speed", speed, SPEED_UP),
        ("rate", rate, Bound(least=1, most=most, whole=True, unit="pictures per second")),
        ("width", width, Bound(least=_NARROWEST, most=_WIDEST_PIXELS, whole=True, unit="pixels")),
        ("hold", hold, HOLD),
        ("levels", tuple(levels), Bound(shape=(None,), empty=True, above=0.0, most=1e6, unit="m")),
    ):
        if value is not None:
            taken(name, value, bound, VideoError)
