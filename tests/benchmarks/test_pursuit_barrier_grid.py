"""The pursuit barrier is the value of the game: against a solution on a grid that knows no closed form."""

import numpy as np
import pytest

import pursuit_barrier_grid as grid


@pytest.fixture(scope="module")
def fast_evader():
    """The paper's speeds, on a coarse grid and on one half as fine."""
    return {cells: grid.bracket(0.1574 / 0.2, cells, levels=(0.5, 1.25)) for cells in (24, 48)}


WAYS = ("pursuer_knows", "evader_knows")


def test_where_the_evader_escapes_the_grids_value_is_the_barrier(fast_evader):
    """l = 0.1 m, half of the largest: 0 <= h <= h_max is a strip 0.1 m wide."""
    case = grid.CASES["well below the largest capture distance"]
    coarse, fine = (grid.compare(case, fast_evader[cells]) for cells in (24, 48))
    assert fine["evader_can_escape"]
    assert fine["grid_step"] == pytest.approx(0.0133, abs=1e-4)
    for way in WAYS:
        assert fine[way]["barrier"]["nodes"] > 100
        assert fine[way]["barrier"]["mean_absolute"] < 4e-4
        assert fine[way]["barrier"]["largest_absolute"] < 8e-3
        assert fine[way]["capture_set"]["disputed_nodes"] == 0
        # Below l too, where the barrier is negative: only beyond h_max, at l_max, is the grid less certain.
        assert abs(fine[way]["smallest_distance"]["mean"]) < 0.035
        assert fine[way]["smallest_distance"]["mean"] < coarse[way]["smallest_distance"]["mean"]
    low, high = (one.values for one in fast_evader[48])
    assert np.all(low <= high + 1e-3)


def test_a_barrier_of_another_game_does_not_agree(fast_evader):
    """The comparison can fail: speeds a few percent off, or an axle, give ten times the error."""
    right = grid.compare((0.1574, 0.2, 0.2, 0.1), fast_evader[48])["midway"]["barrier"]["mean_absolute"]
    for wrong in ((0.147, 0.2, 0.2, 0.1), (0.168, 0.2, 0.2, 0.1)):
        assert grid.compare(wrong, fast_evader[48])["midway"]["barrier"]["mean_absolute"] > 10.0 * right


def test_where_the_pursuer_wins_everybody_is_caught_and_when_the_game_says():
    case = grid.CASES["slow evader"]
    report = grid.compare(
        case, grid.bracket(case[0] / case[1], 48, levels=(case[3] / case[2],), longest=15.0)
    )
    assert not report["evader_can_escape"]
    for way in WAYS:
        assert report[way]["capture_set"]["disputed_nodes"] == 0
        assert report[way]["capture_time"]["nodes"] > 200
        assert report[way]["capture_time"]["longest"] > 4.0
        assert report[way]["capture_time"]["mean_absolute"] < 0.02
        assert report[way]["capture_time"]["largest_absolute"] < 0.12


def test_a_larger_capture_distance_than_the_largest_loses_the_whole_plane(fast_evader):
    """l = 0.25 m at the paper's speeds: l_max = 0.2008 m."""
    report = grid.compare(grid.CASES["larger capture distance"], fast_evader[48])
    assert not report["evader_can_escape"]
    for way in WAYS:
        assert report[way]["capture_set"]["disputed_nodes"] == 0


@pytest.mark.slow
def test_the_error_vanishes_as_the_grid_is_refined():
    case = grid.CASES["well below the largest capture distance"]
    errors, plateaus = [], []
    for cells in (48, 96, 144):
        bounds = grid.bracket(case[0] / case[1], cells, levels=(case[3] / case[2],))
        report = grid.compare(case, bounds)
        errors.append(report["evader_knows"]["barrier"]["mean_absolute"])
        plateaus.append(report["evader_knows"]["smallest_distance"]["mean"])
    assert errors[0] > 2.0 * errors[1] > 3.0 * errors[2]
    assert plateaus[0] > 1.5 * plateaus[1] > 1.8 * plateaus[2] > 0.0
