"""Array types shared by every room."""

import functools
from collections.abc import Callable
from typing import Any, TypeAlias

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jax.core import Tracer
from jax.experimental.xla_metadata import set_xla_metadata
from jaxtyping import Bool, Float, Int

from sidestep._bounds import SEED, Bound, bounded, taken

_FEW = 8

AnyArray: TypeAlias = Array | np.ndarray
"""The arrays that public functions accept: JAX or NumPy, traced or concrete."""

Scalar: TypeAlias = Float[Array, ""]
Lanes: TypeAlias = Float[Array, "*lanes"]
"""One number, or one for each of many worlds in lanes.

Functions annotated with `*lanes` have components first and batch axes last, as in `(2, *lanes)`. Under
`jax.vmap` they see no batch axes. With them they compute in loops over long contiguous arrays, which is
faster on a CPU than the leading batch axis of `vmap`. They compute with components and stack the result last:
XLA cancels the stacking against the caller's indexing and vectorises the rest.
"""
Vector: TypeAlias = Float[AnyArray, "2"]
Pose: TypeAlias = Float[AnyArray, "3"]
Flag: TypeAlias = Bool[Array, ""]
Count: TypeAlias = Int[Array, ""]


def stack(*components: object) -> Float[Array, "..."]:
    """Stack components, each a number or one per lane, along a first axis."""
    return jnp.stack(jnp.broadcast_arrays(*map(jnp.asarray, components)))


def lane_by_lane(function: Callable[..., Any], lanes: int, *arguments: Any) -> Any:
    """Apply a function for single worlds to arguments (pytrees) with `lanes` last axes of lanes."""
    for _ in range(lanes):
        function = jax.vmap(function, in_axes=-1, out_axes=-1)
    return function(*arguments)


def in_lanes(tree: Any, *lanes: int) -> Any:
    """A pytree of arrays with these axes of lanes behind their own, the same in every lane."""
    new = (...,) + (None,) * len(lanes)
    return jax.tree.map(lambda leaf: jnp.broadcast_to(leaf[new], (*leaf.shape, *lanes)), tree)


def select(flags: Bool[Array, "..."], if_true: Any, if_false: Any) -> Any:
    """`if_true` where `flags`, else `if_false`, for pytrees whose leaves may have further leading axes."""
    return jax.tree.map(lambda a, b: jnp.where(flags, a, b), if_true, if_false)


def fold(operation: Callable[[Any, Any], Any], parts: Array, initial: float | bool) -> Array:
    """Reduce the first axis with a ufunc such as `jnp.minimum`; `initial`, its neutral element, if it is
    empty.

    Few parts are combined one by one: unlike a reduction, XLA fuses that with the surrounding code.
    """
    if parts.shape[0] > _FEW:
        ufunc: Any = operation
        return ufunc.reduce(parts, axis=0)
    if parts.shape[0] == 0:
        return jnp.full(parts.shape[1:], initial, parts.dtype)
    return functools.reduce(operation, parts)


def no_fuse(function: Callable[..., Any], *arguments: Any) -> Any:
    """`function(*arguments)`, without fusion with the surrounding code by XLA.

    Fused, it would be recomputed for each use of its results, and on a CPU the loops become too long to be
    vectorised.
    """

    with set_xla_metadata(inlineable="false"):
        return _inside(function, *arguments)


@eqx.filter_jit
def _inside(function: Callable[..., Any], *arguments: Any) -> Any:
    # Inside, XLA may inline.
    with set_xla_metadata(inlineable=None):
        return function(*arguments)


def traced(tree: Any) -> bool:
    """Whether any leaf of the tree is a tracer."""
    return any(isinstance(leaf, Tracer) for leaf in jax.tree.leaves(tree))


def whole_number(name: str, value: Any, *, least: int = 1, most: int | None = None) -> int:
    """`value` as an int. **Raises** `ValueError`, with `name`, if it is not a whole number from `least` to
    `most` (default 2^31 - 1)."""
    return taken(name, value, Bound(least=least, most=most, whole=True))


def seed_number(value: Any, name: str = "seed") -> int:
    """`value` as a seed. **Raises** `ValueError`, with `name`, unless it is a whole number from 0 to 2^32 -
    1: JAX drops the upper bits of a larger one, so that different seeds would be equal."""
    return taken(name, value, SEED)


def real(value: object) -> Float[Array, "..."]:
    """`value` as a JAX array of the default float type (float32, or float64 under `jax_enable_x64`).

    Constants become arrays rather than Python floats, so that `jit` traces them and another value never
    recompiles.
    """
    if isinstance(value, (int, float, np.ndarray, np.generic)):
        # NumPy converts it at once; JAX would compile a program for that.
        with np.errstate(over="ignore"):
            value = np.asarray(value, jax.dtypes.canonicalize_dtype(float))
    return jnp.asarray(value, dtype=float)


def static_field(default: Any, rule: Any = None, **limits: Any) -> Any:
    """A static field of a module; `rule` and `limits` as for `bounded`."""
    metadata = bounded(default, rule, **limits).metadata
    return eqx.field(static=True, default=default, metadata=metadata)


def length(x: Float[AnyArray, "*lanes"], y: Float[AnyArray, "*lanes"]) -> Lanes:
    """Length of the vector (x, y), with gradient 0 (not NaN) where it is 0."""
    squared = x * x + y * y
    long = squared > 0.0
    return jnp.where(long, jnp.sqrt(jnp.where(long, squared, 1.0)), 0.0)


def norm(vectors: Float[AnyArray, "... d"]) -> Float[Array, "..."]:
    """Euclidean length along the last axis, with gradient 0 (not NaN) where the length is 0."""
    squared = jnp.sum(vectors**2, axis=-1)
    long = squared > 0.0
    return jnp.where(long, jnp.sqrt(jnp.where(long, squared, 1.0)), 0.0)
