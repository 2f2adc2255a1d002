"""Video options of the commands that show an episode, checked before any work is done."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import tyro

from sidestep._bounds import SPEED_UP, bounded
from sidestep.commands.common import CountBar

if TYPE_CHECKING:
    from rich.console import Console


@dataclass(frozen=True)
class Video:
    """An animation of the episode: the world, the pursuer's frame and the shield's trace."""

    video: Annotated[Path | None, tyro.conf.arg(metavar="FILE")] = None
    """Also animate it into this .mp4, .gif or .webp file; never overwrites a file."""
    video_speed: float = bounded(1.0, SPEED_UP)
    """Speed as a factor on real time."""
    video_rate: int | None = bounded(None, least=1, most=120, whole=True)
    """Pictures per second; 30, or 20 for .gif and .webp, by default."""
    video_width: int | None = bounded(None, least=160, most=4096, whole=True, unit="pixels")
    """Pixels; 1280, or 720 for .gif and .webp, by default. The height is 9/16 of it."""
    video_levels: Annotated[tuple[float, ...], tyro.conf.arg(metavar="[M ...]")] = bounded(
        (0.1, 0.2, 0.3), shape=(None,), empty=True, above=0.0, most=1e6, unit="m"
    )
    """Levels of the barrier to draw besides level 0, in m; without them a .gif or .webp is half as large."""


NO_VIDEO = Video()
VideoOptions = Annotated[Video, tyro.conf.arg(name="")]
"""The options without a prefix, in a separate group of the help."""


def check_options(options: Video) -> None:
    """**Raises** `ValueError` for a video that cannot be written; does nothing without one."""
    if options.video is None:
        return
    from sidestep.views.animation import check_numbers
    from sidestep.views.video_files import check_video

    check_numbers(
        check_video(options.video, overwrite=False),
        speed=options.video_speed,
        rate=options.video_rate,
        width=options.video_width,
        levels=options.video_levels,
    )


def write_video(
    options: Video, scenario: Any, trajectory: Any, shield: str, console: Console, what: str = "the episode"
) -> None:
    """Animate an episode if a file is given, and print its path."""
    if options.video is None:
        return
    from sidestep.views import animate

    with CountBar(console, "video") as show:
        path = animate(
            scenario,
            trajectory,
            options.video,
            shield=shield,
            speed=options.video_speed,
            rate=options.video_rate,
            width=options.video_width,
            levels=options.video_levels,
            progress=show,
        )
    outcome = trajectory.outcome.replace("_", " ")
    console.print(f"Video of {what} ({outcome}): {path}", highlight=False, soft_wrap=True)
