"""One flight, with the decision core that a robot runs."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, final

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from sidestep.learning import load_policy
from sidestep.loop.policies import GOAL_SEEKING, as_policy
from sidestep.loop.step import decide, decision_steps_of
from sidestep.plants.air.flight import Flight
from sidestep.plants.air.options import FlightOptions, budget_of, check_scenario, errors_of
from sidestep.plants.play import Robot, play, see
from sidestep.plants.record import PlantEpisode
from sidestep.robot import Decision, Onboard, OnboardSettings
from sidestep.safety import PURSUIT_SHIELDS, Certificate, Shield, as_shield, certify, make_shield
from sidestep.safety.certificate import start_margin
from sidestep.world import Scenario, World
from sidestep.world.capture_geometry import to_pursuer_frame


@dataclass(frozen=True)
class FlightEpisode(PlantEpisode):
    """One flight. `tracking_errors` (m) are the quadrotor's largest distances from its reference motion.

    - `start_margin` m, see `sidestep.safety.start_margin`; None without a certificate
    - `saturated` s, time with tilt or rotors at their limits
    - `frames` at 100 Hz: MuJoCo's positions, and positions and quaternions of the other bodies
    """

    options: FlightOptions
    start_margin: float | None
    saturated: float

    @property
    def within_assumptions(self) -> bool:
        """Whether the certificate's assumptions held: a start that it covers, no tracking error above the
        assumed bound, no fault reported by the decision core."""
        return (
            (self.start_margin or 0.0) >= 0.0
            and float(np.max(self.tracking_errors)) <= self.options.tracking_error
            and all(level == "normal" for level in self.levels)
        )

    def plant(self) -> Flight:
        """A new plant like the one flown."""
        return Flight(self.scenario, self.options, self.seed)

    def to_dict(self) -> dict[str, Any]:
        """As `PlantEpisode.to_dict`, with the certificate's assumptions."""
        return super().to_dict() | {
            "tracking_error_max": float(np.max(self.tracking_errors)),
            "within_assumptions": self.within_assumptions,
            "start_margin": self.start_margin,
            "saturated": self.saturated,
        }


@final
class Pilot(Robot):
    """Decides for the quadrotor: filters the policy's nominal action by a shield of its control point.

    The shield takes the quadrotor's state from the autopilot's reference motion, and the other robots' from
    measured poses, estimated by the decision core (`sidestep.robot.Onboard`). Compiled once, a `Pilot` serves
    any number of flights. **Attributes:** `shield`, an `AdaptedShield`; `onboard`.

    **Arguments:** `policy` `goal-seeking`, a run folder or any policy; `shield` a name, or an
    `AdaptedShield` with a budget, as `sidestep.safety.make_shield` returns it for this scenario.

    **Raises** `ValueError` as `make_shield`, `TwinError` for a scenario without a quadrotor.
    """

    def __init__(
        self,
        scenario: Scenario,
        policy: Any = GOAL_SEEKING,
        shield: str | Shield = "joint",
        options: FlightOptions | None = None,
    ):
        self.scenario, self.options = scenario, options or FlightOptions()
        check_scenario(scenario, self.options)
        if isinstance(shield, str):
            budget = budget_of(self.options) if shield in PURSUIT_SHIELDS else None
            shield = make_shield(shield, scenario, budget)
        adapted = as_shield(shield, scenario)
        inner = adapted.unadapted
        if inner is adapted:
            raise ValueError(
                f"shield = {type(adapted).__name__}: a quadrotor needs a shield of its control point; "
                "take it from make_shield(name, scenario, budget) or shield_of(barrier, scenario)"
            )
        self.shield, sensors = adapted, self.options.sensors
        settings = OnboardSettings(
            budget=budget_of(self.options),
            position_noise=sensors.position_noise,
            heading_noise=sensors.heading_noise,
        )
        self.onboard = Onboard(inner.scenario, inner, None, settings)
        if isinstance(policy, str) and policy != GOAL_SEEKING:
            policy = load_policy(policy)
        chosen = as_policy(policy, scenario)
        self._every = decision_steps_of(chosen)
        self._decide = eqx.filter_jit(lambda world: decide(scenario, chosen, world))
        self.reset()

    def reset(self) -> None:
        self.onboard.reset()
        self._count, self._nominal = 0, np.zeros(2)

    def decide(self, plant: Flight) -> Decision:
        now = plant.time
        see(self.onboard, plant)
        self.onboard.see("evader", now, (*plant.control_point, 0.0), now=now)
        seen = self.onboard.world(now)
        if seen is not None and self._count % self._every == 0:
            self._nominal = np.asarray(self._decide(self._known(plant, seen)), float)
        self._count += 1
        self.onboard.nominal(now, self._nominal)
        return self.onboard.decide(now)

    def _known(self, flight: Flight, seen: World) -> World:
        """The world for the policy: the quadrotor's reference motion, and the other robots as estimated."""
        position, velocity, acceleration = (jnp.asarray(part, float) for part in flight.reference)
        return World(
            evader=position,
            pursuers=jnp.asarray(seen.pursuers, float),
            obstacles=jnp.asarray(seen.obstacles, float),
            target=jnp.asarray(flight.world.target, float),
            time=jnp.asarray(flight.time, float),
            evader_velocity=velocity,
            wheel_speeds=jnp.asarray(seen.wheel_speeds, float),
            evader_state=acceleration,
        )


def certificate_of(scenario: Scenario, options: FlightOptions, **arguments: Any) -> Certificate:
    """The certificate of the quadrotor with the errors of these options.

    It is that of the control point, with distances increased by the model's offset, against the differential
    drive that covers the aircraft (`Aircraft.covering`). `arguments` go to `sidestep.safety.certify`.
    """
    check_scenario(scenario, options)
    return certify(scenario, **errors_of(options), **arguments)


def fly(
    pilot: Pilot,
    pursuer: str | Callable[..., Any] = "chauffeur",
    seed: int = 0,
    steps: int | None = None,
    *,
    world: World | None = None,
    certificate: Certificate | None = None,
) -> FlightEpisode:
    """One flight, see `sidestep.plants.play`.

    **Arguments:** `pilot`, which is reset; `certificate` from `certificate_of`, to compute `start_margin`;
    the rest as for `play`.

    **Raises** as `play`, and `TwinError` when MuJoCo is missing or the flight goes out of control.
    """
    options = pilot.options
    flight = Flight(pilot.scenario, options, seed)
    played = play(flight, pilot, pursuer, seed, steps, world=world, pursuer_sees=options.pursuer_sees)
    start = jax.tree.map(lambda leaf: leaf[0], played.trajectory.worlds)
    margin = None if certificate is None else _margin(certificate, start)
    return FlightEpisode(**vars(played), options=options, start_margin=margin, saturated=flight.saturated)


def _margin(certificate: Certificate, world: World) -> float:
    """The smallest start margin (m) over the pursuers; -inf if the certificate guarantees nothing."""
    if not certificate.guaranteed:
        return -np.inf
    seen = [np.asarray(to_pursuer_frame(world.evader, pose), float) for pose in np.asarray(world.pursuers)]
    return min(start_margin(certificate, (float(x), float(y))) for x, y in seen)
