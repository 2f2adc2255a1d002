"""The largest distance that an evader deciding once per period can hold, and the set that holds it."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np

from sidestep.safety.sampled.flow_map import advance
from sidestep.safety.sampled.sampled_game import (
    Cells,
    Design,
    SampledGame,
    bearing_error,
    found_slack,
    slack,
)

_GOLDEN = (math.sqrt(5.0) - 1.0) / 2.0
_ROUNDING = 1e-12
_LEAST_SHIFT = 1e-7
"""Smallest share of the possible shift S' - S that is tried."""

COARSE = Cells(16, 16, 8)
"""For searches."""
FINE = Cells(32, 48, 24)
"""For the figures that are reported."""


def _unseen(game: SampledGame) -> float:
    """How far the pursuer can drive between a measurement and the end of the period decided on it, m."""
    return game.pursuer_speed * (game.period + game.delay)


def delay_cost(game: SampledGame) -> float:
    """How much nearer the pursuer can be by now than when measured, m: v_e tau, if T and tau are short.

    The evader flees along n at v_e cos(error) >= V cos S', and by t the pursuer has come `advance` of
    V (t + tau) along n. As long as no detour pays, that is linear and leaves V cos S' tau <= v_e tau.
    Otherwise nothing that the evader gains is counted.
    """
    if game.delay == 0.0:
        return 0.0
    alignment = math.cos(game.usable_angle)
    if _unseen(game) <= 2.0 * game.half_axle * alignment:
        return game.pursuer_speed * game.delay * alignment
    return float(advance(np.asarray(_unseen(game)), np.asarray(alignment), game.half_axle))


def outruns(game: SampledGame, level: float) -> bool:
    """Whether the evader, fleeing straight away as well as it measures, is at least as fast from `level` on.

    Then no distance beyond it ever falls, whatever the period: |z + u t| grows by v_e t cos(error) at least.
    """
    error = game.heading_error + bearing_error(game, level)
    return error < math.pi / 2.0 and (
        game.evader_speed * math.cos(error) - game.tracking_error >= game.pursuer_speed
    )


def best_angle(game: SampledGame, level: float, cells: Cells, sections: int = 9) -> tuple[float, float]:
    """The design angle S' with the most slack at `level`, and that slack (m)."""
    low = game.usable_angle
    # Beyond this angle turning alone takes the tip, even from an evader without errors.
    high = math.atan2(game.half_axle * game.evader_speed, game.pursuer_speed * level)
    # And up to here no detour pays beside the law's normal, see `delay_cost`.
    if _unseen(game) <= 2.0 * game.half_axle * math.cos(low):
        high = min(high, math.acos(_unseen(game) / (2.0 * game.half_axle)))
    if not 0.0 < level <= game.largest_capture_distance or high <= low:
        return low, -math.inf

    def at(share: float) -> float:
        return slack(game, Design(low + (high - low) * math.exp(share), level), cells)

    # The shift that pays may be a millionth of the largest one or all of it.
    share, most = _golden(at, math.log(_LEAST_SHIFT), 0.0, sections)
    return low + (high - low) * math.exp(share), most


def spare(game: SampledGame, level: float, cells: Cells = COARSE) -> float:
    """By how much (m per period) `level` can be held; negative where it cannot be shown to be."""
    return math.inf if outruns(game, level) else best_angle(game, level, cells)[1]


def holds(game: SampledGame, level: float, cells: Cells = COARSE) -> bool:
    """Whether the evader can be shown to keep at least `level` for ever."""
    return spare(game, level, cells) >= 0.0


def best_design(game: SampledGame, cells: Cells = FINE) -> Design | None:
    """The largest level that can be held, and its angle; None if none can be shown to be.

    The level is infinite for an evader that outruns the pursuer: then any distance is kept.
    """
    scale = min(game.largest_capture_distance, 100.0 * game.half_axle)
    if outruns(game, max(scale, 1.0)):
        return Design(0.0, math.inf)
    coarse = largest_true(lambda level: best_angle(game, level, COARSE)[1], 0.0, scale, 1e-4 * scale)
    if coarse <= 0.0:
        return None
    angle, _ = best_angle(game, coarse, COARSE)
    shift = angle - game.usable_angle
    designs = [Design(angle, coarse)]
    # A finer cover needs less spare speed, so the best angle only moves toward S.
    for share in (1.0, 0.5, 0.25, 0.12):
        nearer = game.usable_angle + share * shift
        level = largest_true(
            lambda level, nearer=nearer: slack(game, Design(nearer, level), cells),
            coarse,
            scale,
            1e-5 * (scale - coarse) + 1e-9 * scale,
        )
        designs.append(Design(nearer, level))
    held = [design for design in designs if slack(game, design, cells) >= 0.0]
    return max(held, key=lambda design: design.level) if held else designs[0]


def broken_level(game: SampledGame, design: Design) -> float:
    """The lowest level found that a real motion takes from the law within one period, m.

    The level that the law truly holds lies between `design.level` and this one.
    """
    limit = game.largest_capture_distance
    top = limit if math.isfinite(limit) else 2.0 * design.level
    angles = (game.usable_angle, design.angle)

    def found(level: float) -> float:
        return max(found_slack(game, Design(angle, level)) for angle in angles) + _ROUNDING

    return largest_true(found, design.level, top, 1e-4 * (top - design.level))


def tightest_angle(game: SampledGame, level: float, cells: Cells = FINE) -> float | None:
    """The smallest design angle that holds `level`, so the smallest set to stay out of; None if none does."""
    angle, most = best_angle(game, level, cells)
    if most < 0.0:
        return None
    low = game.usable_angle
    if slack(game, Design(low, level), cells) >= 0.0:
        return low
    back = largest_true(
        lambda back: slack(game, Design(angle - back, level), cells), 0.0, angle - low, 1e-3 * (angle - low)
    )
    return angle - back


def largest_true(value: Callable[[float], float], low: float, high: float, tolerance: float) -> float:
    """The largest point up to `high` where a falling function is 0 or more, to `tolerance` from below.

    `low` where it is negative everywhere above; `value(low)` itself is taken for granted. By false position
    (Illinois), bisecting where the function is not finite; the answer is always a point that was tried.
    """
    at_high = value(high)
    if at_high >= 0.0:
        return high
    at_low, last = math.inf, 0
    for _ in range(60):
        if high - low <= tolerance:
            break
        middle = 0.5 * (low + high)
        if math.isfinite(at_low) and math.isfinite(at_high):
            middle = low + at_low / (at_low - at_high) * (high - low) - 0.3 * tolerance
            middle = min(max(middle, low + 0.3 * tolerance), high - 0.3 * tolerance)
        at = value(middle)
        if at >= 0.0:
            low, at_low = middle, at
            at_high, last = (0.5 * at_high, 1) if last == 1 else (at_high, 1)
        else:
            high, at_high = middle, at
            at_low, last = (0.5 * at_low, -1) if last == -1 else (at_low, -1)
    return low


def _golden(value: Callable[[float], float], low: float, high: float, sections: int) -> tuple[float, float]:
    """The point of the largest value found of a unimodal function, by golden sections, and that value."""
    left, right = high - _GOLDEN * (high - low), low + _GOLDEN * (high - low)
    at_left, at_right = value(left), value(right)
    for _ in range(sections):
        if at_left >= at_right:
            high, right, at_right = right, left, at_left
            left = high - _GOLDEN * (high - low)
            at_left = value(left)
        else:
            low, left, at_left = left, right, at_right
            right = low + _GOLDEN * (high - low)
            at_right = value(right)
    return (left, at_left) if at_left >= at_right else (right, at_right)
