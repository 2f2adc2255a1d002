"""Which random key each episode of a trial uses, so that any of them can be run again alone."""

import jax
import numpy as np
from jaxtyping import Array, Int, PRNGKeyArray

from sidestep._arrays import seed_number


def as_key(key: PRNGKeyArray | int) -> PRNGKeyArray:
    """A random key from a key or a seed. **Raises** `ValueError` for a seed not from 0 to 2^32 - 1."""
    return jax.random.key(seed_number(key)) if isinstance(key, (int, np.integer)) else key


def episode_key(key: PRNGKeyArray | int, number: int | Int[Array, ""]) -> PRNGKeyArray:
    """The key of episode `number` of an evaluation with `key`: `rollout` with it runs that episode again."""
    return jax.random.fold_in(as_key(key), number)


def evaluation_seed(seed: int) -> int:
    """Seed of the episodes on which a run with this seed is measured: not those it was trained on."""
    return (seed + 1_000_000) % 2**32


def start_and_pursuit(key: PRNGKeyArray) -> tuple[PRNGKeyArray, PRNGKeyArray]:
    """Keys of one episode's start and of its pursuers, which fold in the number of the control period."""
    start_key, pursuit_key = jax.random.split(key)
    return start_key, pursuit_key
