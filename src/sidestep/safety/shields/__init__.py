"""Which action may the robot take? Shields, one file each, from the rows that they keep to their answer."""

from sidestep.safety.shields.adapted import AdaptedShield, covered, of_control_point
from sidestep.safety.shields.barrier_shield import BarrierShield, shield_of
from sidestep.safety.shields.by_table import TableMemory, TableShield
from sidestep.safety.shields.catalogue import (
    BARRIERS,
    JOINT_FORMS,
    PURSUIT_SHIELDS,
    SHIELDS,
    as_shield,
    checked_shield,
    make_shield,
    name_of,
)
from sidestep.safety.shields.game import GameMemory, GameShield
from sidestep.safety.shields.joint import JointShield
from sidestep.safety.shields.none import NoShield
from sidestep.safety.shields.paper import PaperShield
from sidestep.safety.shields.shield import Shield, ShieldResult, filter_in_lanes, start_in_lanes

__all__ = [
    "BARRIERS",
    "JOINT_FORMS",
    "PURSUIT_SHIELDS",
    "SHIELDS",
    "AdaptedShield",
    "BarrierShield",
    "GameMemory",
    "GameShield",
    "JointShield",
    "NoShield",
    "PaperShield",
    "Shield",
    "ShieldResult",
    "TableMemory",
    "TableShield",
    "as_shield",
    "checked_shield",
    "covered",
    "filter_in_lanes",
    "make_shield",
    "name_of",
    "of_control_point",
    "shield_of",
    "start_in_lanes",
]
