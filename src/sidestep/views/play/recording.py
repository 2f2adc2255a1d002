"""One episode kept period by period, in bounded memory."""

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
    """The periods since `restart`, at most `most` of them: later ones are left out.

    **Arguments:** `place` of the world at the beginning of a period, `told` of what a `Program` said of it.
    """

    def __init__(self, place: Layout, told: Layout, most: int):
        self._place, self._told = place, told
        # Pages that are never written take no memory.
        self._begun = np.empty((most, place.size), np.float32)
        self._said = np.empty((most, told.size), np.float32)
        self.length = 0

    @property
    def full(self) -> bool:
        """Whether nothing more is taken."""
        return self.length == len(self._said)

    def restart(self) -> None:
        """Forget everything: what comes next does not follow from what was."""
        self.length = 0

    def add(self, begun: Any, said: Any) -> None:
        """One period: the world at its beginning, and what was told of it, as vectors."""
        if not self.full:
            self._begun[self.length] = begun
            self._said[self.length] = said
            self.length += 1

    def copy(self) -> tuple[np.ndarray, np.ndarray]:
        """What has been recorded, to make a trajectory of while the game goes on."""
        return self._begun[: self.length].copy(), self._said[: self.length].copy()

    def trajectory(self, begun: np.ndarray, said: np.ndarray) -> Trajectory:
        """What `copy` returned, as all else in the package knows an episode.

        **Raises** `ValueError` when nothing has been recorded.
        """
        if not len(said):
            raise ValueError("nothing has been recorded yet")
        first, told = self._place.split(begun), self._told.split(said)
        parts = {name: np.concatenate([first[name], told[name][-1:]]) for name in self._place.shapes}
        flags = {name: jnp.asarray(told[name] > 0.5) for name in _FLAGS}
        rest = {name: jnp.asarray(told[name]) for name in EVENTS if name not in _FLAGS}
        return Trajectory(
            worlds=worlds_of(parts),
            wheel_speeds=jnp.asarray(told["wheels"]),
            status=jnp.asarray(told["status"].astype(np.int32)),
            events=Events(**flags, **rest),
            **{name: jnp.asarray(told[name]) for name in _TAKEN},
        )
