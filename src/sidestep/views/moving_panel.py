"""One panel of an animation: robots, distances and trails in a frame, updated for every picture."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, final

import numpy as np
from jaxtyping import Float
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
from matplotlib.lines import Line2D
from matplotlib.patches import Circle, Polygon
from matplotlib.patheffects import withStroke

from sidestep.views import scene, style
from sidestep.views.motion import Instant
from sidestep.views.outlines import LevelOutlines
from sidestep.world import Scenario

NOMINAL_DASHES = (0, (2.2, 1.2))
_CIRCLE = np.array([[np.cos(angle), np.sin(angle)] for angle in np.linspace(0.0, 2.0 * np.pi, 73)])
_ARROW_SHARE = 0.13
_BODY = np.array([[0.75, 0.0], [-0.5, 0.5], [-0.25, 0.0], [-0.5, -0.5]])
_HEAD = np.array([[0.0, 0.0], [-1.0, 0.42], [-1.0, -0.42]])
_HALO = [withStroke(linewidth=1.8, foreground="white")]


@final
class _Arrow:
    """A velocity arrow at the evader."""

    def __init__(self, axes: Axes, speed_limit: float, colour: str, *, dashes: Any = "solid", zorder: float):
        height = float(np.ptp(axes.get_ylim()))
        self._seconds, self._head = _ARROW_SHARE * height / speed_limit, 0.035 * height
        (self.shaft,) = axes.plot(
            [], [], color=colour, linewidth=1.5, linestyle=dashes, zorder=zorder, solid_capstyle="butt"
        )
        self.head = Polygon(
            np.zeros((3, 2)), facecolor=colour, edgecolor="white", linewidth=0.4, zorder=zorder
        )
        axes.add_patch(self.head)

    def show(self, place: np.ndarray, velocity: np.ndarray) -> None:
        """Show `velocity` (m/s); nothing if it is zero."""
        length = self._seconds * float(np.hypot(*velocity))
        visible = length > 0.3 * self._head
        self.shaft.set_visible(visible)
        self.head.set_visible(visible)
        if visible:
            along = velocity / np.hypot(*velocity)
            pose = np.array([*(place + length * along), np.arctan2(along[1], along[0])])
            shaft = np.stack([place, place + max(length - 0.8 * self._head, 0.0) * along])
            self.shaft.set_data(*shaft.T)
            self.head.set_xy(scene.to_world(self._head * _HEAD, pose))


@final
class _Pursuer:
    """A pursuer with its capture circle and its capture set K; a differential drive is drawn to scale, any
    other as a symbol."""

    def __init__(self, axes: Axes, scenario: Scenario, number: str):
        axle = scene.drawn_half_axle(scenario)
        self._outline = scene.capture_set_outline(scenario, 61)
        self._circle = float(scenario.capture_distance) * _CIRCLE
        # The axle is to scale; wheels and body fit it and the capture circle.
        room = min(axle, float(scenario.capture_distance))
        length = 0.5 * room
        wheel = 0.5 * length * np.array([[-1.0, -0.32], [1.0, -0.32], [1.0, 0.32], [-1.0, 0.32]])
        self._wheels = [wheel + np.array([0.0, side * axle]) for side in (-1.0, 1.0)]
        self._axle = np.array([[0.0, -axle], [0.0, axle]])
        self._body = 0.7 * room * _BODY
        self._parts: list[tuple[Any, np.ndarray]] = []

        def area(shape: np.ndarray, zorder: float, **look: Any) -> None:
            patch = Polygon(shape, closed=True, zorder=zorder, **look)
            axes.add_patch(patch)
            self._parts.append((patch, shape))

        def line(shape: np.ndarray, zorder: float, **look: Any) -> None:
            (drawn,) = axes.plot(*shape.T, zorder=zorder, **look)
            self._parts.append((drawn, shape))

        area(self._circle, 1.0, facecolor=style.PURSUER, alpha=0.12, linewidth=0)
        line(self._circle, 2.0, color=style.PURSUER, linewidth=0.8)
        line(self._outline, 3.0, **scene.CAPTURE_SET_LOOK)
        line(self._axle, 5.5, color=style.INK, linewidth=1.0)
        for wheel in self._wheels:
            area(wheel, 5.6, facecolor=style.INK, edgecolor="white", linewidth=0.4)
        area(self._body, 6.0, facecolor=style.PURSUER, edgecolor="white", linewidth=0.5)
        self._number = axes.text(
            0.0, 0.0, number, color=style.PURSUER, fontsize=7, fontweight="bold", ha="center", va="center",
            zorder=8.0, path_effects=_HALO, clip_on=True,
        )  # fmt: skip

    @property
    def artists(self) -> list[Artist]:
        """The artists that change with every picture."""
        return [*(part for part, _ in self._parts), self._number]

    def show(self, pose: np.ndarray) -> None:
        """Move all artists to the pursuer's pose."""
        for part, shape in self._parts:
            moved = scene.to_world(shape, pose)
            if isinstance(part, Line2D):
                part.set_data(*moved.T)
            else:
                part.set_xy(moved)
        behind = pose[:2] - 1.5 * self._body[0, 0] * np.array([np.cos(pose[2]), np.sin(pose[2])])
        self._number.set_position((float(behind[0]), float(behind[1])))


