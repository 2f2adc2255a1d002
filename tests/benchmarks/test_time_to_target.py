"""Hazard: a pursuer of the study cannot be made, which shows after minutes."""

import pytest

import time_to_target
from sidestep.pursuit import PURSUERS


@pytest.mark.parametrize("name", [*PURSUERS, *time_to_target.HELD_OUT])
def test_every_pursuer_of_the_study_can_be_made(name):
    assert callable(time_to_target.pursuer(name))
