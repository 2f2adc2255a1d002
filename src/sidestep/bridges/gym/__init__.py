"""Gymnasium environments and wrappers, and a PettingZoo environment in which the pursuer learns too.

Importing this registers `sidestep/Pursued-v0` with Gymnasium, and
`gymnasium.make("sidestep.bridges.gym:sidestep/Pursued-v0")` imports it. The PettingZoo environment is in
`sidestep.bridges.gym.duel`. All need the extra `gym`.
"""

from sidestep._packages import needed

gymnasium = needed("gymnasium", "gym", "the Gymnasium environments need")

from sidestep.bridges.gym.environment import PursuedEnv  # noqa: E402
from sidestep.bridges.gym.vector import PursuedVectorEnv  # noqa: E402
from sidestep.bridges.gym.wrappers import (  # noqa: E402
    SafetyGymnasiumWrapper,
    ShieldVectorWrapper,
    ShieldWrapper,
)

ID = "sidestep/Pursued-v0"

if ID not in gymnasium.registry:
    gymnasium.register(
        ID,
        entry_point="sidestep.bridges.gym.environment:PursuedEnv",
        vector_entry_point="sidestep.bridges.gym.vector:PursuedVectorEnv",
    )

__all__ = [
    "ID",
    "PursuedEnv",
    "PursuedVectorEnv",
    "SafetyGymnasiumWrapper",
    "ShieldVectorWrapper",
    "ShieldWrapper",
]
