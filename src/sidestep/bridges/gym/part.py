"""The worlds of a vector environment that one thread steps."""

from __future__ import annotations

from typing import Any, final

import jax
import numpy as np

from sidestep.bridges.gym import fleet as fleets
from sidestep.bridges.gym.calls import bundle_of, bundled, flat, packed
from sidestep.bridges.gym.fleet import AHEAD, Fleet, Spares
from sidestep.bridges.gym.task import Task
from sidestep.world import World

_DRAWN_AT_ONCE = 256


def _launch(task: Task, words: Any, number: Any) -> tuple[list[Any], list[Any], Any]:
    fleet = fleets.launch(task, words, number)
    return _leaves(fleet), bundled(fleets.no_spares(fleet)), fleets.seen(task, fleet.episode)


def _place(task: Task, fleet: Fleet, world: World) -> tuple[list[Any], Any]:
    fleet = fleets.place(task, fleet, world)
    return _leaves(fleet), fleets.seen(task, fleet.episode)


def _follow(task: Task, fleet: Fleet, spares: Spares, where: Any) -> tuple[list[Any], Any]:
    fleet = fleets.follow(fleet, spares, where)
    return _leaves(fleet), fleets.seen(task, fleet.episode)


def _draw(task: Task, fleet: Fleet, spares: Spares, lanes: Any, numbers: Any) -> list[Any]:
    return bundled(fleets.draw(task, fleet, spares, lanes, numbers))


def _leaves(tree: Any) -> list[Any]:
    return jax.tree.leaves(tree)


def _stepper(mode: str) -> Any:
    def step(task: Task, fleet: Fleet, spares: Spares, actions: Any) -> tuple[Any, ...]:
        fleet, result = fleets.step(task, mode, fleet, spares, actions)
        return _leaves(fleet), result.observation, result.final, *packed(result.decision)

    return step


_STEP = {mode: _stepper(mode) for mode in (fleets.NEXT_STEP, fleets.SAME_STEP, fleets.DISABLED)}


@final
class Part:
    """The worlds of one thread, in the layout of the compiled programs. `where` is their slice of all
    worlds."""

    def __init__(self, task: Task, mode: str, where: slice):
        self.where, self.size = where, where.stop - where.start
        self._task_of, self._mode = task, mode
        self._task, self._layout = bundled(task), bundle_of(task)
        self._fleet: list[Any] = []
        self._spares: list[Any] = []
        self._layouts: tuple[Any, ...] = ()

    @property
    def world(self) -> World:
        """The current worlds, in lanes."""
        return jax.tree.unflatten(self._layouts[1], self._fleet).episode.world

    def _trees(self) -> tuple[list[Any], ...]:
        return self._task, self._fleet, self._spares

    def launch(self, words: Any, numbers: Any) -> np.ndarray:
        """Begin these episodes; returns the observation, as `place` and `follow` do."""
        words, numbers = words[:, self.where], numbers[self.where]
        launch = flat(_launch, self._layout)
        self._fleet, self._spares, observation = launch((self._task,), words, numbers)
        fleet = jax.eval_shape(fleets.launch, self._task_of, words, numbers)
        spares = bundle_of(jax.eval_shape(fleets.no_spares, fleet))
        self._layouts = self._layout, jax.tree.structure(fleet), spares
        return np.asarray(observation)

    def place(self, world: World) -> np.ndarray:
        leaves, structure = jax.tree.flatten(jax.tree.map(lambda leaf: leaf[..., self.where], world))
        place = flat(_place, *self._layouts[:2], structure)
        self._fleet, observation = place((self._task, self._fleet, leaves))
        return np.asarray(observation)

    def follow(self, mask: Any) -> np.ndarray:
        self._fleet, observation = flat(_follow, *self._layouts)(self._trees(), mask[self.where])
        return np.asarray(observation)

    def draw(self, lanes: Any, numbers: Any) -> None:
        """Draw the starts of these episodes; `lanes` are numbered over all worlds."""
        mine = (lanes >= self.where.start) & (lanes < self.where.stop)
        lanes, numbers = lanes[mine] - self.where.start, numbers[mine]
        draw, chunk = flat(_draw, *self._layouts), min(_DRAWN_AT_ONCE, AHEAD * self.size)
        for first in range(0, len(lanes), chunk):
            some = np.full((2, chunk), self.size, np.int32)
            part = lanes[first : first + chunk], numbers[first : first + chunk]
            some[:, : len(part[0])] = part
            self._spares = draw(self._trees(), some[0], some[1])

    def program(self, actions: Any) -> tuple[Any, ...]:
        """Compute a step, as device arrays, without changing the state."""
        return flat(_STEP[self._mode], *self._layouts)(self._trees(), actions[self.where])

    def step(self, actions: Any) -> tuple[Any, ...]:
        """Take a step; returns observation, final observation (with `SAME_STEP`) and arrays of `packed`."""
        self._fleet, *made = self.program(actions)
        return tuple(None if one is None else np.asarray(one) for one in made)
