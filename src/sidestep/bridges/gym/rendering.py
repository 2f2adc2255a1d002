"""Render the current scene as an array of pixels or in a window."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, final

import equinox as eqx
import numpy as np
from jaxtyping import Float, UInt8
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from sidestep._packages import needed
from sidestep.views import style
from sidestep.views.motion import Instant
from sidestep.views.moving_panel import MovingPanel
from sidestep.views.scene import correction_colours
from sidestep.views.trajectory_figures import ANSWERS
from sidestep.world import Scenario, World, to_velocity

MODES = ("human", "rgb_array")
_PIXELS, _DPI = 600, 120
_LEVELS = (0.1, 0.2, 0.3)
_MARGIN = 0.25
_WIDENED = 1.25
_VISIBLE = 1e-6


def check_render_mode(mode: str | None) -> str | None:
    """Returns `mode`. **Raises** `ValueError` for an unknown mode, or when its package is missing."""
    if mode is not None and mode not in MODES:
        raise ValueError(f"render_mode = {mode!r}: it must be {' or '.join(map(repr, MODES))}, or None")
    if mode == "human":
        needed("pygame", "gym", "the render_mode 'human' needs")
    return mode


@final
class Picture:
    """Draws an episode step by step: robots, clearances, barrier, paths and corrections."""

    def __init__(self, scenario: Scenario, shield: Any):
        self._scenario = scenario
        self._pursuit = shield.keeps_pursuit_barrier
        self._velocity = eqx.filter_jit(to_velocity)
        self._window: Any = None
        self._half = 0.0
        self.clear()

    def clear(self) -> None:
        """Forget the paths of the last episode."""
        self._worlds: list[World] = []
        self._corrections: list[float] = []
        self._status, self._nominal = 0, np.zeros(2)

    def follow(self, world: World, info: dict[str, Any] | None = None) -> None:
        """Add a world, with the `info` of the step that led to it, if any."""
        if info is not None and self._worlds:
            action = np.asarray(info["proposed"], np.float32)
            self._nominal = np.asarray(self._velocity(self._scenario, self._worlds[-1], action), float)
            self._status = info["status"]
            self._corrections.append(info["intervention"])
        self._worlds.append(world)

    def drawn(self) -> UInt8[np.ndarray, "height width 3"]:
        """The pixels."""
        self._fit_axes()
        now = self._instant()
        self._panel.show(now, None)
        self._panel.show_trails(*self._trails())
        answer = ANSWERS[self._status]
        self._words.set_text(f"{now.time:.1f} s    shield: {answer[1]}")
        self._canvas.restore_region(self._still)
        for artist in self._panel.artists:
            self._panel.axes.draw_artist(artist)
        self._words.draw(self._canvas.get_renderer())
        return np.array(np.asarray(self._canvas.buffer_rgba())[..., :3])

    def show(self, rate: int) -> None:
        """Show the pixels in a window, at most `rate` times a second."""
        pygame = needed("pygame", "gym", "the render_mode 'human' needs")
        if self._window is None:
            pygame.display.init()
            pygame.display.set_caption("sidestep")
            self._window = pygame.display.set_mode((_PIXELS, _PIXELS)), pygame.time.Clock()
        screen, clock = self._window
        screen.blit(pygame.surfarray.make_surface(self.drawn().swapaxes(0, 1)), (0, 0))
        pygame.event.pump()
        pygame.display.flip()
        clock.tick(rate)

    def close(self) -> None:
        """Close the window, if there is one."""
        if self._window is not None:
            needed("pygame", "gym", "the render_mode 'human' needs").display.quit()
            self._window = None

    def _instant(self) -> Instant:
        world = self._worlds[-1]
        time = float(world.time)
        return Instant(
            time=time,
            period=round(time / float(self._scenario.control_period)),
            evader=np.asarray(world.evader, float),
            poses=np.asarray(world.pursuers, float),
            obstacles=np.asarray(world.obstacles, float)[:, :2],
            target=np.asarray(world.target, float),
            nominal=self._nominal,
            action=np.asarray(world.evader_velocity, float),
        )

    def _trails(self) -> tuple[Any, ...]:
        evader = self._path("evader")
        others = [
            (path, colour)
            for part, colour in (("pursuers", style.PURSUER), ("obstacles", style.OBSTACLE))
            for path in np.moveaxis(self._path(part)[..., :2], 1, 0)
        ]
        sizes = np.array(self._corrections)
        pieces = np.stack([evader[:-1], evader[1:]], axis=1)[sizes > _VISIBLE]
        largest = 2.0 * float(self._scenario.evader_speed)
        colours = correction_colours()(np.clip(sizes[sizes > _VISIBLE] / largest, 0.0, 1.0))
        return evader, evader[:0], others, pieces, np.asarray(colours).reshape(-1, 4)

    def _path(self, part: str) -> Float[np.ndarray, "n ..."]:
        return np.stack([np.asarray(getattr(world, part), float) for world in self._worlds])

    def _fit_axes(self) -> None:
        """Widen the axes until all robots are visible; in steps, so that pictures do not jitter."""
        world = self._worlds[-1]
        places = [world.evader, world.target, *world.pursuers[:, :2], *world.obstacles[:, :2]]
        reach = max(float(np.abs(place).max()) for place in places) + _MARGIN
        if reach <= self._half:
            return
        half = max(self._half, float(self._scenario.arena_side) / 2.0 + _MARGIN)
        while half < reach:
            half *= _WIDENED
        self._half = half
        with style.house_style():
            figure = Figure(figsize=(_PIXELS / _DPI, _PIXELS / _DPI), dpi=_DPI)
            self._canvas = FigureCanvasAgg(figure)
            axes = figure.add_axes((0.085, 0.065, 0.89, 0.89))
            axes.set_xlim(-half, half)
            axes.set_ylim(-half, half)
            style.light_grid(axes)
            now = self._instant()
            others = len(now.poses) + len(now.obstacles)
            self._panel = MovingPanel(
                axes, self._scenario, now, trails=others, pursuit=self._pursuit, levels=_LEVELS
            )
            self._words = figure.text(0.085, 0.965, "", color=style.INK, fontsize=9.0, fontweight="bold")
            self._words.set_animated(True)
            self._canvas.draw()
        self._still = self._canvas.copy_from_bbox(figure.bbox)


@final
class Screen:
    """Renders an environment's episode according to its render mode; nothing if that is None."""

    def __init__(self, mode: str | None, scenario: Scenario, shield: Any, rate: int):
        self._mode, self._about, self._rate = mode, (scenario, shield), rate
        self._picture: Picture | None = None

    def follow(
        self, world: Callable[[], World], info: dict[str, Any] | None = None, *, begun: bool = False
    ) -> None:
        """Add `world()`, the first of an episode if `begun`; with `human`, show it."""
        if self._mode is None:
            return
        if self._picture is None:
            self._picture = Picture(*self._about)
        if begun:
            self._picture.clear()
        self._picture.follow(world(), info)
        if self._mode == "human":
            self._picture.show(self._rate)

    def pixels(self) -> UInt8[np.ndarray, "height width 3"] | None:
        """The pixels with `rgb_array` once an episode has begun, else None."""
        return self._picture.drawn() if self._picture is not None and self._mode == "rgb_array" else None

    def close(self) -> None:
        """Close the window, if there is one."""
        if self._picture is not None:
            self._picture.close()
            self._picture = None
