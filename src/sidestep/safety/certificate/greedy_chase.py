"""The certified law put to the test: games at the boundary against pursuers that react within every period.

Each pursuer sees the velocity that the evader has committed to and takes, of many random bang-bang motions
of several segments, the one that brings the evader's value lowest. Measurements err as badly as they may,
half of them toward the wrong side of the pursuer's axis. Nothing here is a proof; it must never contradict
one.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from sidestep.safety.sampled.flow_map import seen_from, side_value, wheel_motions
from sidestep.safety.sampled.sampled_game import Design, SampledGame, overlap

Points = Float[np.ndarray, "n 2"]
Numbers = Float[np.ndarray, "n"]


@dataclass(frozen=True)
class ChaseResult:
    """`least_value`: the least g_s at the end of a period; `least_distance`: the least within one (m)."""

    decisions: int
    least_value: float
    least_distance: float


def flee(game: SampledGame, design: Design, measured: Points, side: Numbers) -> tuple[Points, Numbers]:
    """The certified law: velocities (m/s, measured pursuer frame), and the sides to remember (+1 left).

    Flees along the normal of the remembered side; changes sides where the measurement leaves no doubt.
    """
    constant, growth = overlap(game, design.angle)
    doubt = (constant + growth * design.level) / 2.0
    side = np.where(side * measured[:, 1] < -doubt, -side, side)
    bearing = np.arctan2(side * measured[:, 1], np.abs(measured[:, 0]))
    bearing = np.clip(bearing, design.angle, np.pi / 2.0)
    ahead = np.where(measured[:, 0] < 0.0, -1.0, 1.0) * np.cos(bearing)
    return game.evader_speed * np.stack([ahead, side * np.sin(bearing)], -1), side


def random_wheels(
    rng: np.random.Generator, count: int, segments: int, rim_speed: float, *, extreme: bool = True
) -> tuple[Float[np.ndarray, "n k 2"], Float[np.ndarray, "n k"]]:
    """Wheel speeds held in `segments` (at their limits if `extreme`), and each one's share of the period.

    A third of the sequences begin with very short segments: the first turn decides near the axis.
    """
    shape = (count, segments, 2)
    speeds = rng.choice([-1.0, 1.0], shape) if extreme else rng.uniform(-1.0, 1.0, shape)
    cuts = np.sort(rng.random((count, segments - 1)), axis=1)
    cuts[::3] = cuts[::3] ** 4
    edges = np.concatenate([np.zeros((count, 1)), cuts, np.ones((count, 1))], axis=1)
    return rim_speed * speeds, np.diff(edges, axis=1)


def _starts(rng: np.random.Generator, design: Design, count: int, past: float) -> Points:
    """On the left boundary or just outside; most near the tip and past the axis, where the pursuer gains."""
    sine, cosine = math.sin(design.angle), math.cos(design.angle)
    share = np.where(rng.random(count) < 0.7, 1.0 - 0.05 * rng.random(count), rng.random(count))
    along = design.level * math.tan(design.angle) * share
    beyond = (rng.random(count) < 0.3) & (share > 0.95)
    along += np.where(beyond, past / cosine * rng.random(count), 0.0)
    point = design.level * np.array([cosine, sine]) + along[:, None] * np.array([sine, -cosine])
    outside = rng.random((count, 1)) < 0.3
    return point * (1.0 + 0.01 * rng.random((count, 1)) * outside)


def chase(
    game: SampledGame,
    design: Design,
    *,
    seed: int,
    periods: int,
    segments: int,
    games: int = 60,
    motions: int = 80,
) -> ChaseResult:
    """Play `games` side by side for `periods`; one that has got away starts anew at the boundary.

    The pursuers pick among `motions` of `segments` each. Distances are looked at four times a period.
    """
    rng = np.random.default_rng(seed)
    constant, growth = overlap(game, design.angle)
    past = constant + growth * design.level
    z, side = _starts(rng, design, games, past), np.ones(games)
    rows, zeros = np.arange(games), np.zeros(games)
    least, nearest = math.inf, math.inf
    for _ in range(periods):
        turn = game.heading_error * rng.choice([-1.0, 0.0, 1.0], games)
        error = rng.normal(size=(games, 2))
        error *= game.offset_error / np.linalg.norm(error, axis=1, keepdims=True)
        error[::2] = np.stack([zeros, -side * game.offset_error], -1)[::2]
        measured = seen_from(z, np.stack([zeros, zeros, turn], -1)) + error
        velocity, side = flee(game, design, measured, side)
        velocity = seen_from(velocity, np.stack([zeros, zeros, -turn], -1))
        velocity = velocity - game.tracking_error * velocity / np.linalg.norm(velocity, axis=1, keepdims=True)
        wheels, share = random_wheels(rng, motions, segments, game.pursuer_speed)
        poses = wheel_motions(wheels, game.period * share, game.half_axle)
        after = seen_from((z + velocity * game.period)[:, None], poses[None])
        here = side_value(after, design.angle, side[:, None])
        there = side_value(after, design.angle, -side[:, None])
        value = np.where(side[:, None] * after[..., 1] >= -past, here, there)
        worst = np.argmin(value, axis=1)
        for part in (0.25, 0.5, 0.75, 1.0):
            begun = np.cumsum(share, axis=1) - share
            times = game.period * np.clip(part - begun, 0.0, share)
            where = wheel_motions(wheels, times, game.half_axle)[worst]
            apart = z + velocity * game.period * part - where[:, :2]
            nearest = min(nearest, float(np.min(np.hypot(apart[:, 0], apart[:, 1]))))
        z, kept = after[rows, worst], value[rows, worst]
        least = min(least, float(np.min(kept)))
        away = kept > design.level + 0.5 * game.pursuer_speed * game.period
        z[away], side[away] = _starts(rng, design, int(np.sum(away)), past), 1.0
    return ChaseResult(games * periods, least, nearest)
