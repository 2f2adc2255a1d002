"""Import MuJoCo and off-screen rendering, and say what to install if they are missing."""

from __future__ import annotations

import ctypes
import os
import sys
from typing import Any

from sidestep._packages import needed
from sidestep.views import video_files

_LIBRARIES = {"egl": ("libEGL.so.1",), "osmesa": ("libOSMesa.so.8", "libOSMesa.so.6", "libOSMesa.so")}


class TwinError(ValueError):
    """A plant in MuJoCo cannot run; the message says what to install or change."""


def check_robots(world: Any, pursuers: int, obstacles: int) -> None:
    """**Raises** `TwinError` if the world's numbers of robots differ from the scenario's."""
    if (len(world.pursuers), len(world.obstacles)) != (pursuers, obstacles):
        raise TwinError(
            f"the world has {len(world.pursuers)} pursuers and {len(world.obstacles)} obstacles, "
            f"the scenario {pursuers} and {obstacles}"
        )


def load_mujoco() -> Any:
    """The module `mujoco`, set up to render without a screen where that is possible.

    MuJoCo chooses how to render when it is first imported, from the variable `MUJOCO_GL`. Unless the user
    has set it, and unless there is a display, it becomes `egl` or `osmesa`, whichever has its library.

    **Raises** `TwinError` when MuJoCo is not installed.
    """
    screen = os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY")
    if sys.platform == "linux" and "MUJOCO_GL" not in os.environ and not screen:
        backend = offscreen_backend()
        if backend is not None:
            os.environ["MUJOCO_GL"] = backend
    return needed("mujoco", "twin", "the physics twin needs", TwinError)


def offscreen_backend() -> str | None:
    """`egl` or `osmesa`, the first whose library this Linux machine has; None if it has neither."""
    for backend, names in _LIBRARIES.items():
        if any(_loads(name) for name in names):
            return backend
    return None


def load_av() -> Any:
    """The module `av` (PyAV), which writes video files. **Raises** `TwinError` when it is not installed."""
    try:
        return video_files.load_av("twin")
    except video_files.VideoError as error:
        raise TwinError(str(error)) from error


def make_renderer(model: Any, height: int, width: int, most_shapes: int) -> Any:
    """A `mujoco.Renderer` of frames (height, width, 3) that can draw this many shapes.

    **Raises** `TwinError` naming the Debian packages when this machine cannot render off-screen.
    """
    mujoco = load_mujoco()
    try:
        return mujoco.Renderer(model, height, width, most_shapes)
    # The OpenGL bindings raise various exceptions when something is missing.
    except Exception as error:
        backend = os.environ.get("MUJOCO_GL", "the default one")
        raise TwinError(
            f"this machine cannot render off-screen (OpenGL through {backend}): {error}. On Debian, "
            "Ubuntu: apt-get install libegl1 libegl-mesa0 (or libosmesa6, which needs no "
            "graphics card and no display either); then unset MUJOCO_GL, or set it to egl or osmesa"
        ) from error


def _loads(name: str) -> bool:
    try:
        ctypes.CDLL(name)
    except OSError:
        return False
    return True
