"""Hazards of comparisons: strata mixed, the sign of better turned round, claims beyond what is known."""

import numpy as np
import pytest
from scipy.stats import mannwhitneyu

from sidestep.trials.campaign import compare
from sidestep.trials.statistics import interquartile_mean, probability_of_improvement


def rows_of(values):
    """Rows of `{(shield, scenario): values}`, one seed each."""
    return [
        {"shield": shield, "scenario": scenario, "seed": seed, "score": value}
        for (shield, scenario), group in values.items()
        for seed, value in enumerate(group)
    ]


def test_probability_of_improvement_is_mann_and_whitneys():
    generator = np.random.default_rng(0)
    first = [np.round(generator.normal(0.3, 1.0, 9), 1), np.round(generator.normal(0.0, 1.0, 14), 1)]
    second = [np.round(generator.normal(0.0, 1.0, 11), 1), np.round(generator.normal(0.5, 1.0, 7), 1)]
    expected = np.mean(
        [mannwhitneyu(x, y).statistic / (len(x) * len(y)) for x, y in zip(first, second, strict=True)]
    )
    found = probability_of_improvement(first, second)
    assert found.estimate == pytest.approx(expected, abs=1e-12)
    assert found.low < found.estimate < found.high
    turned = probability_of_improvement(second, first)
    assert turned.estimate == pytest.approx(1.0 - expected, abs=1e-12)


def test_probability_of_improvement_covers_the_truth_about_as_often_as_it_says():
    generator = np.random.default_rng(1)
    covered = 0
    for trial in range(200):
        # P(X > Y) of two normal distributions one standard deviation of their difference apart: 0.8413.
        first = [generator.normal(np.sqrt(2.0), 1.0, 20)]
        second = [generator.normal(0.0, 1.0, 20)]
        interval = probability_of_improvement(first, second, resamples=400, seed=trial)
        covered += interval.low <= 0.8413 <= interval.high
    assert 178 <= covered <= 200


def test_improvement_is_certain_impossible_or_open():
    assert probability_of_improvement([[2.0, 3.0]], [[0.0, 1.0]])[:] == (1.0, 1.0, 1.0)
    assert probability_of_improvement([[0.0]], [[1.0]])[:] == (0.0, 0.0, 0.0)
    assert probability_of_improvement([[1.0] * 4], [[1.0] * 4])[:] == (0.5, 0.5, 0.5)
    with pytest.raises(ValueError, match="strata"):
        probability_of_improvement([[1.0]], [[1.0], [2.0]])
    with pytest.raises(ValueError, match="at least one"):
        probability_of_improvement([[]], [[1.0]])


def test_strata_are_not_mixed():
    # The scenario decides nearly everything; within each, the second shield is better by little, always.
    values = {
        ("a", "easy"): [100.0, 101.0],
        ("b", "easy"): [102.0, 103.0],
        ("a", "hard"): [0.0, 1.0],
        ("b", "hard"): [2.0, 3.0],
    }
    comparison = compare(rows_of(values), ["shield"], "score")
    (pair,) = comparison.pairs
    assert (pair.first, pair.second) == ({"shield": "b"}, {"shield": "a"})
    assert pair.probability[:] == (1.0, 1.0, 1.0)
    assert pair.strata == 2
    of_a = comparison.groups[0]
    assert (of_a.values, of_a.strata, of_a.fewest) == (4, 2, 2)
    assert of_a.interquartile_mean.estimate == interquartile_mean([100.0, 101.0, 0.0, 1.0])


def test_less_is_better_where_it_is_said():
    rows = rows_of({("a", "s"): [5.0, 6.0], ("b", "s"): [1.0, 2.0]})
    assert compare(rows, ["shield"], "score").pairs[0].probability.estimate == 0.0
    assert compare(rows, ["shield"], "score", lower_is_better=True).pairs[0].probability.estimate == 1.0


def test_what_has_no_value_is_left_out_and_counted():
    rows = rows_of({("a", "s"): [5.0, None, float("nan")], ("b", "s"): [1.0], ("b", "only"): [9.0]})
    comparison = compare(rows, ["shield"], "score")
    assert comparison.left_out == 2
    # What only one of them met does not compare them.
    assert comparison.pairs[0].strata == 1
    assert comparison.pairs[0].probability.estimate == 0.0


def test_figure_that_nobody_has_is_refused():
    with pytest.raises(ValueError, match="no result has a value of 'scor'"):
        compare(rows_of({("a", "s"): [1.0]}), ["shield"], "scor")
