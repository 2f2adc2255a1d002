"""Every shield by name."""

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


def make_shield(name: str, scenario: Scenario) -> Shield:
    """The shield `name` (a key of `SHIELDS`) for a scenario.

    **Raises** `ValueError` naming the known shields.
    """
    if name not in SHIELDS:
        raise ValueError(f"no shield {name!r}; use one of {', '.join(map(repr, SHIELDS))}")
    return SHIELDS[name](scenario)


def as_shield(shield: str | Shield, scenario: Scenario) -> Shield:
    """`shield` itself, or the one of that name for `scenario`."""
    return make_shield(shield, scenario) if isinstance(shield, str) else shield
