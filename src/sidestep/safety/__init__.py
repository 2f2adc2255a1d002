"""What keeps the evader free: the exact filter, barriers and their rows, shields and their status."""

from sidestep.safety.barriers import (
    BARRIERS,
    Barrier,
    BarrierRows,
    ObstacleBarrier,
    PursuitBarrier,
    RangeBarrier,
    compose,
)
from sidestep.safety.filter import Projection, project, tolerance
from sidestep.safety.shields import (
    SHIELDS,
    GameShield,
    NoShield,
    PaperShield,
    Shield,
    ShieldResult,
    as_shield,
    make_shield,
)
from sidestep.safety.status import Status

__all__ = [
    "BARRIERS",
    "SHIELDS",
    "Barrier",
    "BarrierRows",
    "GameShield",
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
    "compose",
    "make_shield",
    "project",
    "tolerance",
]
