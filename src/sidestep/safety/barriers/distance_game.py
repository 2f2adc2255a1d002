"""How near can a pursuer come for which no formula is known? The game of the least distance, on a grid."""

from __future__ import annotations

import math
from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from sidestep._arrays import Scalar, real
from sidestep.safety.barriers.frame_barrier import FrameBarrier, pursuer_corners
from sidestep.world.capture_geometry import to_pursuer_frame
from sidestep.world.robots import drive, wheels_from_body
from sidestep.world.scenario import Scenario

_HEADINGS = 24
"""Headings among which the evader chooses, with a parabola through the best three."""
_ALONG_EDGE = 6
"""Pursuer motions tried on every edge of the hull of what it can do."""
_CELLS_PER_STEP = 2.0
"""How far the pursuer drives in one time step, in cells."""
_SWEEPS = 20
_SETTLED = 2e-4
"""The values have settled when none sinks faster than this share of the pursuer's speed."""
_LONGEST = 40.0
"""Game time after which the solver gives up, in times that the pursuer needs to cross the grid."""


class DistanceValue(eqx.Module):
    """The least distance W (m) that the pursuer can ever force, over the evader's position in its frame.

    - `values (n, n)` m, at the nodes of a square of side 2 `reach` (m) about the pursuer; first axis x, ahead
    - `error` m, their mean difference from a solution on half as many cells
    - `settled`: whether the iteration had converged
    """

    values: Float[Array, "n n"]
    reach: Scalar = eqx.field(converter=real)
    error: float = eqx.field(static=True, default=0.0)
    settled: bool = eqx.field(static=True, default=True)

    def __call__(self, z: Float[Array, "2"]) -> Scalar:
        """W at z (m); outside the square, that of its edge."""
        return _interpolate(self.values, (z / self.reach + 1.0) * (len(self.values) - 1) / 2.0)

    @property
    def largest_capture_distance(self) -> float:
        """l_max (m): what the pursuer can force of an evader that is as far away as the grid goes."""
        edge = np.asarray(self.values)
        return float(min(edge[0].min(), edge[-1].min(), edge[:, 0].min(), edge[:, -1].min()))


def _weights(u: Scalar) -> Float[Array, "4"]:
    """Weights of the nodes -1, 0, 1, 2 at u in [0, 1) (Keys, "Cubic convolution interpolation for digital
    image processing", IEEE T-ASSP 1981)."""
    return jnp.stack(
        [
            ((-0.5 * u + 1.0) * u - 0.5) * u,
            (1.5 * u - 2.5) * u * u + 1.0,
            ((-1.5 * u + 2.0) * u + 0.5) * u,
            (0.5 * u - 0.5) * u * u,
        ]
    )


def _interpolate(values: Float[Array, "n n"], place: Float[Array, "2"]) -> Scalar:
    """Cubic between the nodes, `place` counted in cells; flat beyond the edge; never out of the range of the
    four nodes around, so that kinks make no waves."""
    place = jnp.clip(place, 1.0, len(values) - 2.001)
    low = jnp.floor(jax.lax.stop_gradient(place))
    first = low.astype(jnp.int32) - 1
    patch = jax.lax.dynamic_slice(values, (first[0], first[1]), (4, 4))
    value = _weights(place[0] - low[0]) @ patch @ _weights(place[1] - low[1])
    around = patch[1:3, 1:3]
    return jnp.clip(value, jnp.min(around), jnp.max(around))


def _edges(corners: np.ndarray) -> np.ndarray:
    """Motions along every line between two corners; those inside the hull cost time and do no harm."""
    shares = np.linspace(0.0, 1.0, _ALONG_EDGE + 1)[:, None]
    pairs = [(a, b) for i, a in enumerate(corners) for b in corners[i + 1 :]]
    return np.unique(np.concatenate([a + shares * (b - a) for a, b in pairs] or [corners]), axis=0)


def _seen_after(nodes: Float[Array, "n 2"], motion: Float[Array, "2"], period: Scalar) -> Array:
    """Where `nodes` are in the frame of a pursuer that has driven an arc."""
    axle = jnp.ones_like(period)
    wheels = wheels_from_body(motion[0], motion[1], axle)
    pose = drive(jnp.zeros_like(motion, shape=3), wheels, axle, period)
    return jax.vmap(to_pursuer_frame, in_axes=(0, None))(nodes, pose)


