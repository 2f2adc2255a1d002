"""What happens in one flight, with the very decision core that a robot runs?"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, final

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from sidestep import _interrupts
from sidestep._arrays import seed_number
from sidestep.learning import load_policy
from sidestep.loop.policies import GOAL_SEEKING, as_policy
from sidestep.loop.step import decide, decision_steps_of
from sidestep.plants.air.flight import Flight
from sidestep.plants.air.options import FlightOptions, budget_of, check_scenario, errors_of
from sidestep.plants.record import (
    Log,
    PhysicsEpisode,
    estimate_error,
    events_of,
    periods_of,
    start_of,
    steered,
)
from sidestep.pursuit import as_pursuer
from sidestep.robot import Onboard, OnboardSettings
from sidestep.safety import AdaptedShield, Certificate, Shield, as_shield, certify, make_shield
from sidestep.safety.certificate.certificate import start_margin
from sidestep.safety.shields.catalogue import BUDGETED
from sidestep.store.runs import OUTCOMES
from sidestep.world import Scenario, World
from sidestep.world.capture_geometry import to_pursuer_frame


@dataclass(frozen=True)
class FlightEpisode(PhysicsEpisode):
    """One flight; `tracking_errors` are in m, how far the quadrotor was at most from the motion asked of it.

    - `start_margin` m: how far outside the certificate's start set the flight began; None without a
      certificate
    - `saturated` s, for how long tilt or rotors were at their limits
    - `frames` (positions, and places and quaternions of the other bodies) and `frame_times` at 100 Hz
    """

    options: FlightOptions
    start_margin: float | None
    saturated: float
    frames: list[Any]
    frame_times: Float[np.ndarray, "n"]

    @property
    def within_assumptions(self) -> bool:
        """Whether all went as the certificate takes it to: a start outside its start set, no tracking error
        above the one allowed for, no fault met by the decision core."""
        return (
            (self.start_margin or 0.0) >= 0.0
            and float(np.max(self.tracking_errors)) <= self.options.tracking_error
            and all(level == "normal" for level in self.levels)
        )

    def to_dict(self) -> dict[str, Any]:
        """As that of `PhysicsEpisode`, and what the certificate assumes."""
        return super().to_dict() | {
            "tracking_error_max": float(np.max(self.tracking_errors)),
            "within_assumptions": self.within_assumptions,
            "start_margin": self.start_margin,
            "saturated": self.saturated,
        }


@final
class Pilot:
    """Decides for the quadrotor: a policy's wish, through a shield that guards its control point.

    The shield knows the quadrotor by the motion that its autopilot is asked for, and everybody else by
    measured poses, which go through the decision core that robots run (`sidestep.robot.Onboard`).
    Compiled once, it serves any number of flights. **Attributes:** `shield`, an `AdaptedShield`; `onboard`.

    **Arguments:** `policy` `goal-seeking`, a run folder or any policy; `shield` a name, or an
    `AdaptedShield` of this scenario, as `sidestep.safety.make_shield` gives it, with a budget of its own.

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
            budget = budget_of(self.options) if shield in BUDGETED else None
            shield = make_shield(shield, scenario, budget)
        adapted = as_shield(shield, scenario)
        if not isinstance(adapted, AdaptedShield):
            raise ValueError(
                f"shield = {type(adapted).__name__}: a quadrotor needs one that guards its control point; "
                "take it from make_shield(name, scenario, budget) or shield_of(barrier, scenario)"
            )
        self.shield, sensors = adapted, self.options.sensors
        settings = OnboardSettings(
            budget=budget_of(self.options),
            position_noise=sensors.position_noise,
            heading_noise=sensors.heading_noise,
        )
        self.onboard = Onboard(adapted.inner.scenario, adapted.inner, None, settings)
        if isinstance(policy, str) and policy != GOAL_SEEKING:
            policy = load_policy(policy)
        chosen = as_policy(policy, scenario)
        self._every = decision_steps_of(chosen)
        self._decide = eqx.filter_jit(lambda world: decide(scenario, chosen, world))
        self.reset()

    def reset(self) -> None:
        """Forget the flight before."""
        self.onboard.reset()
        self._count, self._wish = 0, np.zeros(2)

    def decide(self, flight: Flight) -> Any:
        """The decision for the period that begins now, from what has been measured by now."""
        now = flight.time
        for robot, index, stamp, pose in flight.measurements():
            self.onboard.see(robot, stamp, pose if robot != "obstacle" else pose[:2], index)
        self.onboard.see("evader", now, (*flight.control_point, 0.0), now=now)
        seen = self.onboard.world(now)
        if seen is not None and self._count % self._every == 0:
            self._wish = np.asarray(self._decide(self._known(flight, seen)), float)
        self._count += 1
        self.onboard.nominal(now, self._wish)
        return self.onboard.decide(now)

    def _known(self, flight: Flight, seen: World) -> World:
        """What the policy is shown: the quadrotor as it is asked to move, the others as estimated."""
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


