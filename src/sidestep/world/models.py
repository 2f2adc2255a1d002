"""Robots that a user brings: how an evader or a pursuer moves that is not one of the built-in ones."""

from __future__ import annotations

import abc
from typing import Any

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float, PRNGKeyArray

from sidestep._arrays import Scalar, real
from sidestep.world.state import World


class EvaderState(eqx.Module):
    """One evader: `position (2,)` in m, `velocity (2,)` in m/s, and whatever else its model keeps."""

    position: Float[Array, "2 *lanes"]
    velocity: Float[Array, "2 *lanes"]
    state: Float[Array, "s *lanes"]


class EvaderModel(eqx.Module):
    """How an evader moves that does not take the velocity it is told at once, as `Scenario.evader_model`.

    Shields speak of a point that does: the *control point*. A robot with mass or wheels has one, too, a
    little beside it. Whoever brings a robot says where that point is, and how far it may be from the robot's
    position; every shield then guards the point, and keeps so much more. Where the point moves as it is
    told, what is guaranteed for an omnidirectional evader is guaranteed for this robot. `probe_evader`
    measures whether it does.

    Functions see one robot, no batch, and the `Scenario` that it is in. Numbers may be fields; as JAX arrays
    they are traced, as plain ones another value compiles anew.
    """

    def start(self, scenario: Any, key: PRNGKeyArray) -> Float[Array, "s"]:
        """What the model keeps beside position and velocity, at the start of an episode: nothing."""
        return jnp.zeros(0, dtype=float)

    @abc.abstractmethod
    def after(
        self, scenario: Any, robot: EvaderState, command: Float[Array, "2"], time: Scalar
    ) -> EvaderState:
        """The robot `time` (s) later, told the velocity `command` (m/s, world axes, |u| <= v_e) meanwhile."""

    def control_point(self, scenario: Any, robot: EvaderState) -> Float[Array, "2"]:
        """The point (m) that moves as told: p' = u. The robot's position, unless a model says otherwise."""
        return robot.position

    def offset(self, scenario: Any) -> Scalar:
        """How far (m) the control point can be from the robot's position, at most."""
        return real(0.0)

    def mirrored(self, state: Float[Array, "s"]) -> Float[Array, "s"] | None:
        """What the model keeps, of a robot reflected in the world's x axis. None, unless a model says
        otherwise: training then learns from no mirror images."""
        return None


class PursuerModel(eqx.Module):
    """What a pursuer can do that is no differential drive, as `Scenario.pursuer_model`.

    It moves along its heading with a speed v (m/s) and a turn rate omega (rad/s); the model says which pairs
    it can take. Strategies answer in wheel speeds all the same, v -+ b omega with the scenario's half axle b
    (`sidestep.world.robots.wheels_from_body`), so that every strategy can be tried on every pursuer.

    Numbers may be fields, as in `EvaderModel`.
    """

    @abc.abstractmethod
    def limit(self, scenario: Any, speed: Scalar, turn_rate: Scalar) -> tuple[Scalar, Scalar]:
        """The pair (m/s, rad/s) that is driven when this one is asked for; finite for finite numbers."""

    @abc.abstractmethod
    def corners(self, scenario: Any) -> Float[Array, "n 2"]:
        """Pairs (m/s, rad/s) whose convex hull holds all that it can take."""

    def covering(self, scenario: Any) -> tuple[Scalar, Scalar] | None:
        """Rim speed V (m/s) and half axle b (m) of a differential drive that can do all this pursuer can,
        |v| + b |omega| <= V: what the shields then guard against. None if there is none."""
        return None


def evader_of(world: World) -> EvaderState:
    """The evader of a world whose scenario has an `EvaderModel`.

    **Raises** `ValueError` for a world that was made without one.
    """
    if world.evader_state is None:
        raise ValueError(
            "this scenario's evader has a model of its own, and the world holds no state of it: take worlds "
            "from scenario.reset, or make them with evader_state=scenario.evader_model.start(scenario, key)"
        )
    return EvaderState(world.evader, world.evader_velocity, world.evader_state)
