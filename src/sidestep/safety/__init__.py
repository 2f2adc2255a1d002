"""What keeps the evader free: the exact filter, barriers and their rows, shields, the certificate."""

from sidestep.safety.adapted import AdaptedShield, covered, of_control_point
from sidestep.safety.barrier_shield import BarrierShield, shield_of
from sidestep.safety.barriers import (
    Barrier,
    BarrierRows,
    ObstacleBarrier,
    RangeBarrier,
    compose,
)
from sidestep.safety.budget import Budget, BudgetWarning
from sidestep.safety.catalogue import BARRIERS, SHIELDS, as_shield, make_shield
from sidestep.safety.certificate import Certificate, certify
from sidestep.safety.distance_game import DistanceValue, grid_barrier, solve_distance
from sidestep.safety.filter import Projection, project, tolerance
from sidestep.safety.frame_barrier import FrameBarrier
from sidestep.safety.joint import JointShield
from sidestep.safety.probe import BarrierProbe, BarrierWarning, probe_barrier
from sidestep.safety.pursuit_barrier import PursuitBarrier
from sidestep.safety.shields import (
    GameMemory,
    GameShield,
    NoShield,
    PaperShield,
    Shield,
    ShieldResult,
    filter_in_lanes,
    start_in_lanes,
)
from sidestep.safety.status import Status

__all__ = [
    "BARRIERS",
    "SHIELDS",
    "AdaptedShield",
    "Barrier",
    "BarrierProbe",
    "BarrierRows",
    "BarrierShield",
    "BarrierWarning",
    "Budget",
    "BudgetWarning",
    "Certificate",
    "DistanceValue",
    "FrameBarrier",
    "GameMemory",
    "GameShield",
    "JointShield",
    "NoShield",
    "ObstacleBarrier",
    "PaperShield",
    "Projection",
    "PursuitBarrier",
    "RangeBarrier",
    "Shield",
    "ShieldResult",
    "Status",
    "as_shield",
    "certify",
    "compose",
    "covered",
    "filter_in_lanes",
    "grid_barrier",
    "make_shield",
    "of_control_point",
    "probe_barrier",
    "project",
    "shield_of",
    "solve_distance",
    "start_in_lanes",
    "tolerance",
]
