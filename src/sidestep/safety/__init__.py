"""What keeps the evader free: the exact filter, barriers and their rows, shields, the certificate."""

from sidestep.safety.barriers import (
    BARRIERS,
    Barrier,
    BarrierRows,
    ObstacleBarrier,
    PursuitBarrier,
    RangeBarrier,
    compose,
)
from sidestep.safety.budget import Budget, BudgetWarning
from sidestep.safety.catalogue import SHIELDS, as_shield, make_shield
from sidestep.safety.certificate import Certificate, certify
from sidestep.safety.filter import Projection, project, tolerance
from sidestep.safety.joint import JointShield
from sidestep.safety.shields import (
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
    "Barrier",
    "BarrierRows",
    "Budget",
    "BudgetWarning",
    "Certificate",
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
    "filter_in_lanes",
    "make_shield",
    "project",
    "start_in_lanes",
    "tolerance",
]
