"""The falsifier: attacks that search for a pursuer and a start against which a shield fails."""

from sidestep.trials.falsification.attacks import ATTACKS
from sidestep.trials.falsification.chases import GOALS
from sidestep.trials.falsification.counterexamples import (
    Counterexample,
    CounterexampleError,
    Replay,
    read_counterexample,
    replay,
    write_counterexample,
)
from sidestep.trials.falsification.search import Falsification, Plan, Progress, falsify
from sidestep.trials.falsification.verdict import ASSUMPTIONS, Verdict, judge

__all__ = [
    "ASSUMPTIONS",
    "ATTACKS",
    "GOALS",
    "Counterexample",
    "CounterexampleError",
    "Falsification",
    "Plan",
    "Progress",
    "Replay",
    "Verdict",
    "falsify",
    "judge",
    "read_counterexample",
    "replay",
    "write_counterexample",
]
