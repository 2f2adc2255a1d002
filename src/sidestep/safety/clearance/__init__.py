"""How far away must an obstacle be? The table that answers it for pursuer and obstacle together."""

from sidestep.safety.clearance.game import SPARE, ClearanceGame
from sidestep.safety.clearance.solve import Resolution, Solution, solve
from sidestep.safety.clearance.table import (
    STEP,
    Checked,
    ClearanceTable,
    checked,
    clearance_table,
    shipped_table,
    shipped_tables,
    table_for,
)

__all__ = [
    "SPARE",
    "STEP",
    "Checked",
    "ClearanceGame",
    "ClearanceTable",
    "Resolution",
    "Solution",
    "checked",
    "clearance_table",
    "shipped_table",
    "shipped_tables",
    "solve",
    "table_for",
]
