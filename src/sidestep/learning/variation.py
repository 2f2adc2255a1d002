"""Other robots and other numbers of obstacles in every episode of a training."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PRNGKeyArray

from sidestep._arrays import Scalar, lane_by_lane, real
from sidestep._bounds import allowed, did_you_mean, taken
from sidestep.pursuit import CaptureGame
from sidestep.safety import GameShield, JointShield, NoShield, PaperShield
from sidestep.world import Scenario, World

_SCALARS = ("evader_speed", "pursuer_speed", "pursuer_half_axle", "capture_distance", "collision_distance")
_DRIFT, _OBSTACLES = "obstacle_velocity", "obstacle_count"
VARIED = (*_SCALARS, _DRIFT, _OBSTACLES)
"""Scenario fields that can vary; of `obstacle_velocity` the magnitude (m/s)."""
_SERVED = (NoShield, PaperShield, GameShield, JointShield)
_MOST = 0.996
"""Share of l_max to which a drawn capture distance is cut: that of the paper's robots."""
_AWAY = 1000.0
"""Where obstacles are put (m) that an episode does not have."""


class Variation(eqx.Module):
    """Ranges of scenario fields, from which each episode draws, uniformly and independently.

    A capture distance beyond 0.996 l_max of the drawn robots is cut to that: the evader can then stay free.
    The scenario's `obstacle_count` must be the most that can be drawn.
    """

    names: tuple[str, ...] = eqx.field(static=True, default=())
    low: tuple[float, ...] = eqx.field(static=True, default=())
    high: tuple[float, ...] = eqx.field(static=True, default=())

    @staticmethod
    def of(ranges: Mapping[str, Any], scenario: Scenario, shield: Any) -> tuple[Variation, Scenario, Any]:
        """The variation by field name, as `{"evader_speed": [0.12, 0.19], "obstacle_count": [0, 5]}`; and
        scenario and shield with as many obstacles as can be drawn.

        **Raises** `ValueError` for other fields and impossible ranges, and for a shield that is made for one
        scenario only.
        """
        rules = allowed(Scenario)
        for name, ends in ranges.items():
            if name not in VARIED:
                raise ValueError(f"{name} cannot vary{did_you_mean(name, VARIED)}; use {', '.join(VARIED)}")
            if np.shape(ends) != (2,) or not ends[0] <= ends[1]:
                raise ValueError(f"{name} = {ends!r}: a range is two numbers, the least and the most")
            for end in ends:
                value = [float(end), 0.0] if name == _DRIFT else end
                taken(f"the range of {name}", value, rules[name])
        if ranges:
            scenario.check_built_in("a training with varied robots", "vary the models in your own training")
        if ranges and not isinstance(shield, _SERVED):
            raise ValueError(
                f"{type(shield).__name__} is made for one scenario, so robots cannot vary behind it; use "
                "none, paper, game or joint:look-ahead"
            )
        if _OBSTACLES in ranges:
            most = int(ranges[_OBSTACLES][1])
            if scenario.obstacle_starts is not None:
                raise ValueError("obstacle_count cannot vary where obstacle_starts are fixed")
            scenario = dataclasses.replace(scenario, obstacle_count=most)
            shield = dataclasses.replace(shield, scenario=scenario)
        low, high = (tuple(float(ends[i]) for ends in ranges.values()) for i in range(2))
        return Variation(tuple(ranges), low, high), scenario, shield

    def draw(self, key: PRNGKeyArray) -> Float[Array, "n"]:
        """The values of an episode."""
        low, high = real(np.array(self.low)), real(np.array(self.high))
        share = jax.random.uniform(key, low.shape, dtype=float)
        whole = np.array([name == _OBSTACLES for name in self.names], bool)
        steps = jnp.minimum(jnp.floor(low + share * (high - low + 1.0)), high)
        return jnp.where(whole, steps, low + share * (high - low))

    def scenario(self, scenario: Scenario, values: Float[Array, "n"]) -> Scenario:
        """The scenario of an episode."""
        if not self.names:
            return scenario
        drawn = dict(zip(self.names, values, strict=True))
        for name in _SCALARS:
            if name in drawn:
                scenario = eqx.tree_at(lambda s, name=name: getattr(s, name), scenario, drawn[name])
        if _DRIFT in drawn:
            drift = _along(scenario.obstacle_velocity, drawn[_DRIFT])
            scenario = eqx.tree_at(lambda s: s.obstacle_velocity, scenario, drift)
        most = _MOST * CaptureGame.of(scenario).largest_capture_distance
        level = jnp.minimum(scenario.capture_distance, most)
        return eqx.tree_at(lambda s: s.capture_distance, scenario, level)

    def shield(self, shield: Any, scenario: Scenario) -> Any:
        """The shield for the scenario of an episode."""
        return shield if not self.names else eqx.tree_at(lambda shield: shield.scenario, shield, scenario)

    def start(self, scenario: Scenario, values: Float[Array, "n"], key: PRNGKeyArray) -> World:
        """The start of an episode with these values, and with as many obstacles as they say."""
        world = self.scenario(scenario, values).reset(key)
        if _OBSTACLES not in self.names:
            return world
        there = real(np.arange(scenario.obstacle_count)) < values[self.names.index(_OBSTACLES)]
        away = jnp.array([_AWAY, 0.0, 0.0, 0.0], world.obstacles.dtype)
        return eqx.tree_at(lambda w: w.obstacles, world, jnp.where(there[:, None], world.obstacles, away))

    def inside(
        self,
        function: Callable[..., Any],
        scenario: Scenario,
        shield: Any,
        values: Float[Array, "n *lanes"],
        *arguments: Any,
    ) -> Any:
        """`function(scenario, shield, *arguments)`; where robots vary, in each lane with those of its own.

        The lanes of `arguments` are last, and where robots vary the function gets single worlds.
        """
        if not self.names:
            return function(scenario, shield, *arguments)

        def one(values: Float[Array, "n"], *arguments: Any) -> Any:
            mine = self.scenario(scenario, values)
            return function(mine, self.shield(shield, mine), *arguments)

        return lane_by_lane(one, values.ndim - 1, values, *arguments)


def _along(vector: Float[Array, "2"], size: Scalar) -> Float[Array, "2"]:
    """A vector of this size in the same direction, along x where there is none."""
    before = jnp.sqrt(jnp.sum(vector**2))
    unit = jnp.where(before > 0.0, vector / jnp.where(before > 0.0, before, 1.0), jnp.array([1.0, 0.0]))
    return size * unit


FIXED = Variation()
"""The same robots in every episode."""
