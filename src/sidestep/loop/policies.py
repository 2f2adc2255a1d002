"""Custom policies, written with JAX or not, as functions that JAX can trace."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, final

import equinox as eqx
import jax
import jax.core
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from sidestep._arrays import AnyArray, real
from sidestep.loop.episode import EpisodePolicy
from sidestep.loop.planner import Planner
from sidestep.loop.step import decision_steps_of
from sidestep.world import Scenario, goal_seeking, goal_seeking_world, observation_size

GOAL_SEEKING, PLANNER = "goal-seeking", "planner"
_WRONG_SHAPE = "a policy must answer one observation with an action of shape (2,), not {}"


@final
class HostPolicy(eqx.Module):
    """A policy that needs concrete numbers (NumPy, PyTorch, Python's `if`) and runs on the host.

    Under `jit` and `vmap` it is called with one observation at a time, a new NumPy array of floats.
    """

    policy: Callable[..., Any] = eqx.field(static=True)
    decision_steps: int = eqx.field(static=True)

    def __call__(self, observation: Float[AnyArray, "observation"]) -> Float[Array, "2"]:
        dtype = real(0.0).dtype

        def ask(observations: Any) -> np.ndarray:
            observations = np.array(observations)
            flat = observations.reshape(-1, observations.shape[-1])
            answers = np.stack([_host_action(self.policy, one).astype(dtype) for one in flat])
            return answers.reshape(*observations.shape[:-1], 2)

        answer = jax.ShapeDtypeStruct((2,), dtype)
        return jax.pure_callback(ask, answer, observation, vmap_method="expand_dims")


def _host_action(policy: Callable[..., Any], observation: np.ndarray) -> np.ndarray:
    action = np.asarray(policy(observation))
    if action.shape != (2,):
        raise ValueError(_WRONG_SHAPE.format(action.shape))
    if not np.issubdtype(action.dtype, np.number) or np.issubdtype(action.dtype, np.complexfloating):
        raise ValueError(f"a policy must answer with two real numbers, not {action!r}")
    return action


def as_policy(policy: Any, scenario: Scenario, *, in_episode: bool = False) -> Callable[..., Any]:
    """A policy `(observation) -> action in [-1, 1]^2` that JAX can trace.

    **Arguments:** `policy` the name `goal-seeking` or any callable; with `in_episode` also the name `planner`
    or an `EpisodePolicy`, for callers that ask with the episode (`ask`), as no robot can. A callable that JAX
    cannot trace runs on the host, which is slower. So does one that returns something other than a JAX array
    when traced, because its NumPy random numbers, for example, would be drawn only once.

    **Raises** `TypeError` for an object that is not callable, `ValueError` for an unknown name or an answer
    that is not two real numbers, and whatever the policy raises.
    """
    if isinstance(policy, str) and policy == PLANNER:
        policy = Planner.of(scenario)
    if isinstance(policy, EpisodePolicy):
        if not in_episode:
            raise ValueError(
                f"policy {PLANNER}: it knows the pursuer's strategy, so only evaluate and rollout take it"
            )
        return policy
    if isinstance(policy, str):
        if policy != GOAL_SEEKING:
            raise ValueError(
                f"unknown policy '{policy}'; known: {GOAL_SEEKING}, {PLANNER}, or give a callable"
            )
        return goal_seeking if scenario.frame == "target" else goal_seeking_world
    if not callable(policy):
        raise TypeError(f"a policy is a callable (observation) -> action in [-1, 1]^2; got {policy!r}")
    decision_steps = decision_steps_of(policy)
    observation = real(np.zeros(observation_size(scenario)))
    traced = _traced_answer(policy, observation)
    if traced is None:
        _host_action(policy, np.array(observation))
        return HostPolicy(policy, decision_steps)
    if jnp.shape(traced) != (2,):
        raise ValueError(_WRONG_SHAPE.format(jnp.shape(traced)))
    return policy


def _traced_answer(policy: Callable[..., Any], observation: Float[Array, "observation"]) -> Any:
    """Shape and dtype of the policy's answer under tracing; None if it cannot be traced, or its answer does
    not depend on tracing."""
    traced = False

    def probe(observation: Array) -> Any:
        nonlocal traced
        answer = policy(observation)
        leaves = jax.tree.leaves(answer)
        traced = bool(leaves) and all(isinstance(leaf, jax.core.Tracer) for leaf in leaves)
        return jnp.asarray(answer)

    try:
        answer = jax.eval_shape(probe, observation)
    except Exception:
        # An error of the policy is raised again when it runs on the host.
        return None
    return answer if traced else None
