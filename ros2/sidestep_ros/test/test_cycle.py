"""The control cycle: no command may come late unseen."""

import pytest
from sidestep_ros.cycle import Cycle

PERIOD = 0.05


@pytest.fixture
def cycle():
    cycle = Cycle(PERIOD, grace=0.1, late_after=0.2)
    cycle.sent(10.0, 0.001, in_step=True)
    return cycle


def test_first_command_is_not_late():
    assert Cycle(PERIOD).sent(1e9, 5.0, in_step=True) is None


def test_command_within_the_limit_is_not_late(cycle):
    assert cycle.sent(10.0599, 0.001, in_step=True) is None
    assert (cycle.commands, cycle.late) == (2, 0)


def test_late_command_is_counted_and_says_by_how_much(cycle):
    late = cycle.sent(10.075, 0.03, in_step=True)
    assert late.gap == pytest.approx(0.075)
    assert "75.0 ms" in str(late)
    assert "30.0 ms" in str(late)
    assert cycle.late == 1
    assert cycle.worst_gap == pytest.approx(0.075)


def test_lateness_does_not_accumulate(cycle):
    cycle.sent(10.075, 0.001, in_step=True)
    assert cycle.sent(10.125, 0.001, in_step=True) is None


def test_poses_before_the_period_is_over_do_not_make_decisions_more_frequent(cycle):
    assert not cycle.is_due(10.04)
    assert cycle.is_due(10.046)


def test_after_poses_failed_to_come_the_next_ones_are_used_at_once(cycle):
    cycle.sent(10.055, 0.001, in_step=False)
    assert not cycle.is_due(10.056)
    assert cycle.is_due(10.07)


def test_waiting_for_poses_alone_never_makes_a_command_late(cycle):
    assert cycle.patience < cycle.limit
    assert cycle.sent(10.0 + cycle.patience, 0.0, in_step=False) is None