def certificate_of(scenario: Scenario, options: FlightOptions, **told: Any) -> Certificate:
    """What is guaranteed of the quadrotor's control point, and so of the quadrotor, with these errors.

    Of the point, at distances that are the model's offset longer, against the differential drive that covers
    the aircraft (`Aircraft.covering`). `told` goes to `sidestep.safety.certify`.
    """
    check_scenario(scenario, options)
    return certify(scenario, **errors_of(options), **told)


def fly(
    pilot: Pilot,
    pursuer: str | Callable[..., Any] = "chauffeur",
    seed: int = 0,
    steps: int | None = None,
    *,
    world: World | None = None,
    certificate: Certificate | None = None,
) -> FlightEpisode:
    """One flight: measurements, the pilot's command and the pursuers', physics, once per period.

    Start, measurements and random pursuers follow from `seed`; the start is that of `rollout` with this seed.

    **Arguments:** `pilot`, which is reset; `pursuer` as for `evaluate`; `steps` at most this many control
    periods (the scenario's `episode_steps` if not given); `world` to start in; `certificate` as
    `certificate_of` gives it, to say whether the flight began where it holds.

    **Raises** `ValueError` as `evaluate`, and `TwinError` when MuJoCo is missing or the flight goes out of
    control.
    """
    scenario, options = pilot.scenario, pilot.options
    limit = periods_of(scenario, steps)
    strategy = as_pursuer(pursuer)
    seed_number(seed)
    flight = Flight(scenario, options, seed)
    drawn, key = start_of(scenario, jnp.asarray(seed, jnp.uint32))
    flight.reset(drawn if world is None else world)
    pilot.reset()
    truth = flight.world
    margin = None if certificate is None else _margin(certificate, truth)
    period = float(scenario.control_period)
    log = Log(truth)
    for count in range(limit):
        _interrupts.check()
        now = flight.time
        decision = pilot.decide(flight)
        estimate = pilot.onboard.world(now) if options.pursuer_sees == "measurements" else None
        seen = truth if estimate is None else estimate
        wheels = np.asarray(steered(scenario, strategy, seen, key, jnp.asarray(count, jnp.uint32)))
        flight.command(decision.velocity, wheels)
        contacts = flight.advance((count + 1) * period - now)
        before, truth = truth, flight.world
        events = events_of(scenario, truth, contacts, count + 1 >= scenario.episode_steps)
        log.add(now, decision, wheels, truth, events, estimate_error(decision, before), flight.tracking_error)
        if any(events[name] for name in OUTCOMES):
            break
    pursuer_distance, obstacle_distance = flight.least_distances
    return FlightEpisode(
        scenario=scenario,
        seed=seed,
        least_pursuer_distance=pursuer_distance,
        least_obstacle_distance=obstacle_distance,
        **log.kept(),
        options=options,
        start_margin=margin,
        saturated=flight.saturated,
        frames=flight.frames,
        frame_times=np.array(flight.frame_times),
    )


def _margin(certificate: Certificate, world: World) -> float:
    """Of the worst-placed pursuer; -inf where nothing is guaranteed."""
    if not certificate.guaranteed:
        return -np.inf
    seen = [np.asarray(to_pursuer_frame(world.evader, pose), float) for pose in np.asarray(world.pursuers)]
    return min(start_margin(certificate, (float(x), float(y))) for x, y in seen)
