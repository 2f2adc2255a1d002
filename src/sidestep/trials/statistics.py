"""Confidence intervals and comparisons from a finite number of episodes or seeds."""

import math
from collections.abc import Callable, Sequence
from statistics import NormalDist
from typing import NamedTuple

import numpy as np
from jaxtyping import Float
from numpy.typing import ArrayLike


def _check_level(level: float | int) -> None:
    if not 0.0 < level < 1.0:
        raise ValueError(f"level = {level!r}: it must lie between 0 and 1, 0.95 for a 95 % interval")


def wilson_interval(count: int, total: int, level: float | int = 0.95) -> tuple[float, float]:
    """Wilson's score interval of the rate, for `count` events in n = `total` trials.

    (p + z^2/2n +- z sqrt(p (1 - p)/n + z^2/4n^2)) / (1 + z^2/n), with p = count/n and z the normal quantile
    (Wilson, JASA 1927). Unlike p +- z sqrt(p (1 - p)/n) it has positive width at zero events. Without trials
    it is (0, 1).

    **Raises** `ValueError` unless 0 <= count <= total and 0 < level < 1.
    """
    _check_level(level)
    if not 0 <= count <= total:
        raise ValueError(f"count = {count!r} of total = {total!r}: counts must satisfy 0 <= count <= total")
    if total == 0:
        return 0.0, 1.0
    z = NormalDist().inv_cdf(0.5 + level / 2.0)
    rate, shrink = count / total, 1.0 + z * z / total
    centre = (rate + z * z / (2.0 * total)) / shrink
    half = z / shrink * math.sqrt(rate * (1.0 - rate) / total + (z / (2.0 * total)) ** 2)
    # At count 0 or n one bound is exactly 0 or 1; rounding must not exclude the rate or leave [0, 1].
    return min(max(centre - half, 0.0), rate), max(min(centre + half, 1.0), rate)


def zero_event_bound(total: int, level: float | int = 0.95) -> float:
    """Upper confidence bound of a rate after no event in `total` trials: 1 - (1 - level)^(1/total).

    The rule of three, 3/total at 95 %, approximates it from above. Without trials it is 1.
    """
    _check_level(level)
    if total < 0:
        raise ValueError(f"total = {total!r}: it must be 0 or more")
    return 1.0 if total == 0 else -math.expm1(math.log1p(-level) / total)


def interquartile_mean(values: ArrayLike) -> float:
    """Mean of the middle half: a quarter of the values (rounded down) is cut off at each end.

    It varies less than the median and is more robust than the mean (Agarwal et al., NeurIPS 2021). NaN
    without values.
    """
    ordered = np.sort(np.asarray(values, dtype=float).reshape(-1))
    cut = len(ordered) // 4
    return float(np.mean(ordered[cut : len(ordered) - cut])) if len(ordered) else math.nan


class Interval(NamedTuple):
    """An estimate and its confidence interval."""

    estimate: float
    low: float
    high: float


def stratified_bootstrap(
    strata: Sequence[ArrayLike],
    statistic: Callable[[Float[np.ndarray, "n"]], float] = interquartile_mean,
    *,
    level: float | int = 0.95,
    resamples: int = 2000,
    seed: int = 0,
) -> Interval:
    """Percentile bootstrap interval of `statistic` over all values, resampled within each stratum.

    A stratum holds one value per seed of, for example, one task or scenario (Agarwal et al., NeurIPS 2021).
    The same `seed` gives the same interval.

    **Raises** `ValueError` without strata, for an empty stratum, and for a value that is not finite.
    """
    _check_level(level)
    groups = _strata(strata)
    generator = np.random.default_rng(seed)
    draws = [
        statistic(
            np.concatenate([group[generator.integers(len(group), size=len(group))] for group in groups])
        )
        for _ in range(resamples)
    ]
    low, high = np.quantile(draws, [0.5 - level / 2.0, 0.5 + level / 2.0])
    return Interval(float(statistic(np.concatenate(groups))), float(low), float(high))


def probability_of_improvement(
    first: Sequence[ArrayLike],
    second: Sequence[ArrayLike],
    *,
    level: float | int = 0.95,
    resamples: int = 2000,
    seed: int = 0,
) -> Interval:
    """Probability that a value X of `first` is greater than a value Y of `second`, with bootstrap interval.

    The mean over strata of P(X > Y) + P(X = Y)/2, which is Mann and Whitney's U over the number of pairs;
    both are resampled within each stratum (Agarwal et al., NeurIPS 2021). Above 0.5, `first` is better.

    **Raises** `ValueError` when the numbers of strata differ, and as `stratified_bootstrap`.
    """
    _check_level(level)
    groups = _strata(first), _strata(second)
    if len(first) != len(second):
        raise ValueError(f"{len(first)} strata cannot be compared with {len(second)}: give the same to both")
    pairs = list(zip(*groups, strict=True))
    generator = np.random.default_rng(seed)
    estimate, draws = 0.0, np.zeros(resamples)
    for x, y in pairs:
        wins = 0.5 * (1.0 + np.sign(x[:, None] - y[None, :]))
        # With counts of how often each value was drawn, a resample is two matrix products.
        drawn_x = generator.multinomial(len(x), np.full(len(x), 1.0 / len(x)), size=resamples) / len(x)
        drawn_y = generator.multinomial(len(y), np.full(len(y), 1.0 / len(y)), size=resamples) / len(y)
        estimate += float(np.mean(wins)) / len(pairs)
        draws += np.einsum("rx,xy,ry->r", drawn_x, wins, drawn_y, optimize=True) / len(pairs)
    low, high = np.quantile(draws, [0.5 - level / 2.0, 0.5 + level / 2.0])
    return Interval(estimate, float(low), float(high))


def _strata(values: Sequence[ArrayLike]) -> list[np.ndarray]:
    """The strata as arrays; checks that they are finite."""
    groups = [np.asarray(stratum, dtype=float).reshape(-1) for stratum in values]
    if not groups or any(len(group) == 0 for group in groups):
        raise ValueError("every stratum needs at least one value")
    if not all(np.all(np.isfinite(group)) for group in groups):
        raise ValueError("a value is not finite; leave such runs out and report how many there were")
    return groups
