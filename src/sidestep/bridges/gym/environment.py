"""One world as a Gymnasium environment."""

from __future__ import annotations

import copy
from typing import Any, final

import gymnasium
import jax
import numpy as np

from sidestep._arrays import seed_number
from sidestep.bridges.gym.calls import bundle_of, bundled, flat, packed, seed_words, unpacked_one
from sidestep.bridges.gym.episode import EnvState, begin, begin_in, decide, seen
from sidestep.bridges.gym.rendering import Screen, check_render_mode
from sidestep.bridges.gym.spaces import action_space, checked_action, observation_space
from sidestep.bridges.gym.task import Task, make_task
from sidestep.bridges.gym.worlds import checked_options, given_world
from sidestep.world import World


def _begin(task: Task, words: Any, number: Any) -> tuple[list[Any], Any]:
    episode = begin(task, words, number)
    return jax.tree.leaves(episode), seen(task, episode)


def _begin_in(task: Task, world: World, words: Any, number: Any) -> tuple[list[Any], Any]:
    episode = begin_in(task, world, words, number)
    return jax.tree.leaves(episode), seen(task, episode)


def _step(task: Task, episode: EnvState, action: Any) -> tuple[list[Any], Any, Any, Any]:
    episode, made = decide(task, episode, action)
    return jax.tree.leaves(episode), seen(task, episode), *packed(made)


@final
class PursuedEnv(gymnasium.Env):
    """`sidestep/Pursued-v0`: the evader must reach its target while pursuers chase it, behind a shield.

    Arguments are those of `make_task`: `scenario` (with its fields by name), `shield`, `pursuer`,
    `decision_steps` control periods per step, `reward_scale`; and `render_mode`.

    - The observation is that of `sidestep.observe`. The action is the nominal velocity over the evader's
      speed, in the same axes.
    - `terminated` is true when captured, collided or at the target, `truncated` after the scenario's
      `episode_steps` control periods.
    - The reward is the scenario's, summed over the step's control periods, times `reward_scale`.
    - `info` has `cost` (1.0 for a capture or collision), the flags `captured`, `collided`, `reached` and
      `timed_out`, the shield's worst `status` and mean `intervention` (m/s) of the step, the action
      `proposed` and the mean action `executed`, the least `pursuer_clearance` and `obstacle_clearance` (m),
      the number of control `periods` simulated, and `pursuer_invalid`: those in which a pursuer's wheel
      speeds were not finite and it stood still.
    - `reset(seed=s)` begins episode 0 of `sidestep.evaluate(..., key=s)`, each further `reset()` the next.
      `reset(options={"world": ...})` starts in a given `World`, or in a mapping of its parts.
    """

    # Set for each environment, because `render_fps` depends on the task.
    metadata: dict[str, Any] = {"render_modes": ["human", "rgb_array"], "render_fps": 20}  # noqa: RUF012

    def __init__(
        self,
        scenario: Any = "paper",
        shield: Any = "joint",
        pursuer: Any = "nash",
        decision_steps: int = 10,
        reward_scale: float = 1.0,
        render_mode: str | None = None,
        **fields: Any,
    ):
        self.render_mode = check_render_mode(render_mode)
        self.task = make_task(scenario, shield, pursuer, decision_steps, reward_scale, **fields)
        self.scenario = self.task.scenario
        self.metadata = {**type(self).metadata, "render_fps": self.task.pictures_per_second}
        self.observation_space = observation_space(self.scenario)
        self.action_space = action_space()
        self._words, self._number = np.zeros(2, np.uint32), -1
        self._episode: list[Any] | None = None
        self._over = True
        self._compile()

    def _compile(self) -> None:
        self._task, self._layout = bundled(self.task), bundle_of(self.task)
        shapes = jax.ShapeDtypeStruct((2,), np.uint32), jax.ShapeDtypeStruct((), np.int32)
        example = jax.eval_shape(begin, self.task, *shapes)
        self._inner = jax.tree.structure(example)
        self._screen = Screen(self.render_mode, self.scenario, self.task.shield, self.metadata["render_fps"])

    def __getstate__(self) -> dict[str, Any]:
        return {
            name: value
            for name, value in self.__dict__.items()
            if name not in ("_task", "_layout", "_inner", "_screen")
        }

    def __setstate__(self, state: dict[str, Any]) -> None:
        self.__dict__.update(state)
        self._compile()

    def __deepcopy__(self, memo: dict[int, Any]) -> PursuedEnv:
        twin = type(self).__new__(type(self))
        memo[id(self)] = twin
        # Arrays are immutable, so both may share them.
        shared = {name: self.__getstate__()[name] for name in ("task", "scenario", "_episode")}
        rest = {name: value for name, value in self.__getstate__().items() if name not in shared}
        twin.__setstate__({**copy.deepcopy(rest, memo), **shared})
        return twin

    @property
    def world(self) -> World:
        """The current world. **Raises** `gymnasium.error.ResetNeeded` before the first `reset`."""
        return jax.tree.unflatten(self._inner, self._now()).world

    def _now(self) -> list[Any]:
        if self._episode is None:
            raise gymnasium.error.ResetNeeded("call reset() before anything else")
        return self._episode

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[np.ndarray, dict[str, Any]]:
        options = checked_options(options, "world")
        if seed is not None:
            seed_number(seed)
        super().reset(seed=seed)
        if seed is not None or self._number < 0:
            self._words, self._number = seed_words([self.np_random_seed])[:, 0], -1
        self._number += 1
        number = np.asarray(self._number, np.int32)
        if "world" in options:
            world = given_world(self.scenario, options["world"])
            leaves, structure = jax.tree.flatten(world)
            made = flat(_begin_in, self._layout, structure)((self._task, leaves), self._words, number)
        else:
            made = flat(_begin, self._layout)((self._task,), self._words, number)
        self._episode, observation = made
        self._over = False
        self._screen.follow(lambda: self.world, begun=True)
        return np.array(observation), {}

    def step(self, action: Any) -> tuple[np.ndarray, float, bool, bool, dict[str, Any]]:
        if self._over:
            raise gymnasium.error.ResetNeeded("the episode is over, or has not begun: call reset()")
        program = flat(_step, self._layout, self._inner)
        made = program((self._task, self._now()), checked_action(action, (2,)))
        self._episode, observation, floats, whole = made
        reward, terminated, truncated, info = unpacked_one(floats, whole)
        self._over = terminated or truncated
        self._screen.follow(lambda: self.world, info)
        return np.array(observation), reward, terminated, truncated, info

    def render(self) -> np.ndarray | None:
        """The scene as pixels (height, width, 3) with `rgb_array`; None with `human`, which uses a window."""
        if self.render_mode is None:
            gymnasium.logger.warn("render() shows nothing without a render_mode: give one to gymnasium.make")
            return None
        self._now()
        return self._screen.pixels()

    def close(self) -> None:
        self._screen.close()
