"""An episode in motion, as a video: the world beside the frame of the pursuer, and the shield's trace."""

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
    """Write an episode as a video: .mp4 (H.264), .gif or .webp, as the suffix of `path` says.

    Left the world, right the evader as the nearest pursuer sees it, below the barriers and the corrections
    over time, in the colours of the figures. Between control periods everybody moves as `Motion` says. It
    ends with the outcome.

    **Arguments:** `shield` its name, for words and for which barrier's levels are drawn; `title` instead of
    the shield's; `speed` how many times faster than it was; `rate` pictures per second (30; 20 for .gif and
    .webp); `width` in pixels, of which 9/16 are the height (1280; 720 for .gif and .webp); `hold` how long
    (s) the end stays; `levels` (m, above 0) of the barrier to draw beside level 0: none make a .gif or
    .webp half as large; `progress` is told how many pictures are done, and of how many.

    **Returns** the path. A file that exists is replaced when the new one is complete; an interruption leaves
    the old one, or nothing. **Raises** `VideoError` before any work when the file cannot be written as asked
    or a package is missing (the extra `[video]`), or a number makes no sense.
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
            # The very end comes with the outcome, and stays for the hold.
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
    """**Raises** `VideoError` when `animate` could not take these arguments for this file."""
    # Browsers slow down a GIF that is faster.
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
