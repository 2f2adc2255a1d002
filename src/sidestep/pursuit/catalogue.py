"""The built-in strategies by name."""

from sidestep.pursuit.chauffeur import Chauffeur
from sidestep.pursuit.pursuers import (
    Interceptor,
    Nash,
    PurePursuit,
    Pursuer,
    Random,
    Still,
    TurnThenDrive,
    TurnWhileDriving,
)

PURSUERS: dict[str, type[Pursuer]] = {
    "nash": Nash,
    "turn-then-drive": TurnThenDrive,
    "turn-while-driving": TurnWhileDriving,
    "pure-pursuit": PurePursuit,
    "interceptor": Interceptor,
    "random": Random,
    "still": Still,
}
"""Strategies for a differential drive."""
CHAUFFEURS: dict[str, type[Pursuer]] = {"chauffeur": Chauffeur}
"""Strategies for robots that cannot turn on the spot; a differential drive can use them, too."""


def make_pursuer(name: str) -> Pursuer:
    """The strategy `name` of `PURSUERS` or `CHAUFFEURS`. **Raises** `ValueError` for an unknown name."""
    known = PURSUERS | CHAUFFEURS
    if name not in known:
        raise ValueError(f"unknown pursuer {name!r}; known pursuers: {', '.join(known)}")
    return known[name]()
