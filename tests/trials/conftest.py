"""Episodes made by hand, without running the simulator."""

import importlib.util
from pathlib import Path

import pytest


@pytest.fixture
def chase():
    """`chase(reverse=False, gap=0.08, obstacles=1, pursuers=1, steps=400)`: see `chases.py`."""
    spec = importlib.util.spec_from_file_location("chases", Path(__file__).with_name("chases.py"))
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module.make_chase
