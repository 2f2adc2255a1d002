"""Wrappers: our shield around anyone's environment, and the step of six values that Safety-Gymnasium has."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, final

import equinox as eqx
import gymnasium
import numpy as np

from sidestep.safety import Shield, Status
from sidestep.world import World


def _call(shield: Shield, world: World, nominal: Any, memory: Any) -> Any:
    return shield(world, nominal, memory)


def _init(shield: Shield, world: World) -> Any:
    return shield.init(world)


@final
class ShieldWrapper(gymnasium.Wrapper):
    """A shield between a learner and anyone's environment in which the action is a velocity command.

    One step of the environment must be one control period of the shield's scenario: over longer holds its
    rows promise nothing.

    **Arguments:**

    - `shield` a `sidestep.Shield`, as `make_shield(name, scenario)` gives it
    - `world_of(env) -> World` reads where everybody is (SI units) from the wrapped environment
    - `velocity_of(action, world) -> (2,)` m/s in world axes that an action asks for; by default the action
    - `action_of(velocity, world)` the way back; by default the velocity. An action that the shield leaves as
      it is goes through untouched.

    `info` gains `proposed` and `executed` (actions), `status` (see `sidestep.safety.Status`) and
    `intervention` (m/s). Learners that store `proposed`, their own action, learn what a correction leads to.
    """

    def __init__(
        self,
        env: gymnasium.Env,
        shield: Shield,
        world_of: Callable[[gymnasium.Env], World],
        *,
        velocity_of: Callable[[Any, World], Any] | None = None,
        action_of: Callable[[np.ndarray, World], Any] | None = None,
    ):
        super().__init__(env)
        self.shield, self._world_of = shield, world_of
        self._velocity_of = velocity_of or (lambda action, world: action)
        self._action_of = action_of or (lambda velocity, world: velocity)
        self._filter, self._start = eqx.filter_jit(_call), eqx.filter_jit(_init)
        self._memory: Any = None

    def reset(self, **arguments: Any) -> tuple[Any, dict[str, Any]]:
        observation, info = self.env.reset(**arguments)
        self._memory = self._start(self.shield, self._world_of(self.env))
        return observation, info

    def step(self, action: Any) -> tuple[Any, Any, bool, bool, dict[str, Any]]:
        if self._memory is None:
            raise gymnasium.error.ResetNeeded("call reset() before the first step")
        world = self._world_of(self.env)
        wish = np.asarray(self._velocity_of(action, world), np.float32)
        if wish.shape != (2,):
            raise ValueError(f"velocity_of must give a velocity of shape (2,), not {wish.shape}")
        result, self._memory = self._filter(self.shield, world, wish, self._memory)
        status, executed = int(result.status), action
        if status != Status.OK:
            like = np.asarray(action)
            executed = np.asarray(self._action_of(np.asarray(result.action), world), like.dtype)
        observation, reward, terminated, truncated, info = self.env.step(executed)
        told = {
            "proposed": action,
            "executed": executed,
            "status": status,
            "intervention": float(result.intervention),
        }
        return observation, reward, terminated, truncated, {**info, **told}


@final
class SafetyGymnasiumWrapper(gymnasium.Wrapper):
    """`step` gives six values, with the cost third, as constrained learners want it:
    `(observation, reward, cost, terminated, truncated, info)`. The cost is `info["cost"]`.

    Gymnasium's own wrappers and checkers expect five values: put them inside this one.
    """

    def step(self, action: Any) -> tuple[Any, Any, float, bool, bool, dict[str, Any]]:  # type: ignore[override]
        observation, reward, terminated, truncated, info = self.env.step(action)
        if "cost" not in info:
            raise KeyError("this environment's info has no 'cost'")
        return observation, reward, info["cost"], terminated, truncated, info
