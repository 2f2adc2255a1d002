"""Many worlds as one Gymnasium vector environment, stepped in one compiled call per thread."""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor, wait
from typing import Any, final

import gymnasium
import jax
import numpy as np
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space
from jaxtyping import Float

from sidestep._arrays import seed_number, whole_number
from sidestep._threads import useful_threads
from sidestep.bridges.gym.calls import seed_words, unpacked
from sidestep.bridges.gym.fleet import AHEAD
from sidestep.bridges.gym.part import Part
from sidestep.bridges.gym.rendering import Picture, check_render_mode
from sidestep.bridges.gym.spaces import action_space, checked_action, observation_space
from sidestep.bridges.gym.task import make_task
from sidestep.bridges.gym.worlds import checked_options, given_world
from sidestep.pursuit.foreign import runs_on_host
from sidestep.world import World

_PERIODS_PER_THREAD = 2048
"""Least number of control periods per thread and step; a thread's overhead costs about half as much."""
_WORLDS_PER_THREAD = 32
"""Least number of worlds per thread with a shield that looks ahead."""


@final
class PursuedVectorEnv(VectorEnv):
    """`num_envs` worlds of `sidestep/Pursued-v0`, as from `gymnasium.make_vec`; arguments as in `PursuedEnv`.

    `autoreset_mode` (an `AutoresetMode` or its value) selects when the next episode begins after one ends:

    - `NEXT_STEP` (Gymnasium's default): in the next step; that world ignores the action and gets reward 0
    - `SAME_STEP`: at once; the last observation and info are in `info["final_obs"]` and `info["final_info"]`
    - `DISABLED`: on `reset(options={"reset_mask": mask})`

    `reset(seed=s)` seeds world i with s + i; a list gives one seed per world. World i then runs the same
    episodes as a `PursuedEnv` with that seed, to rounding.

    `threads` is the largest number of threads; by default as many as there are cores and enough work for. It
    changes only the speed.
    """

    # Set for each environment, because `render_fps` depends on the task.
    metadata: dict[str, Any] = {  # noqa: RUF012
        "render_modes": ["rgb_array"],
        "render_fps": 20,
        "autoreset_mode": AutoresetMode.NEXT_STEP,
    }

    def __init__(
        self,
        num_envs: int = 1,
        scenario: Any = "paper",
        shield: Any = "joint",
        pursuer: Any = "nash",
        decision_steps: int = 10,
        reward_scale: float = 1.0,
        autoreset_mode: AutoresetMode | str = AutoresetMode.NEXT_STEP,
        render_mode: str | None = None,
        threads: int | None = None,
        **fields: Any,
    ):
        if render_mode not in (None, "rgb_array"):
            raise ValueError(f"render_mode = {render_mode!r}: many worlds are drawn as 'rgb_array' only")
        super().__init__()
        self.render_mode = check_render_mode(render_mode)
        self.num_envs = whole_number("num_envs", num_envs)
        try:
            self.autoreset_mode = AutoresetMode(autoreset_mode)
        except ValueError:
            modes = ", ".join(repr(mode.value) for mode in AutoresetMode)
            raise ValueError(f"autoreset_mode = {autoreset_mode!r}: it must be one of {modes}") from None
        self.task = make_task(scenario, shield, pursuer, decision_steps, reward_scale, **fields)
        self.scenario = self.task.scenario
        self.metadata = {
            **type(self).metadata,
            "render_fps": self.task.pictures_per_second,
            "autoreset_mode": self.autoreset_mode,
        }
        self.single_observation_space = observation_space(self.scenario)
        self.single_action_space = action_space()
        self.observation_space = batch_space(self.single_observation_space, self.num_envs)
        self.action_space = batch_space(self.single_action_space, self.num_envs)
        count = self._useful_threads(threads)
        size = self.num_envs // count
        cuts = [slice(part * size, (part + 1) * size) for part in range(count)]
        self._parts = [Part(self.task, self.autoreset_mode.value, cut) for cut in cuts]
        self._pool: ThreadPoolExecutor | None = None
        self._compiled: set[str] = set()
        self._words = np.zeros((2, self.num_envs), np.uint32)
        # Per lane: number of the running episode, and of the last episode whose start has been drawn.
        self._numbers = np.full(self.num_envs, -1, np.int32)
        self._drawn = self._numbers.copy()
        self._ended = np.ones(self.num_envs, bool)
        self._launched = False

    def _useful_threads(self, most: int | None) -> int:
        """The number of threads with enough work each. It divides the worlds equally, because each batch size
        compiles separately."""
        if most is not None:
            most = whole_number("threads", most)
        if runs_on_host(self.task.pursuer, self.scenario):
            return 1
        if self.task.shield.looks_ahead:
            worth = self.num_envs // _WORLDS_PER_THREAD
        else:
            worth = self.num_envs * self.task.decision_steps // _PERIODS_PER_THREAD
        count = useful_threads(max(1, worth if most is None else min(most, self.num_envs)))
        return next(part for part in range(count, 0, -1) if self.num_envs % part == 0)

    def _each(self, name: str, work: Callable[[Part], Any]) -> list[Any]:
        """Call `work` with each part, in threads; the first time in turn, to compile the program once."""
        first, *others = self._parts
        if not others or name not in self._compiled:
            self._compiled.add(name)
            return [work(part) for part in self._parts]
        if self._pool is None:
            self._pool = ThreadPoolExecutor(len(others))
        running = [self._pool.submit(work, part) for part in others]
        try:
            mine = work(first)
        finally:
            wait(running)
        return [mine, *(one.result() for one in running)]

    def close_extras(self, **kwargs: Any) -> None:
        """End the threads."""
        if self._pool is not None:
            self._pool.shutdown()
            self._pool = None

    @property
    def worlds(self) -> World:
        """All current worlds, with their axis first. **Raises** `ResetNeeded` before a `reset`."""
        self._check_launched()
        worlds = [part.world for part in self._parts]
        return jax.tree.map(
            lambda *leaves: np.concatenate([np.moveaxis(np.asarray(leaf), -1, 0) for leaf in leaves]), *worlds
        )

    def _check_launched(self) -> None:
        if not self._launched:
            raise gymnasium.error.ResetNeeded("call reset() before anything else")

    def reset(
        self, *, seed: int | list[int | None] | None = None, options: dict[str, Any] | None = None
    ) -> tuple[np.ndarray, dict[str, Any]]:
        options = checked_options(options, "world", "reset_mask")
        if "reset_mask" in options:
            if "world" in options:
                raise ValueError("options: 'world' starts all worlds anew and takes no 'reset_mask'")
            return self._reset_some(seed, options["reset_mask"])
        fresh = self._seed(seed)
        self._numbers = np.where(fresh, 0, self._numbers + 1).astype(np.int32)
        self._drawn = self._numbers.copy()
        observations = self._each("launch", lambda part: part.launch(self._words, self._numbers))
        self._launched = True
        if "world" in options:
            world = given_world(self.scenario, options["world"], (self.num_envs,))
            observations = self._each("place", lambda part: part.place(world))
        self._ended = np.zeros(self.num_envs, bool)
        return np.concatenate(observations), {}

    def _seed(self, seed: Any) -> np.ndarray:
        """Set the random keys; returns which worlds got a new one."""
        if seed is None and not self._launched:
            seed = self.np_random_seed
        elif isinstance(seed, (int, np.integer)):
            seed_number(seed)
            seed_number(int(seed) + self.num_envs - 1, "the seed of the last world")
        elif seed is not None:
            for one in seed:
                seed_number(0 if one is None else one)
        if seed is None:
            return np.zeros(self.num_envs, bool)
        if isinstance(seed, (int, np.integer)):
            super().reset(seed=int(seed))
            seed = [int(seed) + lane for lane in range(self.num_envs)]
        if len(seed) != self.num_envs:
            raise ValueError(f"{len(seed)} seeds for {self.num_envs} worlds")
        given = np.array([one is not None for one in seed])
        fresh = given | (self._numbers < 0)
        if np.any(fresh & ~given):
            drawn = self.np_random.integers(2**32, size=self.num_envs)
            seed = [drawn[lane] if one is None else one for lane, one in enumerate(seed)]
        words = seed_words([0 if one is None else one for one in seed])
        self._words = np.where(fresh, words, self._words)
        return fresh

    def _reset_some(self, seed: Any, mask: Any) -> tuple[np.ndarray, dict[str, Any]]:
        mask = np.asarray(mask)
        if mask.shape != (self.num_envs,) or mask.dtype != np.bool_ or not np.any(mask):
            raise ValueError(
                f"options['reset_mask'] must be {self.num_envs} booleans, at least one of them true"
            )
        if seed is not None:
            raise ValueError(
                "options['reset_mask'] starts the next episodes of these worlds; it takes no seed"
            )
        self._check_launched()
        self._draw_ahead()
        observations = self._each("follow", lambda part: part.follow(mask))
        self._numbers[mask] += 1
        self._ended &= ~mask
        return np.concatenate(observations), {}

    def _draw_ahead(self) -> None:
        """Draw the next starts of all lanes if one lane has none left."""
        if not np.any(self._drawn <= self._numbers):
            return
        ahead = self._drawn[:, None] + np.arange(1, AHEAD + 1, dtype=np.int32)
        lanes, which = np.nonzero(ahead <= self._numbers[:, None] + AHEAD)
        numbers = ahead[lanes, which]
        self._each("draw", lambda part: part.draw(lanes, numbers))
        self._drawn = self._numbers + AHEAD

    def step(self, actions: Any) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, dict[str, Any]]:
        mode = self.autoreset_mode
        if mode is AutoresetMode.DISABLED:
            if np.any(self._ended):
                raise gymnasium.error.ResetNeeded(
                    "an episode is over: call reset(options={'reset_mask': terminated | truncated}) first"
                )
        else:
            self._draw_ahead()
        self._check_launched()
        actions = checked_action(actions, (self.num_envs, 2))
        made = zip(*self._each("step", lambda part: part.step(actions)), strict=True)
        observation, final, floats, whole = made
        reward, info = unpacked(np.concatenate(floats, axis=-1), np.concatenate(whole))
        truncated = info["timed_out"]
        terminated = info["captured"] | info["collided"] | info["reached"]
        if mode is AutoresetMode.NEXT_STEP:
            begun = self._ended
            info = self._masked(info, ~begun)
        else:
            begun = terminated | truncated
            if mode is AutoresetMode.SAME_STEP:
                info = self._final(info, np.concatenate(final), begun)
            else:
                info = self._masked(info)
        self._ended = terminated | truncated
        reward = reward.astype(np.float64)
        if mode is not AutoresetMode.DISABLED:
            self._numbers = self._numbers + begun
        return np.concatenate(observation), reward, terminated, truncated, info

    def program(self, actions: Float[np.ndarray, "worlds 2"]) -> list[tuple[Any, ...]]:
        """What `step` computes, as device arrays per thread, without changing the state."""
        return self._each("step", lambda part: jax.block_until_ready(part.program(actions)))

    def _masked(self, info: dict[str, Any], mask: np.ndarray | None = None) -> dict[str, Any]:
        """A vector info: each entry with its mask of worlds."""
        mask = np.ones(self.num_envs, bool) if mask is None else mask
        return {**info, **{f"_{name}": mask for name in info}}

    def _final(self, info: dict[str, Any], final: Any, ended: np.ndarray) -> dict[str, Any]:
        """The vector info of `SAME_STEP`: worlds whose episode ended have theirs in `final_info`."""
        infos = self._masked(info, ~ended)
        if np.any(ended):
            kept = {name: value.copy() for name, value in info.items()}
            for value in kept.values():
                value[ended] = 0
            infos |= kept
            last = np.full(self.num_envs, None, object)
            for lane in np.flatnonzero(ended):
                last[lane] = np.array(final[lane])
            infos |= {
                "final_obs": last,
                "_final_obs": ended.copy(),
                "final_info": self._masked(info, ended),
                "_final_info": ended.copy(),
            }
        return infos

    def render(self) -> tuple[np.ndarray, ...] | None:
        """The scene of every world as pixels, without paths."""
        if self.render_mode is None:
            return None
        worlds, pictures = self.worlds, []
        for lane in range(self.num_envs):
            picture = Picture(self.scenario, self.task.shield)
            picture.follow(jax.tree.map(lambda leaf: leaf[lane], worlds))  # noqa: B023
            pictures.append(picture.drawn())
        return tuple(pictures)
