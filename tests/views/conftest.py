"""Runs and episodes made by hand, without training or simulating."""

import importlib.util
from pathlib import Path

import pytest


@pytest.fixture(scope="session")
def chase():
    """`chase(reverse=False, gap=0.08, obstacles=1, pursuers=1, steps=400)`: see `trials/chases.py`."""
    path = Path(__file__).parent.with_name("trials") / "chases.py"
    spec = importlib.util.spec_from_file_location("chases", path)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module.make_chase


@pytest.fixture(scope="session")
def run_of():
    """`run_of(shield, outcomes, seed)`: a run whose episodes ended like this."""
    from sidestep.views import Run
    from sidestep.world import Scenario, scenario_to_dict

    def run_of(shield="game", outcomes=("reached",) * 30, seed=0):
        metrics = [
            {
                "episode": i + 1,
                "outcome": outcome,
                "return": 990.0 if outcome == "reached" else -20.0,
                "steps": 100,
                "env_steps": 100 * (i + 1),
                "min_pursuer_clearance": 0.1,
                "min_obstacle_clearance": None,
                "interventions": 20,
                "infeasible": 0,
                "mean_correction": 0.01,
            }
            for i, outcome in enumerate(outcomes)
        ]
        config = {"scenario": scenario_to_dict(Scenario()), "shield": shield, "pursuer": "nash", "seed": seed}
        return Run(config=config, metrics=metrics)

    return run_of
