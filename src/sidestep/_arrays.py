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
"""What a public function accepts as an array: JAX or NumPy, traced or concrete."""

Scalar: TypeAlias = Float[Array, ""]
Lanes: TypeAlias = Float[Array, "*lanes"]
"""One number, or one for each of many worlds side by side.

Functions annotated with `*lanes` take components first and any batch axes behind them, as in `(2, *lanes)`.
Under `jax.vmap` they see none. Called with such axes they compute the same in loops over long contiguous
arrays, which is faster on a CPU than the batch in front that `vmap` makes. They compute with components and
stack them last: XLA then cancels the stacking against the caller's indexing, and what is left is vectorised.
"""
Vector: TypeAlias = Float[AnyArray, "2"]
Pose: TypeAlias = Float[AnyArray, "3"]
Flag: TypeAlias = Bool[Array, ""]
Count: TypeAlias = Int[Array, ""]


def stack(*components: object) -> Float[Array, "..."]:
    """Components, each a number or one per lane, as an array with the components first."""
    return jnp.stack(jnp.broadcast_arrays(*map(jnp.asarray, components)))


def lane_by_lane(function: Callable[..., Any], lanes: int, *arguments: Any) -> Any:
    """A function of what has no lanes, for arguments (pytrees) that have `lanes` axes of them behind."""
    for _ in range(lanes):
        function = jax.vmap(function, in_axes=-1, out_axes=-1)
    return function(*arguments)


def select(flags: Bool[Array, "..."], if_true: Any, if_false: Any) -> Any:
    """The one pytree where `flags`, which its leaves may have more axes in front of, else the other."""
    return jax.tree.map(lambda a, b: jnp.where(flags, a, b), if_true, if_false)


def fold(operation: Callable[[Any, Any], Any], parts: Array, initial: float | bool) -> Array:
    """A ufunc such as `jnp.minimum` over the first axis; `initial`, its neutral element, if that is empty.

    Few parts are taken one by one: unlike a reduction, XLA fuses that with what is around it.
    """
    if parts.shape[0] > _FEW:
        ufunc: Any = operation
        return ufunc.reduce(parts, axis=0)
    if parts.shape[0] == 0:
        return jnp.full(parts.shape[1:], initial, parts.dtype)
    return functools.reduce(operation, parts)


def no_fuse(function: Callable[..., Any], *arguments: Any) -> Any:
    """`function(*arguments)`, which XLA does not fuse with the code around it.

    Fused, it would be computed once more for each use of its results. On a CPU the loops also get so long
    that they are no longer vectorised.
    """

    with set_xla_metadata(inlineable="false"):
        return _inside(function, *arguments)


@eqx.filter_jit
def _inside(function: Callable[..., Any], *arguments: Any) -> Any:
    # What is inside may be inlined there.
    with set_xla_metadata(inlineable=None):
        return function(*arguments)


def traced(tree: Any) -> bool:
    """Whether anything in it is known only when the program that is being compiled runs."""
    return any(isinstance(leaf, Tracer) for leaf in jax.tree.leaves(tree))


def whole_number(name: str, value: Any, *, least: int = 1, most: int | None = None) -> int:
    """`value` as an int. **Raises** `ValueError` that calls it `name` if it is not a whole number from
    `least` to `most` (2^31 - 1 if not given)."""
    return taken(name, value, Bound(least=least, most=most, whole=True))


def seed_number(value: Any, name: str = "seed") -> int:
    """`value` as a seed. **Raises** `ValueError` that calls it `name` unless it is a whole number from 0 to
    2^32 - 1: of a larger one JAX would drop the upper bits, and two seeds would silently be one."""
    return taken(name, value, SEED)


def real(value: object) -> Float[Array, "..."]:
    """`value` as a JAX array of the default float type (float32, or float64 under `jax_enable_x64`).

    Constants become arrays rather than Python floats so that `jit` traces them: another speed or
    gain then never recompiles.
    """
    return jnp.asarray(value, dtype=float)


def static_field(default: Any, rule: Any = None, **limits: Any) -> Any:
    """A field of a module that is no array; `rule` and `limits` as for `bounded`."""
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
