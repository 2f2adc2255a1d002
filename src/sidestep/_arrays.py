"""Array types shared by every room."""

from typing import TypeAlias

import jax.numpy as jnp
import numpy as np
from jax import Array
from jaxtyping import Bool, Float, Int

AnyArray: TypeAlias = Array | np.ndarray
"""What a public function accepts as an array: JAX or NumPy, traced or concrete."""

Scalar: TypeAlias = Float[Array, ""]
Vector: TypeAlias = Float[AnyArray, "2"]
Pose: TypeAlias = Float[AnyArray, "3"]
Flag: TypeAlias = Bool[Array, ""]
Count: TypeAlias = Int[Array, ""]


def real(value: object) -> Float[Array, "..."]:
    """`value` as a JAX array of the default float type (float32, or float64 under `jax_enable_x64`).

    Constants become arrays rather than Python floats so that `jit` traces them: another speed or
    gain then never recompiles.
    """
    return jnp.asarray(value, dtype=float)


def norm(vectors: Float[AnyArray, "*batch n"]) -> Float[Array, "*batch"]:
    """Euclidean length along the last axis, with gradient 0 (not NaN) where the length is 0."""
    squared = jnp.sum(vectors**2, axis=-1)
    long = squared > 0.0
    return jnp.where(long, jnp.sqrt(jnp.where(long, squared, 1.0)), 0.0)
