"""Compiled programs that are called thousands of times a second: what may be flat, is."""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from sidestep.bridges.gym.episode import Decision

FLAGS = ("captured", "collided", "reached", "timed_out")
_WHOLE = (*FLAGS, "status", "periods")


@functools.lru_cache(maxsize=64)
def flat(function: Callable[..., Any], structure: Any) -> Callable[..., Any]:
    """`function(*trees, *arguments)` compiled, to be called as `(leaves of the trees, *arguments)`.

    Handing over a flat list costs a tenth of what JAX takes to look into a tree of modules. Two tasks of the
    same structure get the same program.
    """

    @jax.jit
    def program(leaves: list[Any], *arguments: Any) -> Any:
        return function(*jax.tree.unflatten(structure, leaves), *arguments)

    return program


def packed(made: Decision) -> tuple[Float[Array, "8 *lanes"], Int[Array, "6 *lanes"]]:
    """A decision as two arrays: each array that crosses over to NumPy costs some microseconds."""
    floats = jnp.stack(
        [
            made.reward,
            made.intervention,
            *made.proposed,
            *made.executed,
            made.pursuer_clearance,
            made.obstacle_clearance,
        ]
    )
    return floats, jnp.stack([getattr(made, name).astype(jnp.int32) for name in _WHOLE])


def unpacked(floats: Any, whole: Any) -> tuple[Any, dict[str, Any]]:
    """Reward and `info` of what `packed` made, each with an axis of lanes in front if there were any."""
    floats, whole = np.asarray(floats), np.asarray(whole)
    flags = {name: whole[index] != 0 for index, name in enumerate(FLAGS)}
    return floats[0], {
        "cost": (flags["captured"] | flags["collided"]).astype(np.float64),
        **flags,
        "status": whole[4],
        "periods": whole[5],
        "intervention": floats[1],
        "proposed": np.moveaxis(floats[2:4], 0, -1),
        "executed": np.moveaxis(floats[4:6], 0, -1),
        "pursuer_clearance": floats[6],
        "obstacle_clearance": floats[7],
    }


def seed_words(seeds: Any) -> np.ndarray:
    """The words (2, n) of the random keys with these seeds: `jax.random.key(seed)`'s, below 2^32."""
    seeds = [int(seed) % 2**64 for seed in seeds]
    return np.array([[seed >> 32 for seed in seeds], [seed % 2**32 for seed in seeds]], np.uint32)
