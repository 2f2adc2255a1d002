"""What the shipped `game` shield keeps at its control period, whatever the policy behind it wants.

The certificate's law flees at full speed; the shield lets a policy have any velocity that keeps its row,
follows the row's own gain, and remembers a side with its own hysteresis. So it has a check of its own, with
the shield's own code: from every boundary point of {g_s >= q}, for levels q, both sides that the memory may
hold, every velocity that the row allows and turn-drive-turn motions of the pursuer, the value after one
period. The level kept is the largest c such that no level q >= c leads below c.

Sampled, not covered: velocities, motions and points between the grid's are not bounded. The figure is
computed on a grid, and `error` is its spacing.
"""

from __future__ import annotations

from dataclasses import dataclass

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from sidestep._arrays import Scalar
from sidestep.safety.barriers.pursuit_barrier import PursuitBarrier
from sidestep.safety.barriers.sampling_margin import sampling_margin, with_margins
from sidestep.safety.sampled.flow_map import seen_from, side_value, turn_drive_turn
from sidestep.world.scenario import Scenario

_LEVELS = 80
_POINTS = 33
_BEYOND = 16
_VELOCITIES = 9
_ROUNDING = 1e-6
"""How much a level may seem to fall in one period by rounding in single precision, m."""


@dataclass(frozen=True)
class ShieldLevel:
    """`level`: the least distance (m) the shield keeps, or 0; `error`: the grid's spacing there (m)."""

    level: float
    error: float


@eqx.filter_jit
def _rows(
    scenario: Scenario, eased: Scalar, points: Float[Array, "n 2"]
) -> tuple[Bool[Array, "n"], Float[Array, "n 2"], Float[Array, "n"]]:
    """Per point of the pursuer's frame: whether the left side is kept there, and the left side's row."""
    barrier = PursuitBarrier(eased=eased)
    origin, left = jnp.zeros(3, points.dtype), jnp.ones((), points.dtype)

    def at(z: Float[Array, "2"]) -> tuple[Array, Array, Array]:
        _, normal, offset = barrier.row(scenario, z, origin, left)
        return barrier.update_memory(scenario, z, origin, left) > 0.0, normal, offset

    return jax.vmap(at)(points)


@eqx.filter_jit
def _keeps_left(scenario: Scenario, eased: Scalar, points: Float[Array, "n 2"]) -> Bool[Array, "n"]:
    barrier = PursuitBarrier(eased=eased)
    origin, left = jnp.zeros(3, points.dtype), jnp.ones((), points.dtype)
    return jax.vmap(lambda z: barrier.update_memory(scenario, z, origin, left) > 0.0)(points)


def _boundary(level: float, angle: float, beyond: float) -> Float[np.ndarray, "n 2"]:
    """Points with g of the left side equal to `level`: the arc, the tangent, and on past the axis (y < 0)."""
    tip = level * np.tan(angle)
    bearing = np.linspace(np.pi / 2.0, angle, _POINTS)
    arc = level * np.stack([np.cos(bearing), np.sin(bearing)], -1)
    # Finer toward the tip, where the pursuer may turn past the evader within a period.
    share = 1.0 - np.linspace(1.0, 0.0, _POINTS)[1:] ** 2
    along = np.concatenate([tip * share, tip + np.linspace(0.0, beyond / np.cos(angle), _BEYOND + 1)[1:]])
    line = level * np.array([np.cos(angle), np.sin(angle)])
    return np.concatenate([arc, line + along[:, None] * np.array([np.sin(angle), -np.cos(angle)])])


def _allowed(
    normals: Float[np.ndarray, "n 2"], offsets: Float[np.ndarray, "n"], speed: float, *, circle: bool
) -> Float[np.ndarray, "n u 2"]:
    """The worst velocities a row lets through: its chord of the speed disc, or its ends where |u| = v_e.

    A row that asks for more than v_e gets v_e n, the least violation.
    """
    along = np.clip(offsets, -speed, speed)
    half = np.sqrt(np.maximum(speed**2 - along**2, 0.0))
    share = np.array([-1.0, 1.0]) if circle else np.linspace(-1.0, 1.0, _VELOCITIES)
    across = np.stack([-normals[:, 1], normals[:, 0]], -1)
    return (along[:, None] * normals)[:, None] + (half[:, None] * share)[..., None] * across[:, None]


def shield_level(scenario: Scenario) -> ShieldLevel:
    """The level that the `game` shield keeps against every pursuer, for exact measurements, on the grid."""
    eased, scenario = sampling_margin(scenario), with_margins(scenario)
    speed, period = float(scenario.evader_speed), float(scenario.control_period)
    rim, axle = float(scenario.pursuer_speed), float(scenario.pursuer_half_axle)
    wanted, angle = float(scenario.capture_distance), float(scenario.usable_angle)
    # From farther out no single period reaches the capture distance.
    top = wanted + 2.0 * (speed + rim + rim * wanted / max(axle, 1e-9)) * period
    levels = np.union1d(
        wanted + (top - wanted) * np.linspace(0.0, 1.0, _LEVELS // 4) ** 2,
        np.linspace(0.4 * wanted, wanted, _LEVELS),
    )
    poses = turn_drive_turn(period, rim, axle)
    found = ShieldLevel(0.0, float(levels[0]))
    # Twice: over all levels, then more finely above the best of them.
    for _ in range(2):
        least = np.array(
            [_next_level(scenario, eased, q, angle, 0.15 * wanted, poses, speed, period) for q in levels]
        )
        reached = np.minimum.accumulate(least[::-1])[::-1]
        kept = np.flatnonzero((reached >= levels - _ROUNDING) & (levels <= wanted))
        if len(kept) == 0:
            break
        best = int(kept[-1])
        found = ShieldLevel(float(levels[best]), float(levels[best + 1] - levels[best]))
        above = np.concatenate([[levels[best + 1]], levels[best + 2 :: 4]])
        levels = np.concatenate([np.linspace(levels[best], levels[best + 1], 13)[:-1], above])
    return found


def _next_level(
    scenario: Scenario,
    eased: Scalar,
    level: float,
    angle: float,
    beyond: float,
    poses: Float[np.ndarray, "n 3"],
    speed: float,
    period: float,
) -> float:
    """The least value after one period from any point of the level at which the left side is followed."""
    points = _boundary(level, angle, beyond)
    kept, normals, offsets = (
        np.asarray(part, float) for part in _rows(scenario, eased, jnp.asarray(points, dtype=float))
    )
    here = (kept > 0.0) & (np.abs(side_value(points, angle, 1.0) - level) < 1e-9)
    allowed = _allowed(normals, offsets, speed, circle=scenario.action == "heading")
    moved = points[:, None] + period * allowed
    after = seen_from(moved[:, :, None], poses[None, None])
    value = side_value(after, angle, 1.0)
    other = side_value(after, angle, -1.0)
    # The memory that will be used next: the left side as long as the shield keeps it, else the evader's own.
    # Where the value of the left side is not below `level` anyway, it does not matter.
    lost = (value < level) & (other > value)
    if lost.any():
        flat = after[lost]
        padded = np.zeros((-(-len(flat) // 4096) * 4096, 2))
        padded[: len(flat)] = flat
        stays = np.asarray(_keeps_left(scenario, eased, jnp.asarray(padded, dtype=float)))[: len(flat)]
        value[lost] = np.where(stays, value[lost], other[lost])
    return float(np.min(value[here]))
