"""Where the pursuer wins: how long the evader lasts, and how far it gets.

Two different statements. The *time to capture* under best play by both is what the evader can be denied
more than, so no point farther than v_e times it can be reached for certain. The *certain run* is one-sided:
an evader that simply drives straight on in one direction cannot be caught before the run ends, whatever the
pursuer does. So a target is certain within the run, out of reach beyond v_e times the time, and open between.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from sidestep.pursuit.game import CaptureGame
from sidestep.safety.sampled.flow_map import advance
from sidestep.safety.sampled.sampled_game import SampledGame

_BEARINGS = 91


@dataclass(frozen=True)
class Survival:
    """From one start, or over all bearings at one distance where `start` is None.

    `shortest`, `longest` time to capture under best play (s; infinite where capture cannot be forced), equal
    for one start; `worst_bearing`, `best_bearing` (rad) where they occur. `certain_run`: how far (m) the
    evader can drive straight on for certain in the worst direction, `longest_run` in the best one.
    """

    start: tuple[float, float] | None
    distance: float
    shortest: float
    longest: float
    worst_bearing: float
    best_bearing: float
    certain_run: float
    longest_run: float

    def target(self, distance: float, evader_speed: float) -> str:
        """`certain`, `open` or `out of reach`: whether a target at `distance` (m) is reached before capture.

        Certain: by driving straight at it, wherever it lies. Out of reach: even in the best case here it is
        farther than the evader can drive before a capture that the pursuer can force.
        """
        if distance <= self.certain_run:
            return "certain"
        return "open" if distance <= evader_speed * self.longest else "out of reach"


def certain_run(
    game: SampledGame, capture_distance: float, start: Float[np.ndarray, "2"], direction: float
) -> float:
    """How far (m) the evader can drive straight on, at `direction` (rad) in the pursuer's first frame.

    By time t the pursuer's centre is within the set with support function `advance(V t, |cos|)` along every
    direction, so the distance at t is at least the largest of m.(z + u t) - advance over unit vectors m. The
    run ends where that falls to the capture distance.
    """
    speed, rim = game.evader_speed, game.pursuer_speed
    heading = np.array([math.cos(direction), math.sin(direction)])
    if np.hypot(*start) <= capture_distance:
        return 0.0
    horizon = 4.0 * (np.hypot(*start) + rim * game.half_axle) / max(rim - speed, 1e-3 * rim)
    times = np.linspace(0.0, horizon, 240)
    angles = np.linspace(-np.pi, np.pi, 145)
    along = np.stack([np.cos(angles), np.sin(angles)])

    def gap(times: Float[np.ndarray, "n"]) -> Float[np.ndarray, "n"]:
        places = start + speed * times[:, None] * heading
        reach = advance(rim * times[:, None], np.abs(along[0])[None], game.half_axle)
        reach = np.minimum(reach, rim * times[:, None])
        return np.max(places @ along - reach, axis=1)

    # Between two times the gap changes at v_e + V at most.
    closed = np.flatnonzero(gap(times) - (speed + rim) * (times[1] - times[0]) <= capture_distance)
    if len(closed) == 0:
        return speed * horizon
    safe, lost = 0.0 if closed[0] == 0 else float(times[closed[0] - 1]), float(times[closed[0]])
    fine = np.linspace(safe, lost + (times[1] - times[0]), 240)
    closed = np.flatnonzero(gap(fine) - (speed + rim) * (fine[1] - fine[0]) <= capture_distance)
    return speed * float(fine[max(closed[0] - 1, 0)]) if len(closed) else speed * float(fine[-1])


def survival(
    game: SampledGame, capture_distance: float, start: tuple[float, float] | None, distance: float
) -> Survival:
    """Times and runs from `start` (pursuer's frame, m), or from `distance` over all bearings."""
    capture = CaptureGame(game.evader_speed, game.pursuer_speed, game.half_axle, capture_distance)
    if start is None:
        bearings = np.linspace(0.0, np.pi / 2.0, _BEARINGS)
        points = distance * np.stack([np.cos(bearings), np.sin(bearings)], -1)
    else:
        points = np.array([start], float)
        distance = float(np.hypot(*points[0]))
    times = np.asarray(jax.vmap(capture.time_to_capture)(jnp.asarray(points, dtype=float)), float)
    worst, best = int(np.argmin(times)), int(np.argmax(times))
    directions = np.linspace(-np.pi, np.pi, 37)[:-1]
    chosen = points[:: max(len(points) // 9, 1)]
    runs = [[certain_run(game, capture_distance, point, way) for way in directions] for point in chosen]
    bearing = np.arctan2(points[:, 1], points[:, 0])
    return Survival(
        start=start,
        distance=distance,
        shortest=float(times[worst]),
        longest=float(times[best]),
        worst_bearing=float(bearing[worst]),
        best_bearing=float(bearing[best]),
        certain_run=float(np.min(runs)),
        longest_run=float(np.max(runs)),
    )
