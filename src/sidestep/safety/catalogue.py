"""Every shield and every barrier by name."""

import dataclasses

from sidestep.safety.adapted import AdaptedShield, covered, of_control_point
from sidestep.safety.barrier_shield import shield_of
from sidestep.safety.barriers import Barrier, ObstacleBarrier, RangeBarrier
from sidestep.safety.budget import Budget
from sidestep.safety.joint import JointShield
from sidestep.safety.pursuit_barrier import PursuitBarrier
from sidestep.safety.shields import GameShield, NoShield, PaperShield, Shield
from sidestep.world.scenario import Scenario

SHIELDS: dict[str, type[Shield]] = {
    "none": NoShield,
    "paper": PaperShield,
    "game": GameShield,
    "joint": JointShield,
}
"""Every shield by name."""
BARRIERS: dict[str, Barrier] = {
    "obstacle": ObstacleBarrier(),
    "range": RangeBarrier(),
    "pursuit": PursuitBarrier(),
    "pursuit, velocity known": PursuitBarrier(known_velocity=True),
}
"""Every barrier by name."""
BUDGETED: dict[str, type[GameShield] | type[JointShield]] = {"game": GameShield, "joint": JointShield}
"""Shields that keep a budget."""


def make_shield(name: str, scenario: Scenario, budget: Budget | None = None) -> Shield:
    """The shield `name` (a key of `SHIELDS`) for a scenario; `budget` for `game` and `joint` only.

    **Raises** `ValueError` naming the known shields, or what is wrong with the budget. **Warns**
    `BudgetWarning` once where the budget is more than the game leaves.

    With robots of one's own (`EvaderModel`, `PursuerModel`) it is an `AdaptedShield`.
    """
    if name not in SHIELDS:
        raise ValueError(f"no shield {name!r}; use one of {', '.join(map(repr, SHIELDS))}")
    if not scenario.built_in:
        guarded = of_control_point(scenario)
        # The others say nothing of what a pursuer can do.
        guarded = covered(guarded) if name in BUDGETED else dataclasses.replace(guarded, pursuer_model=None)
        return AdaptedShield(scenario, make_shield(name, guarded, budget))
    if budget is None:
        return SHIELDS[name](scenario)
    if name not in BUDGETED:
        raise ValueError(f"the shield {name!r} keeps no budget; use 'game' or 'joint'")
    budget.announce(scenario)
    return BUDGETED[name](scenario, budget=budget)


def as_shield(shield: str | Shield | Barrier, scenario: Scenario) -> Shield:
    """`shield` itself, the one of that name for `scenario`, or the one that keeps a barrier of one's own."""
    if isinstance(shield, Barrier):
        return shield_of(shield, scenario)
    return make_shield(shield, scenario) if isinstance(shield, str) else shield
