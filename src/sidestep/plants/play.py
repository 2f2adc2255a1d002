"""An episode on a plant: measure, decide, command, advance, once per control period."""

from __future__ import annotations

import abc
from collections.abc import Callable
from typing import Any, final

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, PRNGKeyArray

from sidestep import _interrupts
from sidestep._arrays import seed_number, whole_number
from sidestep._bounds import taken
from sidestep.loop.keys import start_and_pursuit
from sidestep.plants.library import TwinError
from sidestep.plants.options import SEEN
from sidestep.plants.plant import Plant
from sidestep.plants.record import Log, PlantEpisode
from sidestep.pursuit import Pursuer, as_pursuer, pursue
from sidestep.robot import Decision, Onboard
from sidestep.world import Scenario, World


class Robot(abc.ABC):
    """Decides for the evader of a plant."""

    @abc.abstractmethod
    def reset(self) -> None:
        """Reset the state before an episode."""

    @abc.abstractmethod
    def decide(self, plant: Any) -> Decision:
        """The decision for the period that begins now, from the measurements so far."""


def see(onboard: Onboard, plant: Plant) -> None:
    """Pass the plant's new measurements to a decision core."""
    for robot, index, stamp, pose in plant.measurements():
        onboard.see(robot, stamp, pose if robot != "obstacle" else pose[:2], index)


@final
class _Core(Robot):
    """A decision core with a policy; its target is that of the start world."""

    def __init__(self, onboard: Onboard):
        self._onboard = onboard

    def reset(self) -> None:
        self._onboard.reset()
        self._begun = False

    def decide(self, plant: Plant) -> Decision:
        if not self._begun:
            self._begun, self._onboard.target = True, np.asarray(plant.world.target)
        see(self._onboard, plant)
        return self._onboard.decide(plant.time)


@eqx.filter_jit
def start_of(scenario: Scenario, seed: Array) -> tuple[World, PRNGKeyArray]:
    """The start world of `rollout` with this seed, and the random key of its pursuers."""
    start_key, pursuit_key = start_and_pursuit(jax.random.key(seed))
    return scenario.reset(start_key), pursuit_key


@eqx.filter_jit
def steered(scenario: Scenario, pursuer: Pursuer, world: World, key: PRNGKeyArray, period: Array) -> Array:
    """Rim speeds (m, 2) in m/s of every pursuer in a period."""
    return pursue(scenario, pursuer, world, jax.random.fold_in(key, period))


def play(
    plant: Plant,
    robot: Onboard | Robot,
    pursuer: str | Callable[..., Any],
    seed: int = 0,
    steps: int | None = None,
    *,
    world: World | None = None,
    pursuer_sees: str = "truth",
) -> PlantEpisode:
    """One episode on a plant: measure, decide, command and advance once per control period.

    `seed` determines the start (that of `rollout`), the measurements and random pursuers.

    **Arguments:** `robot` a decision core with a policy, or a `Robot`; robot and plant are reset. `pursuer`
    as for `evaluate`; `steps` the largest number of control periods (default: the scenario's
    `episode_steps`); `world` to start in; `pursuer_sees`, see `PURSUER_SEES`.

    **Raises** `ValueError` as `evaluate` and as the plant.
    """
    scenario = plant.scenario
    taken("pursuer_sees", pursuer_sees, SEEN, TwinError)
    limit = scenario.episode_steps if steps is None else whole_number("steps", steps)
    strategy = as_pursuer(pursuer)
    drawn, key = start_of(scenario, jnp.asarray(seed_number(seed), jnp.uint32))
    robot = _Core(robot) if isinstance(robot, Onboard) else robot
    plant.reset(drawn if world is None else world, seed)
    robot.reset()
    log, period = Log(plant), float(scenario.control_period)
    for count in range(limit):
        _interrupts.check()
        now = plant.time
        decision = robot.decide(plant)
        estimate = decision.world if pursuer_sees == "measurements" else None
        seen = log.world if estimate is None else estimate
        wheels = np.asarray(steered(scenario, strategy, seen, key, jnp.asarray(count, jnp.uint32)))
        plant.command(decision.velocity, wheels)
        contacts = plant.advance((count + 1) * period - now)
        if log.add(now, decision, wheels, contacts):
            break
    return log.episode(seed)
