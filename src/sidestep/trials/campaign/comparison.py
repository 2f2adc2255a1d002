"""Compare groups of jobs: interquartile means and probabilities of improvement, with intervals."""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import Any

from sidestep.trials.campaign.jobs import AXES
from sidestep.trials.statistics import Interval, probability_of_improvement, stratified_bootstrap

_Labels = tuple[Any, ...]
_Values = dict[_Labels, list[float]]


@dataclass(frozen=True)
class Group:
    """One group in one figure: its interquartile mean with the 95 % bootstrap interval.

    `fewest` is the smallest number of seeds in a stratum. With one seed there is nothing to resample, and the
    interval is meaningless.
    """

    labels: dict[str, Any]
    interquartile_mean: Interval
    values: int
    strata: int
    fewest: int


@dataclass(frozen=True)
class Pair:
    """Probability that a job of `first` is better than one of `second` in the same stratum, with the 95 %
    bootstrap interval."""

    first: dict[str, Any]
    second: dict[str, Any]
    probability: Interval
    strata: int


@dataclass(frozen=True)
class Comparison:
    """One figure over all groups. `left_out` is the number of jobs without a finite value."""

    figure: str
    lower_is_better: bool
    groups: tuple[Group, ...]
    pairs: tuple[Pair, ...]
    left_out: int

    def to_dict(self) -> dict[str, Any]:
        """JSON values."""

        def plain(value: Any) -> Any:
            if isinstance(value, Interval):
                return value._asdict()
            if isinstance(value, dict):
                return {key: plain(item) for key, item in value.items()}
            return [plain(item) for item in value] if isinstance(value, (list, tuple)) else value

        return plain(asdict(self))


def compare(
    rows: Sequence[dict[str, Any]],
    by: Sequence[str],
    figure: str,
    *,
    lower_is_better: bool = False,
    resamples: int = 2000,
    seed: int = 0,
) -> Comparison:
    """Compare groups of rows in one figure (Agarwal et al., NeurIPS 2021). A group shares the labels `by`.

    Rows of a group that differ only in the seed form a stratum. Seeds are resampled within a stratum only.
    Pairs are compared over the strata that both have.

    **Raises** `ValueError` when no row has a numeric value of the figure.
    """
    strata_by = [axis for axis in AXES if axis not in (*by, "seed")]
    groups: dict[_Labels, _Values] = {}
    left_out = 0
    for row in rows:
        value = row.get(figure)
        if isinstance(value, bool) or not isinstance(value, (int, float)) or not math.isfinite(value):
            left_out += 1
            continue
        group = groups.setdefault(tuple(row.get(axis) for axis in by), {})
        group.setdefault(tuple(row.get(axis) for axis in strata_by), []).append(float(value))
    if not groups:
        raise ValueError(f"no result has a value of '{figure}'")

    def labels(key: _Labels) -> dict[str, Any]:
        return dict(zip(by, key, strict=True))

    found = [
        Group(
            labels(key),
            stratified_bootstrap(list(strata.values()), resamples=resamples, seed=seed),
            sum(map(len, strata.values())),
            len(strata),
            min(map(len, strata.values())),
        )
        for key, strata in groups.items()
    ]
    pairs = []
    for (second, of_second), (first, of_first) in itertools.combinations(groups.items(), 2):
        common = [stratum for stratum in of_first if stratum in of_second]
        if not common:
            continue
        sides = [of_first[s] for s in common], [of_second[s] for s in common]
        better, worse = sides[::-1] if lower_is_better else sides
        probability = probability_of_improvement(better, worse, resamples=resamples, seed=seed)
        pairs.append(Pair(labels(first), labels(second), probability, len(common)))
    return Comparison(figure, lower_is_better, tuple(found), tuple(pairs), left_out)
