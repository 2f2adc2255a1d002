"""Random problems for the filter, their exact answers, and how a side is asked."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

LIMIT = 0.18
"""Speed limit, m/s."""
SINGLES = 256
"""Problems that single calls go round."""
ACTIVE = 0.999
"""The disc counts as active from this share of the limit on."""


@dataclass(frozen=True)
class Problems:
    """N problems of k rows: `nominal (N, 2)`, `normals (N, k, 2)`, `offsets (N, k)`, in m/s."""

    nominal: np.ndarray
    normals: np.ndarray
    offsets: np.ndarray


@dataclass(frozen=True)
class Side:
    """How one side answers: problem i of the first ones, and all at once; then answers as (2,) and (N, 2)."""

    single: Callable[[int], Any]
    batch: Callable[[], Any]
    answer: Callable[[Any], np.ndarray]
    answers: Callable[[Any], np.ndarray]


def problems(count: int, rows: int, seed: int = 0) -> Problems:
    """Random feasible problems, the same for every side."""
    random = np.random.default_rng([seed, rows])
    angle = random.uniform(-np.pi, np.pi, (count, rows))
    normals = np.stack([np.cos(angle), np.sin(angle)], axis=-1)
    inside = 0.7 * LIMIT * random.uniform(-1.0, 1.0, (count, 1, 2)) / np.sqrt(2.0)
    margin = random.uniform(0.0, 0.5 * LIMIT, (count, rows))
    direction = random.uniform(-np.pi, np.pi, count)
    speed = 2.0 * LIMIT * np.sqrt(random.uniform(size=count))
    nominal = speed[:, None] * np.stack([np.cos(direction), np.sin(direction)], axis=-1)
    return Problems(nominal, normals, np.sum(normals * inside, axis=-1) - margin)


def disagreement(given: Problems, answers: np.ndarray) -> dict[str, Any]:
    """Largest distance (m/s) to the exact answer where the disc is not active there, and how many those are.

    The exact answer is computed here in NumPy and double precision: the best of the nominal action, its
    projections on the rows' lines and the lines' crossings, among those that keep all rows.
    """
    exact, inside = exact_answers(given)
    apart = np.linalg.norm(answers[inside] - exact[inside], axis=-1)
    return {
        "compared": int(inside.sum()),
        "largest_difference": float(apart.max()),
        "median_difference": float(np.median(apart)),
    }


def exact_answers(given: Problems) -> tuple[np.ndarray, np.ndarray]:
    """The closest actions that keep all rows, without any speed limit, and where they are within it."""
    nominal, normals, offsets = given.nominal, given.normals, given.offsets
    count, rows = offsets.shape
    candidates = [nominal]
    for i in range(rows):
        short = offsets[:, i] - np.sum(normals[:, i] * nominal, axis=-1)
        candidates.append(nominal + short[:, None] * normals[:, i])
        for j in range(i):
            pair = np.stack([normals[:, i], normals[:, j]], axis=1)
            crossing = pair[:, 0, 0] * pair[:, 1, 1] - pair[:, 0, 1] * pair[:, 1, 0]
            sound = np.abs(crossing) > 1e-9
            scale = 1.0 / np.where(sound, crossing, 1.0)
            x = (offsets[:, i] * pair[:, 1, 1] - offsets[:, j] * pair[:, 0, 1]) * scale
            y = (offsets[:, j] * pair[:, 0, 0] - offsets[:, i] * pair[:, 1, 0]) * scale
            candidates.append(np.where(sound[:, None], np.stack([x, y], axis=-1), np.inf))
    best, least = np.full((count, 2), np.nan), np.full(count, np.inf)
    for candidate in candidates:
        finite = np.where(np.isfinite(candidate), candidate, 1e3)
        kept = np.all(np.einsum("nkc,nc->nk", normals, finite) >= offsets - 1e-12, axis=-1)
        distance = np.where(kept, np.linalg.norm(finite - nominal, axis=-1), np.inf)
        closer = distance < least
        best[closer], least[closer] = finite[closer], distance[closer]
    return best, np.linalg.norm(best, axis=-1) < ACTIVE * LIMIT
