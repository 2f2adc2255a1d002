"""Every shield by name."""

from sidestep.safety.budget import Budget
from sidestep.safety.joint import JointShield
from sidestep.safety.shields import GameShield, NoShield, PaperShield, Shield
from sidestep.world.scenario import Scenario

SHIELDS: dict[str, type[Shield]] = {
    "none": NoShield,
    "paper": PaperShield,
    "game": GameShield,
    "joint": JointShield,
}
"""Every shield by name."""
_BUDGETED: dict[str, type[GameShield] | type[JointShield]] = {"game": GameShield, "joint": JointShield}


def make_shield(name: str, scenario: Scenario, budget: Budget | None = None) -> Shield:
    """The shield `name` (a key of `SHIELDS`) for a scenario; `budget` for `game` and `joint` only.

    **Raises** `ValueError` naming the known shields, or what is wrong with the budget. **Warns**
    `BudgetWarning` once where the budget is more than the game leaves.
    """
    if name not in SHIELDS:
        raise ValueError(f"no shield {name!r}; use one of {', '.join(map(repr, SHIELDS))}")
    if budget is None:
        return SHIELDS[name](scenario)
    if name not in _BUDGETED:
        raise ValueError(f"the shield {name!r} keeps no budget; use 'game' or 'joint'")
    budget.announce(scenario)
    return _BUDGETED[name](scenario, budget=budget)


def as_shield(shield: str | Shield, scenario: Scenario) -> Shield:
    """`shield` itself, or the one of that name for `scenario`."""
    return make_shield(shield, scenario) if isinstance(shield, str) else shield
