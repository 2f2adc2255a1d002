"""Hazards of statistics: claims stronger than the evidence, intervals that exclude the truth."""

import math

import numpy as np
import pytest
from scipy.stats import binomtest, trim_mean

from sidestep.trials.statistics import (
    interquartile_mean,
    stratified_bootstrap,
    wilson_interval,
    zero_event_bound,
)


@pytest.mark.parametrize(
    "count, total", [(0, 1), (0, 200), (1, 10), (5, 10), (199, 200), (1000, 1000), (31, 400)]
)
@pytest.mark.parametrize("level", [0.8, 0.95, 0.999])
def test_wilson_interval_agrees_with_an_independent_implementation(count, total, level):
    expected = binomtest(count, total).proportion_ci(level, method="wilson")
    assert wilson_interval(count, total, level) == pytest.approx((expected.low, expected.high), abs=1e-12)


def test_zero_captures_are_not_called_zero_risk():
    low, high = wilson_interval(0, 200)
    assert low == 0.0
    assert 0.018 < high < 0.020
    assert wilson_interval(200, 200)[1] == 1.0
    assert wilson_interval(0, 0) == (0.0, 1.0)


def test_wilson_interval_covers_the_truth_as_often_as_it_says():
    generator = np.random.default_rng(0)
    for rate in (0.02, 0.3, 0.9):
        counts = generator.binomial(150, rate, size=4000)
        intervals = {count: wilson_interval(int(count), 150) for count in np.unique(counts)}
        covered = np.mean([intervals[c][0] <= rate <= intervals[c][1] for c in counts])
        assert covered > 0.92


@pytest.mark.parametrize("count, total, level", [(-1, 5, 0.95), (6, 5, 0.95), (1, 5, 1.0), (1, 5, 95)])
def test_impossible_counts_are_refused(count, total, level):
    with pytest.raises(ValueError, match="must"):
        wilson_interval(count, total, level)


def test_rule_of_three_is_close_and_never_below_the_exact_bound():
    for total in (10, 100, 1000, 10**9):
        assert 0.85 * 3 / total < zero_event_bound(total) < 3 / total
    assert zero_event_bound(0) == 1.0
    with pytest.raises(ValueError, match="0 or more"):
        zero_event_bound(-1)


def test_interquartile_mean_ignores_one_broken_seed():
    assert interquartile_mean([990, 991, 992, 993, -1e9]) == pytest.approx(991, abs=1)
    values = np.random.default_rng(1).normal(size=101)
    assert interquartile_mean(values) == pytest.approx(trim_mean(values, 0.25))
    assert interquartile_mean([3.0]) == 3.0
    assert math.isnan(interquartile_mean([]))


def test_bootstrap_interval_contains_the_estimate_and_covers_the_truth():
    generator = np.random.default_rng(2)
    covered = 0
    for trial in range(60):
        strata = [generator.normal(mean, 1.0, size=12) for mean in (0.0, 5.0)]
        interval = stratified_bootstrap(strata, lambda x: float(np.mean(x)), resamples=400, seed=trial)
        assert interval.low <= interval.estimate <= interval.high
        covered += interval.low <= 2.5 <= interval.high
    assert covered >= 48


def test_bootstrap_does_not_mix_strata():
    # Constant strata leave nothing to resample; mixing them would make the interval wide.
    assert stratified_bootstrap([[0.0] * 5, [100.0] * 5], lambda x: float(np.mean(x)))[:] == (
        50.0,
        50.0,
        50.0,
    )


def test_bootstrap_is_repeatable_and_refuses_what_it_cannot_use():
    strata = [np.random.default_rng(3).normal(size=10)]
    assert stratified_bootstrap(strata, seed=4) == stratified_bootstrap(strata, seed=4)
    assert stratified_bootstrap(strata, seed=4) != stratified_bootstrap(strata, seed=5)
    with pytest.raises(ValueError, match="at least one"):
        stratified_bootstrap([[1.0], []])
    with pytest.raises(ValueError, match="not finite"):
        stratified_bootstrap([[1.0, math.nan]])