@final
class MovingPanel:
    """Draws an instant in axes with fixed limits.

    **Arguments:** `trails` number of trails besides the evader's; `pursuit` the barrier whose levels are
    drawn, see `LevelOutlines`; `levels` (m) to draw besides 0.
    """

    def __init__(
        self,
        axes: Axes,
        scenario: Scenario,
        instant: Instant,
        *,
        trails: int,
        pursuit: bool,
        levels: Sequence[float],
    ):
        self.axes, self._levels = axes, levels
        self._outlines = LevelOutlines(scenario, pursuit=pursuit)
        several = len(instant.poses) > 1
        (self._low,) = axes.plot([], [], color=scene.LEVEL_COLOUR, linewidth=0.5, zorder=0.5)
        (self._zero,) = axes.plot([], [], color=style.INK, linewidth=1.0, zorder=2.5)
        reach = float(scenario.reach_distance)
        self._goal = Circle((0, 0), reach, facecolor=style.TARGET, alpha=0.25, linewidth=0, zorder=2)
        axes.add_patch(self._goal)
        (self._star,) = axes.plot([], [], "*", zorder=5, **style.mark(style.TARGET, 9, width=0.6))
        collision = float(scenario.collision_distance)
        self._rocks: list[tuple[Circle, Circle, Line2D]] = []
        for _ in instant.obstacles:
            area, edge = style.draw_disc(axes, (0.0, 0.0), collision, style.OBSTACLE, alpha=0.18)
            (dot,) = axes.plot([], [], "o", color=style.OBSTACLE, markersize=4, zorder=5)
            self._rocks.append((area, edge, dot))
        self._pursuers = [
            _Pursuer(axes, scenario, str(number + 1) if several else "")
            for number in range(len(instant.poses))
        ]
        self._faint, *self._trails = (
            axes.plot([], [], linewidth=1.2, zorder=4, solid_joinstyle="round")[0] for _ in range(trails + 2)
        )
        self._faint.set(color=style.EVADER, alpha=0.3, linewidth=0.8)
        self._corrected = LineCollection([], linewidth=4.0, capstyle="round", zorder=3.9)
        axes.add_collection(self._corrected, autolim=False)
        speed = float(scenario.evader_speed)
        self._nominal = _Arrow(axes, speed, style.INK, dashes=NOMINAL_DASHES, zorder=6.6)
        self._action = _Arrow(axes, speed, style.EVADER, zorder=6.7)
        (self._evader,) = axes.plot([], [], "o", zorder=7, **style.mark(style.EVADER, 6.5, width=0.9))
        (self._lost,) = axes.plot([], [], "X", markersize=10, markeredgecolor="white", zorder=9)
        (self._beyond,) = axes.plot([], [], color=style.EVADER, markersize=7, linestyle="none", zorder=9)
        self._distance = axes.text(
            0, 0, "", fontsize=7, color=style.EVADER, ha="center", va="center", path_effects=_HALO, zorder=9
        )
        self.artists: list[Artist] = sorted(self._all(), key=lambda artist: artist.get_zorder())
        for artist in self.artists:
            artist.set_animated(True)

    def _all(self) -> list[Artist]:
        parts: list[Artist] = [self._low, self._zero, self._goal, self._star, self._faint, *self._trails]
        parts += [part for rock in self._rocks for part in rock]
        parts += [part for pursuer in self._pursuers for part in pursuer.artists]
        parts += [self._corrected, self._evader, self._lost, self._beyond, self._distance]
        return [
            *parts,
            *(part for arrow in (self._nominal, self._action) for part in (arrow.shaft, arrow.head)),
        ]

    def show_trails(
        self,
        evader: Float[np.ndarray, "n 2"],
        faint: Float[np.ndarray, "m 2"],
        others: Sequence[tuple[Float[np.ndarray, "n 2"], str]],
        corrected: Float[np.ndarray, "k 2 2"],
        colours: Float[np.ndarray, "k 4"],
    ) -> None:
        """Draw trails: the evader's, an older part of it faintly, those of other robots with their colours,
        and the pieces of the evader's trail with an intervention, in the colours of the corrections."""
        self._faint.set_data(*faint.T)
        for line, (way, colour) in zip(self._trails, [(evader, style.EVADER), *others], strict=True):
            line.set_data(*way.T)
            line.set(color=colour, linewidth=1.0 if colour == style.OBSTACLE else 1.3)
        self._corrected.set_segments(list(corrected))
        self._corrected.set_color(list(map(tuple, colours)))

    def show(self, now: Instant, outcome: str | None = None) -> None:
        """Update all artists; `outcome` is that of the episode, at its end."""
        for pursuer, pose in zip(self._pursuers, now.poses, strict=True):
            pursuer.show(pose)
        for (area, edge, dot), place in zip(self._rocks, now.obstacles, strict=True):
            centre = (float(place[0]), float(place[1]))
            area.set_center(centre)
            edge.set_center(centre)
            dot.set_data(*place[:, None])
        self._goal.set_center((float(now.target[0]), float(now.target[1])))
        self._star.set_data(*now.target[:, None])
        zero, *low = (self._outlines.at(now.poses, now.obstacles, level) for level in (0.0, *self._levels))
        self._zero.set_data(*zero.T)
        self._low.set_data(*np.concatenate([*low, np.zeros((0, 2))]).T)
        self._evader.set_data(*now.evader[:, None])
        lost = outcome in ("captured", "collided")
        for arrow, velocity in ((self._nominal, now.nominal), (self._action, now.action)):
            arrow.show(now.evader, np.zeros(2) if lost else velocity)
        self._lost.set_data(*(now.evader[:, None] if lost else np.zeros((2, 0))))
        self._lost.set_color(style.OUTCOME_COLOURS.get(outcome or "", style.INK))
        self._lost.set_markeredgecolor("white")
        self._show_beyond(now.evader)

    def _show_beyond(self, evader: np.ndarray) -> None:
        """Show direction and distance of an evader outside the panel."""
        limits = np.array([self.axes.get_xlim(), self.axes.get_ylim()])
        inside = bool(np.all((evader >= limits[:, 0]) & (evader <= limits[:, 1])))
        self._beyond.set_visible(not inside)
        self._distance.set_visible(not inside)
        if inside:
            return
        centre, half = limits.mean(axis=1), np.ptp(limits, axis=1) / 2.0
        offset = evader - centre
        edge = centre + offset / np.max(np.abs(offset) / half) * 0.95
        self._beyond.set_data(*edge[:, None])
        self._beyond.set_marker((3, 0, np.degrees(np.arctan2(offset[1], offset[0])) - 90.0))
        words = centre + 0.76 * (edge - centre)
        self._distance.set_position((float(words[0]), float(words[1])))
        self._distance.set_text(f"{np.hypot(*evader):.2f} m")
