"""Pack many named arrays into one vector."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any, final

import jax.numpy as jnp
import numpy as np


@final
class Layout:
    """The positions of several named arrays in one vector.

    Passing one array to a compiled program, and getting one back, is much faster than many small ones.

    **Arguments:** `shapes` by name, in order.
    """

    def __init__(self, shapes: Mapping[str, tuple[int, ...]]):
        self.shapes = dict(shapes)
        self._places: dict[str, slice] = {}
        end = 0
        for name, shape in self.shapes.items():
            self._places[name] = slice(end, end + math.prod(shape))
            end += math.prod(shape)
        self.size = end

    def split(self, vector: Any) -> dict[str, Any]:
        """The arrays of a vector `(size,)`, or of many vectors `(..., size)`, with their axes first."""
        return {
            name: vector[..., place].reshape((*vector.shape[:-1], *self.shapes[name]))
            for name, place in self._places.items()
        }

    def joined(self, parts: Mapping[str, Any]) -> Any:
        """The vector of traced arrays."""
        dtype = jnp.result_type(float)
        return jnp.concatenate([jnp.ravel(jnp.asarray(parts[name])).astype(dtype) for name in self.shapes])

    def filled(self, parts: Mapping[str, Any], dtype: Any) -> np.ndarray:
        """The vector of concrete numbers; missing arrays are 0."""
        vector = np.zeros(self.size, dtype)
        for name, values in parts.items():
            vector[self._places[name]] = np.ravel(np.asarray(values))
        return vector
