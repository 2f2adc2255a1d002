"""The pictures of an animation: static parts are drawn once, moving parts on top of them."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, cast, final

import numpy as np
from jaxtyping import Float, UInt8
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch, Rectangle
from matplotlib.ticker import MaxNLocator
from PIL import Image

from sidestep.loop import Trajectory
from sidestep.safety import PURSUIT_SHIELDS
from sidestep.views import scene, style
from sidestep.views.motion import Instant, Motion
from sidestep.views.moving_panel import NOMINAL_DASHES, MovingPanel
from sidestep.views.trails import Trails
from sidestep.views.trajectory_figures import (
    ANSWERS,
    correction_norm,
    draw_barriers,
    draw_corrections,
    scene_extent,
    scene_margin,
)
from sidestep.views.video_files import VideoError
from sidestep.world import Scenario

_INCHES = (8.0, 4.5)
_WORLD, _SEEN = (0.42, 1.92, 4.88, 2.06), (5.74, 1.92, 2.06, 2.06)
_BARRIERS, _CORRECTIONS = (0.42, 0.82, 7.38, 0.42), (0.42, 0.36, 7.38, 0.27)
_TOP = 4.26
"""Positions of the axes (left, bottom, width, height) and height of the first line, in inches. They are
fixed, so that nothing jitters."""
_TICKS = (0.0, 0.02, 0.1, 0.5, 1.0, 2.0, 4.0)
_WIDEST = 3.2
"""Largest half width of the pursuer's frame, in units of the reach of its capture set."""


