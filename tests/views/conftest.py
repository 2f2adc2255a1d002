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


@pytest.fixture(scope="session")
def survey_of(chase):
    """`survey_of(clearances, corrected)`: a survey of these least distances to capture, m, and two worst
    episodes, captures; `corrected` periods with a correction of 0.1 m/s straight ahead of the pursuer."""
    import numpy as np

    from sidestep.trials import Evaluation, InterventionMap, Survey, WorstEpisode
    from sidestep.trials.intervention_map import CELLS

    def survey_of(clearances=(-0.001, 0.02, 0.4), corrected=40):
        count = len(clearances)
        lost = np.asarray(clearances) <= 0.0
        sums = np.zeros((CELLS**2 + 1, 6))
        sums[CELLS * (CELLS // 2) + CELLS - 4] = [50, corrected, 0, 0.1 * corrected, 0.1 * corrected, 0.0]
        sums[-1, 0] = 50
        evaluation = Evaluation(
            outcome=np.where(lost, 0, 2),
            returns=np.zeros(count),
            steps=np.full(count, 100),
            times=np.full(count, 5.0),
            min_pursuer_clearance=np.asarray(clearances, float),
            min_obstacle_clearance=np.full(count, 0.3),
            interventions=np.full(count, 10),
            infeasible=np.zeros(count, int),
            invalid=np.zeros(count, int),
            mean_correction=np.full(count, 0.01),
            max_correction=np.full(count, 0.1),
            map=InterventionMap.of_sums(0.5, sums),
        )
        worst = (WorstEpisode(0, "capture", chase()), WorstEpisode(1, "collision", chase(reverse=True)))
        return Survey(evaluation, 7, worst)

    return survey_of


@pytest.fixture
def drawn(monkeypatch, tmp_path):
    """`drawn(draw)`: the figure that `draw(path)` would have saved, with its labels placed."""
    from sidestep.views import style
    from sidestep.views.labels import place_labels

    def drawn(draw):
        figures = []
        with monkeypatch.context() as patch:
            patch.setattr(style, "save", lambda figure, path: (figures.append(figure), (path, path))[1])
            draw(tmp_path / "x")
        place_labels(figures[0])
        return figures[0]

    return drawn
