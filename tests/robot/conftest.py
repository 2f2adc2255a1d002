"""The decision core that its tests share: it compiles once."""

import pytest


@pytest.fixture(scope="session")
def core():
    """A core that is warm; use `onboard`."""
    from sidestep.robot import Onboard
    from sidestep.world import load_scenario

    made = Onboard(load_scenario("paper", capture_distance=0.15), "game")
    made.warm_up()
    return made


@pytest.fixture
def onboard(core):
    """A core that has seen nothing yet, behind `game`, at a capture distance of 0.15 m."""
    core.reset()
    return core