@final
class Stage:
    """The pictures of an animation, at any time of the episode and in any order.

    **Arguments:** as for `animate`; `speed` is only displayed.
    """

    def __init__(
        self,
        scenario: Scenario,
        trajectory: Trajectory,
        *,
        shield: str = "",
        title: str | None = None,
        speed: float = 1.0,
        width: int = 1280,
        levels: Sequence[float] = scene.LEVELS,
    ):
        if trajectory.length < 1:
            raise VideoError("the episode has no control period to show")
        self.motion = Motion(scenario, trajectory)
        self._trajectory, self._status = trajectory, np.asarray(trajectory.status)
        self._trails = Trails(scenario, trajectory, self.motion)
        self._speed = "" if speed == 1.0 else f" (× {speed:g})"
        words = title if title is not None else style.shield_words(shield) if shield else ""
        self._words = words[:1].upper() + words[1:]
        start = self.motion.at(0.0)
        with style.house_style():
            # MP4 requires even numbers of pixels.
            pixels = 2 * np.ceil(np.array(_INCHES) * width / _INCHES[0] / 2.0)
            dpi = width / _INCHES[0]
            self._figure = Figure(figsize=tuple(pixels / dpi), dpi=dpi)
            self._canvas = FigureCanvasAgg(self._figure)
            self.world, self.seen = self._axes(_WORLD), self._axes(_SEEN)
            _set_up_world(self.world, scenario, trajectory)
            _set_up_seen(self.seen, scenario, self._trails.distances)
            look = {"pursuit": shield in PURSUIT_SHIELDS, "levels": levels}
            others = len(start.poses) + len(start.obstacles)
            self._panels = (
                MovingPanel(self.world, scenario, start, trails=others, **look),
                MovingPanel(self.seen, scenario, start, trails=0, **look),
            )
            strips = self._axes(_BARRIERS), self._axes(_CORRECTIONS)
            self._veils = _draw_strips(*strips, scenario, trajectory)
            self._draw_key(scenario, len(start.obstacles) > 0, levels)
            self._write_words()
            self._moving: list[tuple[Axes, Artist]] = [
                (panel.axes, artist) for panel in self._panels for artist in panel.artists
            ]
            self._moving += [(strip, veil) for strip, veils in self._veils for veil in veils]
            for artist in (*(artist for _, artist in self._moving), *self._labels, self._clock):
                artist.set_animated(True)
            self._canvas.draw()
        self._still = self._canvas.copy_from_bbox(self._figure.bbox)
        self._labelled: tuple[list[str], Any] = ([], None)

    def _write_words(self) -> None:
        """Static titles, and empty texts to be set later."""
        self._text(_WORLD[0], _WORLD[1] + _WORLD[3] + 0.05, "The world, m", weight="bold", size=8.0)
        for place, words in (
            (_BARRIERS, "Barriers h: how far from capture and collision, m (√ scale)"),
            (_CORRECTIONS, "How far the shield changed the velocity, m/s"),
        ):
            self._text(place[0], place[1] + place[3] + 0.035, words, size=6.5)
        right = _SEEN[0] + _SEEN[2]
        self._frame = self._text(_SEEN[0], _SEEN[1] + _SEEN[3] + 0.05, "", weight="bold", size=8.0)
        self._heading = self._text(_WORLD[0], _TOP, "", weight="bold", size=11.0)
        self._answer = self._text(right - 1.35, _TOP, "", size=8.0, ha="right")
        self._clock = self._text(right, _TOP, "", size=9.0, ha="right")
        self._labels = (self._frame, self._heading, self._answer)

    def _axes(self, place: tuple[float, float, float, float]) -> Axes:
        across, up = _INCHES
        left, bottom, width, height = place
        return self._figure.add_axes((left / across, bottom / up, width / across, height / up))

    def _text(self, x: float, y: float, words: str, *, size: float, **look: Any) -> Any:
        return self._figure.text(x / _INCHES[0], y / _INCHES[1], words, va="baseline", fontsize=size, **look)

    def _draw_key(self, scenario: Scenario, obstacles: bool, levels: Sequence[float]) -> None:
        handles: list[Any] = [
            Line2D([], [], color=style.EVADER, marker="o", markersize=4, label="evader"),
            Line2D([], [], color=style.PURSUER, marker=">", markersize=4, label="pursuer"),
            Line2D([], [], color=style.TARGET, marker="*", linestyle="none", markersize=7, label="target"),
            Patch(facecolor=style.PURSUER, alpha=0.25, label="capture distance"),
            Line2D([], [], **scene.CAPTURE_SET_LOOK, label=scene.capture_set_words(scenario)),
            Line2D([], [], color=style.INK, linewidth=1.0, label="h = 0"),
            Line2D([], [], color=style.EVADER, linewidth=1.5, label="velocity driven"),
            Line2D(
                [], [], color=style.INK, linewidth=1.5, linestyle=NOMINAL_DASHES, label="nominal velocity"
            ),
            Patch(facecolor=scene.correction_colours()(0.6), label="shield corrects"),
        ]
        if levels:
            label = f"h = {', '.join(f'{level:g}' for level in levels)} m"
            handles.insert(6, Line2D([], [], color=scene.LEVEL_COLOUR, linewidth=0.6, label=label))
        if obstacles:
            handles.insert(4, Patch(facecolor=style.OBSTACLE, alpha=0.35, label="collision distance"))
        self._figure.legend(
            handles=handles, loc="center", bbox_to_anchor=(0.5, 1.56 / _INCHES[1]), ncols=6, fontsize=6.3,
            columnspacing=1.6, handletextpad=0.5, labelspacing=0.35, borderpad=0.0,
        )  # fmt: skip

    def picture(self, time: float, *, end: bool = False) -> UInt8[np.ndarray, "height width 3"]:
        """The picture at a time (s); with the outcome if this is the `end`."""
        self._place(time, end)
        self._canvas.restore_region(self._with_labels())
        for axes, artist in self._moving:
            axes.draw_artist(artist)
        self._clock.draw(self._canvas.get_renderer())
        # Much faster than copying three of every four bytes.
        drawn = Image.fromarray(np.asarray(self._canvas.buffer_rgba()))
        return np.asarray(drawn.convert("RGB"))

    def _with_labels(self) -> Any:
        """The static background with the texts that seldom change, because text is slow to draw."""
        words = [label.get_text() for label in self._labels]
        if words != self._labelled[0]:
            self._canvas.restore_region(self._still)
            for label in self._labels:
                label.draw(self._canvas.get_renderer())
            self._labelled = words, self._canvas.copy_from_bbox(self._figure.bbox)
        return self._labelled[1]

    def _place(self, time: float, end: bool) -> None:
        now, outcome = self.motion.at(time), self._trajectory.outcome if end else None
        pursuer = self._trails.viewer(time)
        pose, (world, seen) = now.poses[pursuer], self._panels
        world.show(now, outcome)
        world.show_trails(*self._trails.in_world(now))
        from_it = now.seen_from(pose)
        seen.show(from_it, outcome)
        seen.show_trails(*self._trails.seen_by(pursuer, from_it))
        self._say(now, pursuer, end)
        for _, (veil, line) in self._veils:
            cast(Rectangle, veil).set_x(time)
            cast(Rectangle, veil).set_width(max(self.motion.duration - time, 0.0))
            cast(Line2D, line).set_xdata([time, time])

    def _say(self, now: Instant, pursuer: int, end: bool) -> None:
        several = len(now.poses) > 1
        frame = f"the frame of pursuer {pursuer + 1}" if several else "the pursuer's frame"
        self._frame.set_text(f"In {frame}, m")
        self._clock.set_text(f"{now.time:.2f} s{self._speed}")
        colour, words = ANSWERS[int(self._status[now.period])]
        self._answer.set_text(f"shield: {words}")
        self._answer.set_color(style.INK if words == "unchanged" else colour)
        heading, colour = self._words, style.INK
        if end:
            outcome = self._trajectory.outcome
            colour = style.OUTCOME_COLOURS.get(outcome, style.INK)
            heading = f"{style.OUTCOME_WORDS[outcome]} after {self.motion.duration:.2f} s"
            heading = f"{self._words}: {heading}" if self._words else heading[:1].upper() + heading[1:]
        self._heading.set_text(heading)
        self._heading.set_color(colour)


