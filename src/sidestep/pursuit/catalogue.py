"""The built-in strategies by name."""

from sidestep.pursuit.chauffeur import Chauffeur
from sidestep.pursuit.mixed import Mixed
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
MIXTURES: dict[str, type[Pursuer]] = {"mixed": Mixed}
"""Strategies made of others, for trainings."""


def make_pursuer(name: str) -> Pursuer:
    """The strategy `name` of `PURSUERS`, `CHAUFFEURS` or `MIXTURES`.

    **Raises** `ValueError` for an unknown name.
    """
    known = PURSUERS | CHAUFFEURS | MIXTURES
    if name not in known:
        raise ValueError(f"unknown pursuer {name!r}; known pursuers: {', '.join(known)}")
    return known[name]()
