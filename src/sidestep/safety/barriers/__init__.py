"""What has to stay positive, and which velocities keep it so: barriers, their rows, their margins."""

from sidestep.safety.barriers.barrier import (
    Barrier,
    BarrierRows,
    ObstacleBarrier,
    RangeBarrier,
    compose,
)
from sidestep.safety.barriers.budget import Budget, BudgetWarning
from sidestep.safety.barriers.distance_game import DistanceValue, grid_barrier, solve_distance
from sidestep.safety.barriers.frame_barrier import FrameBarrier
from sidestep.safety.barriers.probe import BarrierProbe, BarrierWarning, probe_barrier
from sidestep.safety.barriers.pursuit_barrier import PursuitBarrier

__all__ = [
    "Barrier",
    "BarrierProbe",
    "BarrierRows",
    "BarrierWarning",
    "Budget",
    "BudgetWarning",
    "DistanceValue",
    "FrameBarrier",
    "ObstacleBarrier",
    "PursuitBarrier",
    "RangeBarrier",
    "compose",
    "grid_barrier",
    "probe_barrier",
    "solve_distance",
]
