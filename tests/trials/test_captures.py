"""Hazards of explanations: blaming the wrong thing, or explaining what did not happen."""

import numpy as np
import pytest

from sidestep.trials import count_causes, explain_capture
from sidestep.world import Scenario

EVADER_SPEED, PURSUER_SPEED, PURSUER_GAIN = 0.1574, 0.2, 1.2
PAPER = Scenario()


def test_head_on_capture_is_lost_where_the_row_becomes_infeasible(chase):
    trajectory = chase()
    capture = explain_capture(PAPER, trajectory)
    assert capture.cause == "head-on"
    lost_below = (PURSUER_SPEED - EVADER_SPEED) / PURSUER_GAIN
    assert capture.range_barrier[capture.decisive_period] == pytest.approx(lost_below, abs=0.0025)
    assert np.all(
        capture.moved[: capture.decisive_period] >= capture.needed[: capture.decisive_period] - 1e-5
    )
    assert np.allclose(capture.expected, capture.needed, atol=1e-5)
    assert np.allclose(capture.normal, [1.0, 0.0])


def test_reversing_pursuer_is_told_from_one_that_comes_head_on(chase):
    capture = explain_capture(PAPER, chase(reverse=True))
    assert capture.cause == "reversing"
    assert np.all(capture.expected < 0.0)
    assert capture.needed[-1] > EVADER_SPEED


def test_the_pursuer_that_caught_it_is_the_one_explained(chase):
    assert explain_capture(PAPER, chase(pursuers=3)).pursuer == 0


def test_episode_without_capture_is_not_explained(chase):
    with pytest.raises(ValueError, match="not in a capture"):
        explain_capture(PAPER, chase(steps=10))


def test_causes_are_counted(chase):
    counts = count_causes(PAPER, [chase(), chase(reverse=True), chase(gap=0.05)])
    assert counts == {"reversing": 1, "head-on": 2, "other": 0}
