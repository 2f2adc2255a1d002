"""The falsifier: attacks that search for a pursuer and a start against which a shield fails."""

from sidestep.trials.falsification.attacks import ATTACKS
from sidestep.trials.falsification.chases import GOALS
from sidestep.trials.falsification.continuing import search_settings
from sidestep.trials.falsification.counterexamples import (
    Counterexample,
    CounterexampleError,
    Replay,
    read_counterexample,
    replay,
    write_counterexample,
)
from sidestep.trials.falsification.search import check_plan, falsify
from sidestep.trials.falsification.tallies import Falsification, Plan, Progress
from sidestep.trials.falsification.verdict import ASSUMPTIONS, Verdict, certified_clearance, judge

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
    "certified_clearance",
    "check_plan",
    "falsify",
    "judge",
    "read_counterexample",
    "replay",
    "search_settings",
    "write_counterexample",
]
