"""Record one episode period by period, in bounded memory."""

from __future__ import annotations

from typing import Any, final

import jax.numpy as jnp
import numpy as np

from sidestep.loop import Trajectory
from sidestep.views.play.layout import Layout
from sidestep.views.play.program import EVENTS
from sidestep.world import Events
from sidestep.world.state import worlds_of

_FLAGS = ("captured", "collided", "reached", "timed_out")
_TAKEN = ("nominal", "action", "barriers", "slack", "intervention")


@final
class Recording:
    """The first `most` periods since `restart`.

    **Arguments:** layouts of `place`, the world at the beginning of a period, and of a `Program`'s `outputs`.
    """

    def __init__(self, place: Layout, outputs: Layout, most: int):
        self._place, self._layout = place, outputs
        # Memory pages that are never written take no memory.
        self._begun = np.empty((most, place.size), np.float32)
        self._outputs = np.empty((most, outputs.size), np.float32)
        self.length = 0

    @property
    def full(self) -> bool:
        """Whether further periods are ignored."""
        return self.length == len(self._outputs)

    def restart(self) -> None:
        """Discard all periods."""
        self.length = 0

    def add(self, begun: Any, output: Any) -> None:
        """Add a period: the vectors of the world at its beginning and of the program's output."""
        if not self.full:
            self._begun[self.length] = begun
            self._outputs[self.length] = output
            self.length += 1

    def copy(self) -> tuple[np.ndarray, np.ndarray]:
        """A copy of the vectors, for `trajectory` while the episode continues."""
        return self._begun[: self.length].copy(), self._outputs[: self.length].copy()

    def trajectory(self, begun: np.ndarray, outputs: np.ndarray) -> Trajectory:
        """The vectors of `copy` as a `Trajectory`.

        **Raises** `ValueError` when nothing has been recorded.
        """
        if not len(outputs):
            raise ValueError("nothing has been recorded yet")
        first, output = self._place.split(begun), self._layout.split(outputs)
        parts = {name: np.concatenate([first[name], output[name][-1:]]) for name in self._place.shapes}
        flags = {name: jnp.asarray(output[name] > 0.5) for name in _FLAGS}
        rest = {name: jnp.asarray(output[name]) for name in EVENTS if name not in _FLAGS}
        return Trajectory(
            worlds=worlds_of(parts),
            wheel_speeds=jnp.asarray(output["wheels"]),
            status=jnp.asarray(output["status"].astype(np.int32)),
            events=Events(**flags, **rest),
            **{name: jnp.asarray(output[name]) for name in _TAKEN},
        )
