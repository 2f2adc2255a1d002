"""Timing: single calls, batches, and what a distribution of seconds is summed up to."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np


def spread(seconds: Sequence[float], unit: str = "us") -> dict[str, Any]:
    """p50, p99, worst and mean of durations in seconds, in `unit` (us or ms), and how many they are."""
    scaled = np.asarray(seconds, dtype=float) * {"us": 1e6, "ms": 1e3}[unit]
    return {
        "unit": unit,
        "p50": float(np.quantile(scaled, 0.5)),
        "p99": float(np.quantile(scaled, 0.99, method="higher")),
        "worst": float(scaled.max()),
        "mean": float(scaled.mean()),
        "count": len(scaled),
    }


def first_call(call: Callable[[], Any]) -> tuple[Any, float]:
    """What `call()` gives, and how long it took: for compiled code, mostly compilation."""
    begun = time.perf_counter()
    answer = call()
    return answer, time.perf_counter() - begun


def durations(
    call: Callable[[int], Any], budget: float, least: int = 5, most: int = 100_000, warm_up: int = 1
) -> list[float]:
    """Seconds of each `call(i)`, for `budget` seconds in all, at least `least` and at most `most` times.

    `call` returns only when its work is done (`jax.block_until_ready`).
    """
    for i in range(warm_up):
        call(i)
    seconds: list[float] = []
    end = time.perf_counter() + budget
    while len(seconds) < most and (len(seconds) < least or time.perf_counter() < end):
        begun = time.perf_counter()
        call(len(seconds))
        seconds.append(time.perf_counter() - begun)
    return seconds


def exponent(sizes: Sequence[Any], seconds: Sequence[Any]) -> float:
    """p of the power law seconds ~ size^p: the slope of a straight line in log-log axes, by least squares.

    **Raises** `ValueError` for fewer than two sizes, or one that is not positive.
    """
    if len(sizes) < 2 or min(*sizes, *seconds) <= 0.0:
        raise ValueError(f"sizes = {list(sizes)}: a fit needs two or more, all positive")
    x, y = np.log(np.asarray(sizes, float)), np.log(np.asarray(seconds, float))
    return float(np.polyfit(x, y, 1)[0])


_FEWEST, _NARROWEST = 3, 4.0
"""An exponent needs so many sizes, the largest so many times the least: else it says nothing of growth."""


def tail(sizes: Sequence[Any], seconds: Sequence[Any]) -> list[tuple[Any, Any]]:
    """The larger half of the sizes, three at least, with their seconds: where fixed costs hide no growth."""
    points = [(size, spent) for size, spent in zip(sizes, seconds, strict=True) if size > 0 and spent > 0]
    return points[-max(_FEWEST, math.ceil(len(points) / 2)) :]


def tail_exponent(sizes: Sequence[Any], seconds: Sequence[Any]) -> float | None:
    """`exponent` over the `tail`; None if that has fewer than three sizes or spans no factor of 4."""
    kept = tail(sizes, seconds)
    if len(kept) < _FEWEST or kept[-1][0] < _NARROWEST * kept[0][0]:
        return None
    return exponent([p[0] for p in kept], [p[1] for p in kept])
