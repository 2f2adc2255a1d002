"""What happens in one episode on the twin, with the very decision core that a robot runs?"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from sidestep import _interrupts
from sidestep._arrays import seed_number
from sidestep.plants.ground.options import TwinOptions
from sidestep.plants.ground.twin import Twin
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
from sidestep.safety import Budget, Shield
from sidestep.store.runs import OUTCOMES
from sidestep.world import Scenario, World


@dataclass(frozen=True)
class TwinEpisode(PhysicsEpisode):
    """One episode of T control periods on the twin; `tracking_errors` are in m/s, how far the mean velocity
    of a period was from the command.

    - `frames` and `frame_times` positions at 100 Hz, for `write_video`
    """

    options: TwinOptions
    frames: Float[np.ndarray, "n nq"]
    frame_times: Float[np.ndarray, "n"]


def settings_for(options: TwinOptions) -> OnboardSettings:
    """What the decision core is told of the twin's sensors and motors.

    Filters average the noise, and predict the pursuer to when a command acts: a standard deviation is allowed
    for in place, a quarter of one in heading, and the delay of the poses without that of the motors, which is
    modelled. That is what the paper's numbers leave some use of, not what bounds the errors (`bounded_errors`
    does): an evader that keeps more is led round in circles and does not arrive, one that keeps less is
    caught.
    """
    sensors = options.sensors
    return OnboardSettings(
        budget=Budget(
            position_error=sensors.position_noise,
            heading_error=0.25 * sensors.heading_noise,
            delay=sensors.bounds()["delay"] + options.actuation_delay,
        ),
        position_noise=sensors.position_noise,
        heading_noise=sensors.heading_noise,
        actuation_delay=options.actuation_delay,
        motor_lag=options.lag,
        motor_acceleration=options.acceleration,
        predict_pursuer=True,
    )


def run_twin(
    scenario: Scenario,
    policy: str | Callable[..., Any],
    shield: str | Shield,
    pursuer: str | Callable[..., Any],
    seed: int = 0,
    options: TwinOptions | None = None,
    steps: int | None = None,
    *,
    settings: OnboardSettings | None = None,
    world: World | None = None,
) -> TwinEpisode:
    """One episode, as `twin_episode` with a decision core of its own; for many, compile one and use that.

    **Arguments:** `policy` and `shield` as for `evaluate`; `settings` of the decision core, see
    `settings_for`; the rest as for `twin_episode`.
    """
    options = options or TwinOptions()
    onboard = Onboard(scenario, shield, policy, settings or settings_for(options))
    return twin_episode(onboard, pursuer, seed, options, steps, world=world)


def twin_episode(
    onboard: Onboard,
    pursuer: str | Callable[..., Any],
    seed: int = 0,
    options: TwinOptions | None = None,
    steps: int | None = None,
    *,
    world: World | None = None,
) -> TwinEpisode:
    """One episode: measurements, the decision core's command and the pursuers', physics, once per period.

    Start, measurements and random pursuers follow from `seed`; the start is that of `rollout` with this
    seed. Sensors have been on for half a second when the clock starts.

    **Arguments:** `onboard` the decision core, with a policy; it is reset. `pursuer` as for `evaluate`;
    `steps` at most this many control periods (the scenario's `episode_steps` if not given); `world` to start
    in.

    **Raises** `ValueError` as `evaluate`, and `TwinError` when MuJoCo is missing.
    """
    scenario = onboard.scenario
    limit = periods_of(scenario, steps)
    strategy = as_pursuer(pursuer)
    seed_number(seed)
    twin = Twin(scenario, options, seed)
    drawn, key = start_of(scenario, jnp.asarray(seed, jnp.uint32))
    twin.reset(drawn if world is None else world)
    onboard.reset()
    truth = twin.world
    onboard.target = (float(truth.target[0]), float(truth.target[1]))
    period = float(scenario.control_period)
    log = Log(truth)
    for count in range(limit):
        _interrupts.check()
        now = twin.time
        for robot, index, stamp, pose in twin.measurements():
            onboard.see(robot, stamp, pose if robot != "obstacle" else pose[:2], index)
        decision = onboard.decide(now)
        seen = truth
        if twin.options.pursuer_sees == "measurements" and decision.world is not None:
            seen = decision.world
        wheels = np.asarray(steered(scenario, strategy, seen, key, jnp.asarray(count, jnp.uint32)))
        twin.command(decision.velocity, wheels)
        contacts = twin.advance((count + 1) * period - now)
        before, truth = truth, twin.world
        events = events_of(scenario, truth, contacts, count + 1 >= scenario.episode_steps)
        error = estimate_error(decision, before)
        driven = _driven(before, truth, period) - np.asarray(decision.velocity)
        log.add(now, decision, wheels, truth, events, error, float(np.hypot(*driven)))
        if any(events[name] for name in OUTCOMES):
            break
    pursuer_distance, obstacle_distance = twin.least_distances
    return TwinEpisode(
        scenario=scenario,
        seed=seed,
        least_pursuer_distance=pursuer_distance,
        least_obstacle_distance=obstacle_distance,
        **log.kept(),
        options=twin.options,
        frames=np.array(twin.frames),
        frame_times=np.array(twin.frame_times),
    )


def _driven(before: World, after: World, period: float) -> Float[np.ndarray, "2"]:
    return (np.asarray(after.evader) - np.asarray(before.evader)) / period
