"""States and answers by which a translated program is checked against the traced one."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import jax
import numpy as np

from sidestep.world import Scenario

SAME = 1e-5
"""Difference up to which two velocities (m/s), or actions, are the same."""
_NUDGES, _ROUNDING = 12, 1e-6
_BATCH = 4096
_FAR = 1e6


def random_states(scenario: Scenario, count: int, seed: int) -> dict[str, np.ndarray]:
    """Worlds and nominal velocities by the names of their fields, in single precision.

    Half of them near pursuers and obstacles; others in contact, on a pursuer's axis, between a pursuer and an
    obstacle, far away, with a value that is not finite, and of random bits.
    """
    rng = np.random.default_rng(seed)
    m, k = scenario.pursuer_count, scenario.obstacle_count
    close, speed = float(scenario.capture_distance), float(scenario.evader_speed)
    least = float(scenario.collision_distance)
    which = rng.integers(0, 20, count)

    def around(centre: np.ndarray, distance: np.ndarray, angle: np.ndarray) -> np.ndarray:
        return centre + distance[..., None] * np.stack([np.cos(angle), np.sin(angle)], -1)

    def angles(robots: int) -> np.ndarray:
        return rng.uniform(-np.pi, np.pi, (count, robots))

    evader = rng.uniform(-2.0, 2.0, (count, 1, 2))
    apart = rng.uniform(0.5 * close, close + 0.8, (count, m))
    contact = (which >= 10) & (which < 13)
    apart[contact] = close + rng.uniform(-2e-3, 2e-3, (count, m))[contact]
    towards, heading = angles(m), angles(m)
    # On its axis, in front or behind.
    on_axis = (which >= 13) & (which < 15)
    turned = np.pi * rng.integers(0, 2, (count, m)) + rng.choice([0.0, 1e-7, 1e-4], (count, m))
    heading[on_axis] = (towards + turned)[on_axis]
    gap = rng.uniform(0.5 * least, least + 0.6, (count, k))
    gap[contact] = least + rng.uniform(-2e-3, 2e-3, (count, k))[contact]
    beside = angles(k)
    pinned = (which >= 15) & (which < 17)
    if m:
        beside[pinned] = (towards[:, :1] + np.pi + rng.normal(0.0, 0.3, (count, k)))[pinned]
    drift = np.hypot(*np.asarray(scenario.obstacle_velocity, float)) + 0.02
    poses = np.concatenate([around(evader, apart, towards), heading[..., None]], -1)
    obstacles = np.concatenate([around(evader, gap, beside), rng.uniform(-drift, drift, (count, k, 2))], -1)
    pace = float(scenario.pursuer_speed)
    state = {
        "evader": evader[:, 0],
        "pursuers": poses,
        "obstacles": obstacles,
        "target": rng.uniform(-3.0, 3.0, (count, 2)),
        "time": rng.uniform(0.0, 60.0, count),
        "evader_velocity": rng.uniform(-speed, speed, (count, 2)),
        "wheel_speeds": rng.uniform(-pace, pace, (count, m, 2)),
        "wish": rng.uniform(-1.3 * speed, 1.3 * speed, (count, 2)),
    }
    state = {name: values.astype(np.float32) for name, values in state.items()}
    far = which == 17
    for name in ("evader", "pursuers", "obstacles", "target"):
        values = state[name]
        values[far] += (_FAR * rng.uniform(-1.0, 1.0, values.shape)).astype(np.float32)[far]
    spoil(state, which == 18, rng)
    for values in state.values():
        bits = rng.integers(0, 2**32, values.shape, np.uint32).view(np.float32)
        values[which == 19] = bits[which == 19]
    return state


def spoil(state: dict[str, np.ndarray], where: np.ndarray, rng: np.random.Generator) -> None:
    """Put NaN or infinity into one value of each of these states."""
    names = [name for name, values in state.items() if values[0].size]
    chosen = rng.integers(0, len(names), len(where))
    for number, name in enumerate(names):
        flat = state[name].reshape(len(where), -1)
        rows = np.flatnonzero(where & (chosen == number))
        flat[rows, rng.integers(0, flat.shape[1], len(rows))] = rng.choice(
            [np.nan, np.inf, -np.inf], len(rows)
        )


def answers(
    function: Callable[..., Any], inputs: list[np.ndarray], *, measured: int, loose: int, seed: int
) -> tuple[np.ndarray, np.ndarray]:
    """What `function` answers to each state, flat, and how far off another program may be.

    Rounding decides between two answers where they are equally good, and where a state lies on the line
    between two cases. The first `measured` inputs of each state are also nudged by some units in the last
    place: as much as the first `loose` entries of the answer then change is allowed beside `SAME`. Infinite
    where anything else changes, too.
    """
    compiled = jax.jit(jax.vmap(function))
    count = len(inputs[0])

    def flat(arguments: list[np.ndarray]) -> np.ndarray:
        parts = []
        for begin in range(0, count, _BATCH):
            some = [values[begin : begin + _BATCH] for values in arguments]
            lacking = min(_BATCH, count) - len(some[0])
            some = [np.concatenate([values, np.repeat(values[-1:], lacking, 0)]) for values in some]
            found = [np.asarray(part, np.float32) for part in compiled(*some)]
            size = min(_BATCH, count - begin)
            parts.append(np.concatenate([part.reshape(len(part), -1) for part in found], 1)[:size])
        return np.concatenate(parts)

    rng, first = np.random.default_rng(seed), flat(inputs)
    allowed = np.full(count, SAME)
    for _ in range(_NUDGES):
        nudged = list(inputs)
        with np.errstate(all="ignore"):
            for k, values in enumerate(inputs[:measured]):
                scale = np.maximum(np.abs(values), 1.0) * _ROUNDING
                nudged[k] = (values + rng.uniform(-1.0, 1.0, values.shape) * scale).astype(np.float32)
            change = np.abs(flat(nudged) - first)
        allowed += np.max(change[:, :loose], 1)
        allowed[np.any(change[:, loose:] > 0.0, 1)] = np.inf
    return first, allowed.astype(np.float32)