def _set_up_world(axes: Axes, scenario: Scenario, trajectory: Trajectory) -> None:
    """Set limits that contain all motion of the episode, at equal scales, filling the panel."""
    low, high = scene_extent(trajectory)
    # On the live page a new target follows each that is reached.
    targets = np.asarray(trajectory.worlds.target)
    low = np.minimum(low, targets.min(axis=0)) - scene_margin(scenario)
    high = np.maximum(high, targets.max(axis=0)) + scene_margin(scenario)
    shape = np.array(_WORLD[2:])
    half = np.max((high - low) / shape) * shape / 2.0
    middle = (low + high) / 2.0
    axes.set_xlim(middle[0] - half[0], middle[0] + half[0])
    axes.set_ylim(middle[1] - half[1], middle[1] + half[1])
    _round_ticks(axes, 8, 6)
    side = float(scenario.arena_side)
    # Drawn only if a corner is in view; otherwise it would be a meaningless line.
    if np.all(np.abs(middle) + half > side / 2):
        axes.add_patch(
            Rectangle(
                (-side / 2, -side / 2),
                side,
                side,
                fill=False,
                edgecolor=style.FAINT,
                linewidth=0.9,
                zorder=0.4,
            )
        )


def _set_up_seen(axes: Axes, scenario: Scenario, distances: Float[np.ndarray, "n"]) -> None:
    reach = float(np.abs(scene.capture_set_outline(scenario)).max())
    half = float(np.clip(1.1 * distances.max(), 2.0 * reach, _WIDEST * reach))
    axes.set_xlim(-half, half)
    axes.set_ylim(-half, half)
    _round_ticks(axes, 4, 6)


def _round_ticks(axes: Axes, across: int, up: int) -> None:
    """Ticks with few digits, which fit at the left."""
    for axis, most in ((axes.xaxis, across), (axes.yaxis, up)):
        axis.set_major_locator(MaxNLocator(most, steps=[1, 2, 5, 10]))
    style.light_grid(axes)


def _draw_strips(
    barriers: Axes, corrections: Axes, scenario: Scenario, trajectory: Trajectory
) -> list[tuple[Axes, tuple[Artist, Artist]]]:
    """The shield's trace over the episode; on each strip a veil that covers the future, and a time mark."""
    draw_barriers(barriers, scenario, trajectory)
    draw_corrections(corrections, scenario, trajectory, correction_norm(scenario))
    duration, veils = trajectory.length * float(scenario.control_period), []
    for strip in (barriers, corrections):
        strip.set_xlim(0.0, duration)
        strip.set_ylabel("")
        strip.tick_params(labelsize=6.5)
        veil = strip.add_patch(
            Rectangle((0.0, 0.0), duration, 1.0, transform=strip.get_xaxis_transform(), facecolor="white",
                      alpha=0.72, linewidth=0, zorder=5)
        )  # fmt: skip
        (line,) = strip.plot(
            [0, 0], [0, 1], transform=strip.get_xaxis_transform(), color=style.INK, linewidth=1.0
        )
        veils.append((strip, (veil, line)))
    barriers.tick_params(labelbottom=False)
    # Fewer ticks than in a figure, because the strip is low; spaced for the square-root scale.
    ticks, room = [_TICKS[0]], 0.18 * np.sqrt(barriers.get_ylim()[1])
    for tick in _TICKS[1:]:
        if tick <= barriers.get_ylim()[1] and np.sqrt(tick) >= np.sqrt(ticks[-1]) + room:
            ticks.append(tick)
    barriers.set_yticks(ticks, [f"{tick:g}" for tick in ticks])
    barriers.legend(
        loc="lower right", bbox_to_anchor=(1.0, 1.0), ncols=2, fontsize=6.5, borderpad=0.1, borderaxespad=0.2
    )
    corrections.set_xlabel("time, s", fontsize=7, labelpad=1.0)
    return veils
