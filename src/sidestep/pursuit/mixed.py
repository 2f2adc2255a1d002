"""A pursuer that changes its strategy during a chase, for trainings."""

from __future__ import annotations

from typing import final

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PRNGKeyArray, UInt

from sidestep._arrays import Lanes, Scalar, real, stack
from sidestep.pursuit.pursuers import (
    Interceptor,
    Nash,
    PurePursuit,
    Pursuer,
    Still,
    TurnThenDrive,
    TurnWhileDriving,
)
from sidestep.world.scenario import Scenario
from sidestep.world.state import World

_STEP = np.uint32(0x9E3779B9)
"""Between words to be hashed one after another: 2^32 divided by the golden ratio."""


@final
class _Erratic(Pursuer):
    """`Random` in lanes: wheel speeds from hash values of target and time, anew in each control period."""

    takes_lanes = True
    always_finite = True

    def steer(self, scenario: Scenario, world: World, key: PRNGKeyArray) -> Float[Array, "2 *lanes"]:
        left = _hashed(_episode(world) ^ _bits(world.time))
        drawn = stack(_share(left), _share(_hashed(left + _STEP)))
        return scenario.pursuer_speed * (2.0 * drawn - 1.0)


def _strategies() -> tuple[Pursuer, ...]:
    return (Nash(), TurnThenDrive(), TurnWhileDriving(), PurePursuit(), Interceptor(), _Erratic(), Still())


@final
class Mixed(Pursuer):
    """One strategy after another, each at its own effort and agility, so that a policy cannot rely on one.

    For every stretch of `hold` seconds it draws a strategy of `strategies`; an effort, the share of the wheel
    limits that it uses, from `least_effort` to 1; and an agility, by which it moves its wheel speeds towards
    those of the strategy in one control period, from `least_agility` to 1. A share `full` of the stretches
    has effort 1, and one agility 1; by default all have. Stretches begin at an offset of the episode's own.

    The strategies are all the built-in ones. A strategy keeps no state, so the draws are hash values of the
    target, which is constant in an episode, and of the stretch: episodes with equal targets get equal
    sequences. With one strategy, effort and agility 1 it is that strategy.
    """

    strategies: tuple[Pursuer, ...] = eqx.field(default_factory=_strategies)
    hold: Scalar = eqx.field(converter=real, default=20.0)
    full: Scalar = eqx.field(converter=real, default=1.0)
    least_effort: Scalar = eqx.field(converter=real, default=0.5)
    least_agility: Scalar = eqx.field(converter=real, default=0.2)

    takes_lanes = True
    always_finite = True

    def steer(self, scenario: Scenario, world: World, key: PRNGKeyArray) -> Float[Array, "2 *lanes"]:
        """Wheel rim speeds (left, right; m/s). **Raises** `ValueError` for a strategy without lanes."""
        for strategy in self.strategies:
            if not strategy.takes_lanes:
                raise ValueError(f"a mixture takes strategies with takes_lanes, not {strategy!r}")
        episode = _episode(world)
        stretch = jnp.floor(world.time / self.hold + _share(_hashed(episode))).astype(jnp.uint32)
        seed = _hashed(episode + stretch * _STEP)
        drawn = []
        for _ in range(5):
            seed = _hashed(seed + _STEP)
            drawn.append(_share(seed))
        number = jnp.floor(drawn[0] * len(self.strategies)).astype(jnp.int32)

        def share(number: int, least: Scalar) -> Lanes:
            return jnp.where(drawn[number] < self.full, 1.0, least + (1.0 - least) * drawn[number + 1])

        effort, agility = share(1, self.least_effort), share(3, self.least_agility)
        wheels = jnp.zeros_like(world.pursuer[:2])
        for index, strategy in enumerate(self.strategies):
            chosen = number == index
            answer = strategy(scenario, world, key)
            wheels = stack(*(jnp.where(chosen, new, old) for new, old in zip(answer, wheels, strict=True)))
        return stack(
            *(
                (1.0 - agility) * before + agility * effort * wheel
                for before, wheel in zip(world.wheel_speeds[0], wheels, strict=True)
            )
        )


def _episode(world: World) -> UInt[Array, "*lanes"]:
    """A word of the episode's own."""
    return _hashed(_bits(world.target[0]) ^ _hashed(_bits(world.target[1])))


def _bits(number: Float[Array, "*lanes"]) -> UInt[Array, "*lanes"]:
    return jax.lax.bitcast_convert_type(number.astype(jnp.float32), jnp.uint32)


def _hashed(word: UInt[Array, "*lanes"]) -> UInt[Array, "*lanes"]:
    """The finaliser of MurmurHash3 (Appleby), a bijection of 32 bits."""
    word = (word ^ (word >> 16)) * jnp.uint32(0x85EBCA6B)
    word = (word ^ (word >> 13)) * jnp.uint32(0xC2B2AE35)
    return word ^ (word >> 16)


def _share(word: UInt[Array, "*lanes"]) -> Float[Array, "*lanes"]:
    """A word as a number in [0, 1)."""
    return real(word >> 8) / 2.0**24
