"""Interfaces for custom robots: the motion of an evader or a pursuer."""

from __future__ import annotations

import abc
from typing import Any

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float, PRNGKeyArray

from sidestep._arrays import Scalar, real
from sidestep.world.state import World


class EvaderState(eqx.Module):
    """One evader: `position (2,)` in m, `velocity (2,)` in m/s, and the further `state (s,)` of its model."""

    position: Float[Array, "2 *lanes"]
    velocity: Float[Array, "2 *lanes"]
    state: Float[Array, "s *lanes"]


class EvaderModel(eqx.Module):
    """The motion of an evader that does not take the commanded velocity at once; for `Scenario.evader_model`.

    Shields need a point that does: the *control point*. A robot with mass or wheels has one near its
    position. The model defines that point, and a bound of its distance from the robot's position. Every
    shield then protects the control point, with distances increased by the bound. If the point moves as
    commanded, the guarantees for an omnidirectional evader hold for this robot. `probe_evader` measures
    whether it does.

    Functions get one robot, no batch, and the `Scenario`. Numbers may be fields: JAX arrays are traced;
    another value of a Python number recompiles.
    """

    def start(self, scenario: Any, key: PRNGKeyArray) -> Float[Array, "s"]:
        """The model's state, besides position and velocity, at the start of an episode. By default empty."""
        return jnp.zeros(0, dtype=float)

    @abc.abstractmethod
    def after(
        self, scenario: Any, robot: EvaderState, command: Float[Array, "2"], time: Scalar
    ) -> EvaderState:
        """The robot after `time` (s) with the constant command `command` (m/s, world axes, |u| <= v_e)."""

    def control_point(self, scenario: Any, robot: EvaderState) -> Float[Array, "2"]:
        """The point (m) that moves as commanded: p' = u. By default the robot's position."""
        return robot.position

    def offset(self, scenario: Any) -> Scalar:
        """The largest distance (m) of the control point from the robot's position."""
        return real(0.0)

    def mirrored(self, state: Float[Array, "s"]) -> Float[Array, "s"] | None:
        """The model's state for the robot reflected at the world's x axis. By default None: training then
        uses no mirror images."""
        return None


class PursuerModel(eqx.Module):
    """The limits of a pursuer that is not a differential drive; for `Scenario.pursuer_model`.

    It moves along its heading with a speed v (m/s) and a turn rate omega (rad/s); the model defines the
    possible pairs. Strategies still return wheel speeds, v -+ b omega with the scenario's half axle b
    (`sidestep.world.robots.wheels_from_body`), so that every strategy works with every pursuer.

    Numbers may be fields, as in `EvaderModel`.
    """

    @abc.abstractmethod
    def limit(self, scenario: Any, speed: Scalar, turn_rate: Scalar) -> tuple[Scalar, Scalar]:
        """The pair (m/s, rad/s) that is driven for a commanded pair; finite for finite numbers."""

    @abc.abstractmethod
    def corners(self, scenario: Any) -> Float[Array, "n 2"]:
        """Pairs (m/s, rad/s) whose convex hull contains all possible pairs."""

    def covering(self, scenario: Any) -> tuple[Scalar, Scalar] | None:
        """Rim speed V (m/s) and half axle b (m) of a differential drive that covers this pursuer: all
        possible pairs satisfy |v| + b |omega| <= V. Shields then assume that drive. None if there is none."""
        return None


def evader_of(world: World) -> EvaderState:
    """The evader of a world whose scenario has an `EvaderModel`.

    **Raises** `ValueError` for a world without its state.
    """
    if world.evader_state is None:
        raise ValueError(
            "this scenario's evader has a custom model, and the world has no state of it: take worlds "
            "from scenario.reset, or make them with evader_state=scenario.evader_model.start(scenario, key)"
        )
    return EvaderState(world.evader, world.evader_velocity, world.evader_state)
