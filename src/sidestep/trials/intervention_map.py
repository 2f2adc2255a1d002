"""Maps of interventions: sums over control periods, by the evader's position in the pursuer's frame."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from sidestep.loop.episode import Period
from sidestep.safety import Status
from sidestep.world import Scenario
from sidestep.world.capture_geometry import to_pursuer_frame

CELLS = 75
"""Cells along each axis; odd, so that the pursuer's axis, where most interventions are, is inside cells."""
_REACH = 2.5
_NAMES = ("periods", "corrected", "infeasible", "correction", "ahead", "left")


def map_reach(scenario: Scenario) -> Float[Array, ""]:
    """Half the side length (m) of the map around the pursuer: 2.5 capture distances."""
    return jnp.asarray(_REACH * scenario.capture_distance)


@dataclass(frozen=True)
class InterventionMap:
    """Sums over control periods in square cells of the pursuer's frame (x ahead, y left).

    Row i, column j is the cell of width w = 2 reach / cells whose least y is -reach + i w and least x is
    -reach + j w.

    **Attributes:** `reach` m; `periods` that began with the evader in the cell; `corrected` and `infeasible`,
    those in which the shield did not answer with the nominal action, could not satisfy its rows; sums of
    |action - nominal| (`correction`) and of its components in the pursuer's frame (`ahead`, `left`), m/s;
    `outside`, periods that began outside the map.
    """

    reach: float
    periods: Int[np.ndarray, "cells cells"]
    corrected: Int[np.ndarray, "cells cells"]
    infeasible: Int[np.ndarray, "cells cells"]
    correction: Float[np.ndarray, "cells cells"]
    ahead: Float[np.ndarray, "cells cells"]
    left: Float[np.ndarray, "cells cells"]
    outside: int = 0

    @classmethod
    def of_sums(cls, reach: float, sums: Float[np.ndarray, "cells_and_one 6"]) -> InterventionMap:
        """The map of the sums of `add_periods`."""
        inside = sums[:-1].reshape(CELLS, CELLS, len(_NAMES))
        parts: dict[str, Any] = {name: inside[..., index] for index, name in enumerate(_NAMES)}
        for name in ("periods", "corrected", "infeasible"):
            parts[name] = np.rint(parts[name]).astype(np.int64)
        return cls(reach, **parts, outside=round(float(sums[-1, 0])))

    def to_arrays(self) -> dict[str, np.ndarray]:
        """Arrays by name, in the smallest dtypes, for `from_arrays`."""
        arrays: dict[str, np.ndarray] = {"reach": np.asarray(self.reach), "outside": np.asarray(self.outside)}
        for name in _NAMES:
            values = getattr(self, name)
            arrays[name] = values.astype(np.int32 if values.dtype.kind == "i" else np.float32)
        return arrays

    @classmethod
    def from_arrays(cls, arrays: Mapping[str, np.ndarray]) -> InterventionMap:
        """The inverse of `to_arrays`. **Raises** `KeyError` for a missing part."""
        parts: dict[str, Any] = {name: np.asarray(arrays[name]) for name in _NAMES}
        return cls(float(arrays["reach"]), **parts, outside=int(arrays["outside"]))

    def __add__(self, other: InterventionMap) -> InterventionMap:
        """The sum of two maps. **Raises** `ValueError` when they do not cover the same region."""
        if self.reach != other.reach or self.periods.shape != other.periods.shape:
            raise ValueError("these maps do not cover the same region")
        parts: dict[str, Any] = {name: getattr(self, name) + getattr(other, name) for name in _NAMES}
        return InterventionMap(self.reach, **parts, outside=self.outside + other.outside)


def no_periods() -> Float[Array, "cells_and_one 6"]:
    """Zero sums. The last row is for periods outside the map."""
    return jnp.zeros((CELLS * CELLS + 1, len(_NAMES)))


def add_periods(
    sums: Float[Array, "cells_and_one 6"], scenario: Scenario, period: Period
) -> Float[Array, "cells_and_one 6"]:
    """Add one control period of each running lane: a `Read` of `loop.batch`, to be traced.

    float32 holds counts up to 2^24, so the caller must take the sums out earlier.
    """
    world, nominal, result, running = period.world, period.nominal, period.result, period.running
    offsets = world.pursuers[:, :2] - world.evader
    nearest = jnp.argmin(jnp.sum(offsets**2, axis=1), axis=0)
    pose = jnp.take_along_axis(world.pursuers, nearest[None, None], axis=0)[0]
    z = to_pursuer_frame(world.evader, pose)
    reach = map_reach(scenario)
    place = jnp.floor((z + reach) * (CELLS / (2.0 * reach))).astype(jnp.int32)
    inside = jnp.all((place >= 0) & (place < CELLS), axis=0) & running
    cell = jnp.where(inside, place[1] * CELLS + place[0], CELLS * CELLS)
    change = jnp.where(jnp.isfinite(nominal), result.action - nominal, 0.0)
    cosine, sine = jnp.cos(pose[2]), jnp.sin(pose[2])
    ahead, left = cosine * change[0] + sine * change[1], cosine * change[1] - sine * change[0]
    entries = (
        jnp.ones_like(ahead),
        result.status != Status.OK,
        result.status == Status.INFEASIBLE,
        result.intervention,
        ahead,
        left,
    )
    rows = jnp.stack([jnp.asarray(entry, sums.dtype) for entry in entries], axis=-1)
    return sums.at[cell].add(jnp.where(running[:, None], rows, 0.0))
