"""Every strategy by the name the command line knows it by."""

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
"""Strategies of a differential drive."""
CHAUFFEURS: dict[str, type[Pursuer]] = {"chauffeur": Chauffeur}
"""Strategies for what cannot turn on the spot, whatever it is; a differential drive can play them, too."""


def make_pursuer(name: str) -> Pursuer:
    """The strategy called `name`, of `PURSUERS` or `CHAUFFEURS`; a ValueError lists the names there are."""
    known = PURSUERS | CHAUFFEURS
    if name not in known:
        raise ValueError(f"unknown pursuer {name!r}; known pursuers: {', '.join(known)}")
    return known[name]()
