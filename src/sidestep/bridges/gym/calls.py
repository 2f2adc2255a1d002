"""Compiled programs that are called thousands of times a second, with few and flat arrays as arguments."""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Float, Int

from sidestep._arrays import real
from sidestep.bridges.gym.episode import Decision

FLAGS = ("captured", "collided", "reached", "timed_out")
_STATUSES = 4
_PERIODS = _STATUSES * 2 ** len(FLAGS)


class Bundle(NamedTuple):
    """The layout of a tree in one vector: its structure, and the shape of each leaf in the vector."""

    structure: Any
    shapes: tuple[tuple[int, ...] | None, ...]


def bundle_of(tree: Any) -> Bundle:
    """The layout `bundled` uses for a tree of arrays, or of their shapes."""
    leaves, structure = jax.tree.flatten(tree)
    default = real(0.0).dtype
    return Bundle(structure, tuple(leaf.shape if leaf.dtype == default else None for leaf in leaves))


def bundled(tree: Any) -> list[Any]:
    """A tree as few arrays: all leaves of the default float type as one vector, then the other leaves."""
    leaves, shapes = jax.tree.leaves(tree), bundle_of(tree).shapes
    inside = [leaf for leaf, shape in zip(leaves, shapes, strict=True) if shape is not None]
    rest = [leaf for leaf, shape in zip(leaves, shapes, strict=True) if shape is None]
    return [ravel_pytree(inside)[0], *rest]


def unbundled(parts: list[Any], bundle: Bundle) -> Any:
    """The inverse of `bundled`."""
    vector, *rest = parts
    blank = [jnp.zeros(shape, dtype=float) for shape in bundle.shapes if shape is not None]
    inside, others = iter(ravel_pytree(blank)[1](vector)), iter(rest)
    leaves = [next(others if shape is None else inside) for shape in bundle.shapes]
    return jax.tree.unflatten(bundle.structure, leaves)


@functools.lru_cache(maxsize=64)
def flat(function: Callable[..., Any], *layouts: Any) -> Callable[..., Any]:
    """`function(*trees, *arguments)` compiled, to be called with a list of arrays per tree.

    A layout is a `Bundle`, or the structure of a tree passed as its leaves. JAX takes ten times as long to
    flatten a tree of modules, and a microsecond per array. Tasks of equal layout share the program.
    """

    @jax.jit
    def program(parts: tuple[list[Any], ...], *arguments: Any) -> Any:
        trees = [
            unbundled(part, layout) if isinstance(layout, Bundle) else jax.tree.unflatten(layout, part)
            for part, layout in zip(parts, layouts, strict=True)
        ]
        return function(*trees, *arguments)

    return program


def packed(made: Decision) -> tuple[Float[Array, "9 *lanes"], Int[Array, "*lanes"]]:
    """A decision as two arrays, because each array converted to NumPy costs some microseconds."""
    floats = jnp.stack(
        [
            made.reward,
            made.intervention,
            *made.proposed,
            *made.executed,
            made.pursuer_clearance,
            made.obstacle_clearance,
            made.pursuer_invalid.astype(made.reward.dtype),
        ]
    )
    whole = made.status.astype(jnp.int32) * 2 ** len(FLAGS) + made.periods.astype(jnp.int32) * _PERIODS
    for index, name in enumerate(FLAGS):
        whole += getattr(made, name).astype(jnp.int32) * 2**index
    return floats, whole


def unpacked(floats: Any, whole: Any) -> tuple[Any, dict[str, Any]]:
    """Reward and `info` from the arrays of `packed`, with the axis of lanes (if any) first."""
    floats, whole = np.asarray(floats), np.asarray(whole)
    flags = {name: (whole & 2**index) != 0 for index, name in enumerate(FLAGS)}
    return floats[0], {
        "cost": (flags["captured"] | flags["collided"]).astype(np.float64),
        **flags,
        "status": whole // 2 ** len(FLAGS) % _STATUSES,
        "periods": whole // _PERIODS,
        "intervention": floats[1],
        "proposed": np.moveaxis(floats[2:4], 0, -1),
        "executed": np.moveaxis(floats[4:6], 0, -1),
        "pursuer_clearance": floats[6],
        "obstacle_clearance": floats[7],
        "pursuer_invalid": floats[8].astype(int),
    }


def unpacked_one(floats: Any, whole: Any) -> tuple[float, bool, bool, dict[str, Any]]:
    """Reward, terminated, truncated and `info` of one episode. `info` holds Python numbers, as in Gymnasium's
    environments, and copies of arrays."""
    reward, info = unpacked(floats, whole)
    info = {name: value.item() if value.ndim == 0 else value.copy() for name, value in info.items()}
    truncated = info["timed_out"]
    terminated = any(info[name] for name in FLAGS) and not truncated
    return float(reward), terminated, truncated, info


def seed_words(seeds: Any) -> np.ndarray:
    """The words (2, n) of the random keys of these seeds: those of `jax.random.key(seed)` below 2^32. Larger
    seeds are drawn by Gymnasium where none was given."""
    seeds = [int(seed) % 2**64 for seed in seeds]
    return np.array([[seed >> 32 for seed in seeds], [seed % 2**32 for seed in seeds]], np.uint32)
