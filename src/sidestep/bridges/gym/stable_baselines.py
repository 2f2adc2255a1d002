"""The vector environment in the interface of Stable-Baselines3 and SBX."""

from __future__ import annotations

import importlib
from collections.abc import Sequence
from typing import Any, final

import numpy as np
from gymnasium.vector import AutoresetMode

from sidestep._packages import TORCH, install
from sidestep.bridges.gym.vector import PursuedVectorEnv

try:
    _VecEnv: Any = importlib.import_module("stable_baselines3.common.vec_env").VecEnv
except ImportError as error:
    raise ValueError(
        f"its vector environments need Stable-Baselines3, which cannot be imported ({error}); "
        f"install it with: {install(TORCH)} && {install('stable-baselines3>=2.9,<2.10')}"
    ) from error


@final
class PursuedVecEnv(_VecEnv):
    """`PursuedVectorEnv` as a Stable-Baselines3 `VecEnv`; same arguments, without `autoreset_mode`.

    The next episode begins at once when one ends. Where an episode has just ended, the info holds that of
    `PursuedEnv`, `terminal_observation`, and `TimeLimit.truncated`, through which learners bootstrap. Other
    infos hold only `cost` unless `every_info` is set: with a thousand worlds, full infos take ten times as
    long as the step.
    """

    def __init__(self, num_envs: int = 1, *, every_info: bool = False, **arguments: Any):
        if "autoreset_mode" in arguments:
            raise ValueError("autoreset_mode: Stable-Baselines3 supports only one mode; leave it out")
        self.vector = PursuedVectorEnv(num_envs, autoreset_mode=AutoresetMode.SAME_STEP, **arguments)
        self.render_mode = self.vector.render_mode
        self._every_info = every_info
        self._actions: np.ndarray | None = None
        super().__init__(
            self.vector.num_envs, self.vector.single_observation_space, self.vector.single_action_space
        )

    def reset(self) -> np.ndarray:
        """Begin an episode in each world, with the seeds of `seed()` if called since the last reset."""
        seeds = None if all(seed is None for seed in self._seeds) else list(self._seeds)
        options = self._options[0] or None
        if any(other != self._options[0] for other in self._options):
            raise ValueError("set_options: all worlds take the same options, as those of PursuedVectorEnv")
        observation, _ = self.vector.reset(seed=seeds, options=options)
        self.reset_infos = [{} for _ in range(self.num_envs)]
        self._reset_seeds()
        self._reset_options()
        return observation

    def step_async(self, actions: np.ndarray) -> None:
        """Store the actions (num_envs, 2)."""
        self._actions = actions

    def step_wait(self) -> tuple[np.ndarray, np.ndarray, np.ndarray, list[dict[str, Any]]]:
        """Take the step; returns observations, rewards, dones and infos."""
        observation, reward, terminated, truncated, info = self.vector.step(self._actions)
        done = terminated | truncated
        infos: list[dict[str, Any]] = [{"cost": 0.0} for _ in range(self.num_envs)]
        if self._every_info:
            infos = [_info(info, lane) for lane in range(self.num_envs)]
        for lane in np.flatnonzero(done).tolist():
            infos[lane] = {
                **_info(info["final_info"], lane),
                "terminal_observation": info["final_obs"][lane],
                "TimeLimit.truncated": bool(truncated[lane]),
            }
        return observation, reward.astype(np.float32), done, infos

    def close(self) -> None:
        self.vector.close()

    def get_images(self) -> Sequence[np.ndarray | None]:
        return self.vector.render() or [None] * self.num_envs

    def get_attr(self, attr_name: str, indices: Any = None) -> list[Any]:
        """The attribute of `PursuedVectorEnv`, repeated for each world."""
        return [getattr(self.vector, attr_name) for _ in self._get_indices(indices)]

    def set_attr(self, attr_name: str, value: Any, indices: Any = None) -> None:
        raise AttributeError(
            f"{attr_name} cannot be set: all worlds share one task; make another environment"
        )

    def env_method(self, method_name: str, *args: Any, indices: Any = None, **kwargs: Any) -> list[Any]:
        raise AttributeError(f"{method_name} cannot be called on single worlds: they are stepped together")

    def env_is_wrapped(self, wrapper_class: Any, indices: Any = None) -> list[bool]:
        return [False for _ in self._get_indices(indices)]


def _info(vector_info: dict[str, Any], lane: int) -> dict[str, Any]:
    """One world's entries of a vector info."""
    return {
        name: value[lane].item() if value.ndim == 1 else value[lane]
        for name, value in vector_info.items()
        if not name.startswith(("_", "final_"))
    }
