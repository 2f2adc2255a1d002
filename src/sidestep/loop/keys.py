"""Random keys of episodes, so that any episode of an evaluation can be replayed alone."""

import jax
import numpy as np
from jaxtyping import Array, Int, PRNGKeyArray

from sidestep._arrays import seed_number


def as_key(key: PRNGKeyArray | int) -> PRNGKeyArray:
    """A random key from a key or a seed. **Raises** `ValueError` for a seed outside 0 to 2^32 - 1."""
    return jax.random.key(seed_number(key)) if isinstance(key, (int, np.integer)) else key


def episode_key(key: PRNGKeyArray | int, number: int | Int[Array, ""]) -> PRNGKeyArray:
    """The key of episode `number` of an evaluation with `key`; `rollout` with it replays the episode."""
    return jax.random.fold_in(as_key(key), number)


def evaluation_seed(seed: int) -> int:
    """The seed of the evaluation of a run with this seed; it differs from the training's."""
    return (seed + 1_000_000) % 2**32


def start_and_pursuit(key: PRNGKeyArray) -> tuple[PRNGKeyArray, PRNGKeyArray]:
    """An episode's keys for its start and for its pursuers; the latter is folded with the period's number."""
    start_key, pursuit_key = jax.random.split(key)
    return start_key, pursuit_key
