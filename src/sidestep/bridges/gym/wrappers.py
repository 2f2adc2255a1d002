"""Wrappers: a shield for any environment, and the six-value `step` of Safety-Gymnasium."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, final

import equinox as eqx
import gymnasium
import jax
import jax.numpy as jnp
import numpy as np
from gymnasium.vector import AutoresetMode

from sidestep._arrays import real, select
from sidestep.safety import Shield, Status, checked_shield, filter_in_lanes, start_in_lanes
from sidestep.world import World


def in_lanes(worlds: World) -> World:
    """Worlds with their axis first, converted to lanes (axis last)."""
    return jax.tree.map(lambda leaf: jnp.moveaxis(real(leaf), 0, -1), worlds)


def _call(shield: Shield, world: World, nominal: Any, memory: Any) -> Any:
    return shield(world, nominal, memory)


def _init(shield: Shield, world: World) -> Any:
    return shield.init(world)


@final
class ShieldWrapper(gymnasium.Wrapper):
    """A shield between a learner and any environment whose action is a velocity command.

    One step of the environment must be one control period of the shield's scenario. If an action is held
    longer, the shield guarantees nothing.

    **Arguments:**

    - `shield` a `sidestep.Shield`, as `make_shield(name, scenario)` gives it
    - `world_of(env) -> World` reads the world (SI units) from the wrapped environment
    - `velocity_of(action, world) -> (2,)` the nominal velocity of an action, m/s in world axes; by default
      the action itself
    - `action_of(velocity, world)` its inverse; by default the velocity itself. An action that the shield does
      not change is passed on as it is.

    `info` gains `proposed` and `executed` (actions), `status` (see `sidestep.safety.Status`) and
    `intervention` (m/s). A learner should store `proposed`: the shield is then part of its environment.

    **Raises** `ValueError` for a shield's name in place of a `Shield`, and for a velocity of wrong shape.
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
        self.shield, self._world_of = checked_shield(shield), world_of
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
        nominal = np.asarray(self._velocity_of(action, world), np.float32)
        if nominal.shape != (2,):
            raise ValueError(f"velocity_of must give a velocity of shape (2,), not {nominal.shape}")
        result, self._memory = self._filter(self.shield, world, nominal, self._memory)
        status, executed = int(result.status), action
        if status != Status.OK:
            like = np.asarray(action)
            executed = np.asarray(self._action_of(np.asarray(result.action), world), like.dtype)
        observation, reward, terminated, truncated, info = self.env.step(executed)
        added = {
            "proposed": action,
            "executed": executed,
            "status": status,
            "intervention": float(result.intervention),
        }
        return observation, reward, terminated, truncated, {**info, **added}


@eqx.filter_jit
def _start_all(shield: Shield, worlds: World) -> Any:
    return start_in_lanes(shield, in_lanes(worlds))


@eqx.filter_jit
def _filter_all(shield: Shield, worlds: World, nominal: Any, memory: Any, fresh: Any) -> Any:
    world = in_lanes(worlds)
    memory = select(fresh, start_in_lanes(shield, world), memory)
    result, memory = filter_in_lanes(shield, world, jnp.moveaxis(nominal, 0, -1), memory)
    return jnp.moveaxis(result.action, -1, 0), result.status, result.intervention, memory


@final
class ShieldVectorWrapper(gymnasium.vector.VectorWrapper):
    """`ShieldWrapper` for any vector environment: all worlds are filtered in one compiled call.

    Arguments as in `ShieldWrapper`, for all worlds at once: `worlds_of(env) -> World` with their axis first,
    `velocities_of(actions, worlds) -> (n, 2)` and `actions_of(velocities, worlds)`. `info` gains the same
    entries, as arrays with masks. Actions that the shield does not change are passed on as they are. A
    world's shield memory is reset when an episode begins, in each of the three autoreset modes.

    **Raises** `ValueError` for a shield's name in place of a `Shield`, and for velocities of wrong shape.
    """

    def __init__(
        self,
        env: gymnasium.vector.VectorEnv,
        shield: Shield,
        worlds_of: Callable[[gymnasium.vector.VectorEnv], World],
        *,
        velocities_of: Callable[[Any, World], Any] | None = None,
        actions_of: Callable[[np.ndarray, World], Any] | None = None,
    ):
        super().__init__(env)
        self.shield, self._worlds_of = checked_shield(shield), worlds_of
        self._velocities_of = velocities_of or (lambda actions, worlds: actions)
        self._actions_of = actions_of or (lambda velocities, worlds: velocities)
        self._mode = AutoresetMode(env.metadata.get("autoreset_mode", AutoresetMode.NEXT_STEP))
        self._memory: Any = None
        self._fresh = self._ended = np.zeros(env.num_envs, bool)

    def reset(
        self, *, seed: int | list[int | None] | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Any, dict[str, Any]]:
        # Gymnasium's wrapper declares one seed only; the environments accept a list as well.
        inner: Any = self.env
        observation, info = inner.reset(seed=seed, options=options)
        begun = np.asarray((options or {}).get("reset_mask", np.ones(self.num_envs, bool)), bool)
        if self._memory is None:
            self._memory = _start_all(self.shield, self._worlds_of(self.env))
        self._fresh, self._ended = self._fresh | begun, self._ended & ~begun
        return observation, info

    def step(self, actions: Any) -> tuple[Any, Any, Any, Any, dict[str, Any]]:
        if self._memory is None:
            raise gymnasium.error.ResetNeeded("call reset() before the first step")
        worlds = self._worlds_of(self.env)
        nominal = np.asarray(self._velocities_of(actions, worlds), np.float32)
        if nominal.shape != (self.num_envs, 2):
            raise ValueError(
                f"velocities_of must give velocities of shape ({self.num_envs}, 2), not {nominal.shape}"
            )
        filtered = _filter_all(self.shield, worlds, nominal, self._memory, self._fresh)
        velocities, status, intervention = (np.asarray(part) for part in filtered[:3])
        self._memory = filtered[3]
        proposed = np.asarray(actions)
        executed, corrected = proposed.copy(), status != Status.OK
        if np.any(corrected):
            executed[corrected] = np.asarray(self._actions_of(velocities, worlds))[corrected]
        observation, reward, terminated, truncated, info = self.env.step(executed)
        ended = np.asarray(terminated) | np.asarray(truncated)
        self._fresh = {
            AutoresetMode.SAME_STEP: ended,
            AutoresetMode.NEXT_STEP: self._ended,
            AutoresetMode.DISABLED: np.zeros_like(ended),
        }[self._mode]
        # A step that begins an episode ignores its action.
        acted = ~self._fresh if self._mode is AutoresetMode.NEXT_STEP else np.ones_like(ended)
        self._ended = ended
        added = {
            "proposed": proposed,
            "executed": executed,
            "status": status,
            "intervention": intervention,
        }
        added |= {f"_{name}": acted.copy() for name in added}
        return observation, reward, terminated, truncated, {**info, **added}


@final
class SafetyGymnasiumWrapper(gymnasium.Wrapper):
    """`step` returns six values, as constrained learners expect: `(observation, reward, cost, terminated,
    truncated, info)`. The cost is `info["cost"]`.

    Gymnasium's wrappers and checkers expect five values: apply them inside this one.
    """

    def step(self, action: Any) -> tuple[Any, Any, float, bool, bool, dict[str, Any]]:  # type: ignore[override]
        observation, reward, terminated, truncated, info = self.env.step(action)
        if "cost" not in info:
            raise KeyError("this environment's info has no 'cost'")
        return observation, reward, info["cost"], terminated, truncated, info