@eqx.filter_jit
def _sweeps(
    values: Float[Array, "n n"], motions: Float[Array, "k 2"], speed: Scalar, reach: Scalar, period: Scalar
) -> Float[Array, "n n"]:
    """Twenty steps of W <- min(W, max over the evader's headings of min over the pursuer's motions).

    The pursuer answers knowing what the evader does: what one step can be wrong by is to its advantage.
    """
    count = len(values)
    spacing = 2.0 * reach / (count - 1)
    axis = jnp.linspace(-1.0, 1.0, count, dtype=float) * reach
    nodes = jnp.stack(jnp.meshgrid(axis, axis, indexing="ij"), axis=-1).reshape(-1, 2)
    angles = jnp.linspace(0.0, 2.0 * jnp.pi, _HEADINGS, endpoint=False, dtype=float)
    moves = speed * period * jnp.stack([jnp.cos(angles), jnp.sin(angles)], axis=-1)
    # A slope is at most 1, so this is the most that lies between two headings.
    between = speed * period * (1.0 - math.cos(math.pi / _HEADINGS))

    def at(values: Array, points: Array) -> Array:
        return jax.vmap(lambda point: _interpolate(values, (point + reach) / spacing))(points)

    def evader_best(values: Array) -> Array:
        after = jax.lax.map(lambda move: at(values, nodes + move), moves)
        best = jnp.argmax(after, axis=0)[None]
        left, top, right = (jnp.take_along_axis(after, (best + k) % _HEADINGS, axis=0)[0] for k in (-1, 0, 1))
        bend = 2.0 * top - left - right
        vertex = jnp.where(bend > 0.0, (left - right) ** 2 / (8.0 * jnp.where(bend > 0.0, bend, 1.0)), 0.0)
        return jnp.maximum(values.reshape(-1), top + jnp.minimum(vertex, between)).reshape(count, count)

    def pursuer_best(values: Array) -> Array:
        def least(best: Array, motion: Array) -> tuple[Array, None]:
            return jnp.minimum(best, at(values, _seen_after(nodes, motion, period))), None

        return jax.lax.scan(least, values.reshape(-1), motions)[0].reshape(count, count)

    def sweep(values: Array, _: None) -> tuple[Array, None]:
        return jnp.minimum(values, evader_best(pursuer_best(values))), None

    return jax.lax.scan(sweep, values, None, length=_SWEEPS)[0]


def _solve(
    scenario: Scenario, reach: float, cells: int, progress: Callable[[float], None] | None
) -> tuple[np.ndarray, bool]:
    corners = np.asarray(pursuer_corners(scenario), float)
    motions = jnp.asarray(_edges(corners), dtype=float)
    fastest = max(float(np.max(np.abs(corners[:, 0]))), float(scenario.evader_speed))
    spacing = 2.0 * reach / cells
    period = _CELLS_PER_STEP * spacing / fastest
    axis = np.linspace(-reach, reach, cells + 1)
    values = jnp.asarray(np.hypot(*np.meshgrid(axis, axis, indexing="ij")), dtype=float)
    elapsed, longest = 0.0, _LONGEST * 2.0 * reach / fastest
    while elapsed < longest:
        last = values
        values = _sweeps(last, motions, scenario.evader_speed, real(reach), real(period))
        elapsed += _SWEEPS * period
        change = float(jnp.max(last - values)) / (_SWEEPS * period)
        if progress is not None:
            progress(change / fastest)
        if change <= _SETTLED * fastest:
            return np.asarray(values), True
    return np.asarray(values), False


def solve_distance(
    scenario: Scenario,
    *,
    reach: float | None = None,
    cells: int = 120,
    progress: Callable[[float], None] | None = None,
) -> DistanceValue:
    """Solve the game of the least distance for whatever `scenario.pursuer_model` can do.

    Dynamic programming: W(z) = min(|z|, max over the evader's, min over the pursuer's motions of W one time
    step later), repeated until it settles, on `cells` x `cells` cells out to `reach` (m; five capture
    distances by default). A second solution on half as many cells gives the error. W does not depend on the
    capture distance: one solution serves all. `progress(share)` gets how fast W still sinks, as a share of
    the pursuer's speed.

    If W has a sharp valley, as ahead of a differential drive, the pursuer comes out too strong: l_max is
    0.167 instead of 0.201 m with 80 cells. For the differential drive use `PursuitBarrier`, which is exact.

    **Raises** `ValueError` for fewer than 40 cells or an odd number of them, and for a reach below two
    capture distances.
    """
    capture = float(scenario.capture_distance)
    reach = 5.0 * capture if reach is None else float(reach)
    if cells < 40 or cells % 2:
        raise ValueError(f"cells = {cells}: it must be an even number of at least 40")
    if not reach >= 2.0 * capture:
        raise ValueError(f"reach = {reach:g} m: two capture distances, {2.0 * capture:g} m, are the least")
    (values, settled), (coarse, _) = (
        _solve(scenario, reach, count, progress) for count in (cells, cells // 2)
    )
    error = float(np.mean(np.abs(values[::2, ::2] - coarse)))
    return DistanceValue(jnp.asarray(values), reach, error, settled)


class _Height(eqx.Module):
    """h(z) = W(z) - l - error."""

    value: DistanceValue

    def __call__(self, scenario: Scenario, z: Float[Array, "2"]) -> Scalar:
        return self.value(z) - scenario.capture_distance - self.value.error


def grid_barrier(
    scenario: Scenario, value: DistanceValue | None = None, gain: float | None = None
) -> FrameBarrier:
    """h(z) = W(z) - l - error as a barrier, for `shield_of` and `evaluate`; solves for W if it is not given.

    **Raises** `ValueError` where the pursuer wins: from everywhere it can force a distance below l + error.
    """
    value = solve_distance(scenario) if value is None else value
    kept = float(scenario.capture_distance) + value.error
    if kept >= value.largest_capture_distance:
        raise ValueError(
            f"from anywhere the pursuer can come within {value.largest_capture_distance:.4g} m, and the "
            f"capture distance and the grid's error are {kept:.4g} m together: there is nothing to keep. "
            "Give the evader more speed, or take a smaller capture distance"
        )
    return FrameBarrier(_Height(value), gain)
