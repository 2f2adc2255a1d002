"""Who learns: the evader behind its shield, or a pursuer against such an evader."""

from __future__ import annotations

import abc
import dataclasses
from collections.abc import Callable
from typing import Any, final

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, PRNGKeyArray

from sidestep._arrays import AnyArray, Lanes, Scalar, length, real, stack
from sidestep.learning.bounds import on_disc
from sidestep.learning.networks import Actor
from sidestep.learning.options import TrainingOptions
from sidestep.learning.td3 import Bound, no_bound
from sidestep.loop.episode import Episode, Period, Task, advance, hold
from sidestep.loop.policies import GOAL_SEEKING, as_policy
from sidestep.loop.step import decide, decision_steps_of, nominal_velocity
from sidestep.pursuit import Pursuer, pursue
from sidestep.world import Scenario, World, observation_size, observe, to_action
from sidestep.world.capture_geometry import to_pursuer_axes, to_pursuer_frame
from sidestep.world.observation import NEAR_ROBOT


class Player(eqx.Module):
    """What the training loop asks of the robot that learns.

    A command is what it holds during a decision, `(2, *lanes)` in m/s: the evader's nominal velocity, or the
    pursuer's wheel rim speeds. The policy's action is in [-1, 1]^2.
    """

    @abc.abstractmethod
    def observation_size(self, scenario: Scenario) -> int:
        """Number of entries of `observe`."""

    @abc.abstractmethod
    def observe(self, scenario: Scenario, world: World) -> Float[Array, "observation *lanes"]:
        """The policy's observation."""

    @abc.abstractmethod
    def command(
        self, scenario: Scenario, world: World, action: Float[Array, "2 *lanes"]
    ) -> Float[Array, "2 *lanes"]:
        """The command of an action."""

    @abc.abstractmethod
    def action(
        self, scenario: Scenario, world: World, command: Float[Array, "2 *lanes"]
    ) -> Float[Array, "2 *lanes"]:
        """The action of a command: the inverse of `command`."""

    @abc.abstractmethod
    def mirrored(self, command: Float[Array, "*batch 2"]) -> Float[Array, "*batch 2"]:
        """The command in the mirror image of the world (`mirror_world`)."""

    @abc.abstractmethod
    def reward(self, scenario: Scenario, evaders: Lanes, lost: Lanes) -> Lanes:
        """The player's reward, from the evader's, and whether the evader was `lost` (1 or 0)."""

    @abc.abstractmethod
    def advance(
        self, task: Task, episode: Episode, command: Float[Array, "2 *lanes"], key: Any
    ) -> tuple[Episode, Period]:
        """One control period of the task with the command held."""

    @abc.abstractmethod
    def guide(self, scenario: Scenario, pursuer: Any, world: World, key: Any) -> Float[Array, "2 *lanes"]:
        """The command of the strategy that `guided` worlds are driven by; one `key` per lane."""

    @property
    @abc.abstractmethod
    def bound(self) -> Bound:
        """From a batch of actions to those that are possible."""

    @abc.abstractmethod
    def most(self, scenario: Scenario) -> Scalar | None:
        """What no return can exceed; None if there is nothing."""


@final
class Evading(Player):
    """The evader learns, behind its shield."""

    def observation_size(self, scenario: Scenario) -> int:
        return observation_size(scenario)

    def observe(self, scenario: Scenario, world: World) -> Float[Array, "observation *lanes"]:
        return observe(scenario, world)

    def command(
        self, scenario: Scenario, world: World, action: Float[Array, "2 *lanes"]
    ) -> Float[Array, "2 *lanes"]:
        return nominal_velocity(scenario, world, action)

    def action(
        self, scenario: Scenario, world: World, command: Float[Array, "2 *lanes"]
    ) -> Float[Array, "2 *lanes"]:
        return to_action(scenario, world, command)

    def mirrored(self, command: Float[Array, "*batch 2"]) -> Float[Array, "*batch 2"]:
        return command * jnp.array([1.0, -1.0], command.dtype)

    def reward(self, scenario: Scenario, evaders: Lanes, lost: Lanes) -> Lanes:
        return evaders

    def advance(
        self, task: Task, episode: Episode, command: Float[Array, "2 *lanes"], key: Any
    ) -> tuple[Episode, Period]:
        return advance(task, hold(episode, command), key)

    def guide(self, scenario: Scenario, pursuer: Any, world: World, key: Any) -> Float[Array, "2 *lanes"]:
        return decide(scenario, as_policy(GOAL_SEEKING, scenario), world)

    @property
    def bound(self) -> Bound:
        return on_disc

    def most(self, scenario: Scenario) -> Scalar | None:
        return scenario.reach_reward


@final
class Pursuing(Player):
    """The only pursuer learns, against an evader that drives by `policy`; the game is zero-sum.

    Its reward is minus the evader's, and `reach_reward` where the evader is captured or collides. Behind a
    shield it can hardly get that, so it learns to keep the evader from its target.
    """

    policy: Callable[..., Any]

    @staticmethod
    def against(policy: Any, scenario: Scenario) -> Pursuing:
        """The player against a policy or `"goal-seeking"`.

        **Raises** `ValueError` for a policy that does not fit the scenario or knows more than a robot does,
        and for several pursuers.
        """
        if scenario.pursuer_count != 1:
            raise ValueError(
                f"a pursuer learns alone, but the scenario has {scenario.pursuer_count} pursuers: set "
                "pursuer_count=1; what it has learned drives any number of them"
            )
        return Pursuing(as_policy(policy, scenario))

    @staticmethod
    def options(options: TrainingOptions) -> TrainingOptions:
        """The options for a pursuer: without hindsight, since the evader's motion depends on its target.

        **Raises** `ValueError` for options about the shield's answers.
        """
        if options.replay_action != "proposed" or float(options.correction_penalty) > 0.0:
            raise ValueError(
                "training options 'replay_action' and 'correction_penalty' are about the evader's shield; "
                "leave them out for a pursuer that learns"
            )
        return dataclasses.replace(options, hindsight=0.0)

    def observation_size(self, scenario: Scenario) -> int:
        return _OWN + _EACH * scenario.obstacle_count

    def observe(self, scenario: Scenario, world: World) -> Float[Array, "observation *lanes"]:
        return pursuers_view(scenario, world)

    def command(
        self, scenario: Scenario, world: World, action: Float[Array, "2 *lanes"]
    ) -> Float[Array, "2 *lanes"]:
        return scenario.pursuer_speed * action

    def action(
        self, scenario: Scenario, world: World, command: Float[Array, "2 *lanes"]
    ) -> Float[Array, "2 *lanes"]:
        return command / scenario.pursuer_speed

    def mirrored(self, command: Float[Array, "*batch 2"]) -> Float[Array, "*batch 2"]:
        return command[..., ::-1]

    def reward(self, scenario: Scenario, evaders: Lanes, lost: Lanes) -> Lanes:
        return scenario.reach_reward * lost - evaders

    def advance(
        self, task: Task, episode: Episode, command: Float[Array, "2 *lanes"], key: Any
    ) -> tuple[Episode, Period]:
        due = episode.tally.steps % decision_steps_of(self.policy) == 0
        wanted = jax.lax.cond(
            jnp.any(due),
            lambda: decide(task.scenario, self.policy, episode.world),
            lambda: episode.nominal,
        )
        episode = hold(episode, jnp.where(due, wanted, episode.nominal))
        return advance(Task(task.scenario, None, task.shield, _Held(command)), episode, key)

    def guide(self, scenario: Scenario, pursuer: Any, world: World, key: Any) -> Float[Array, "2 *lanes"]:
        return pursue(scenario, pursuer, world, key)[0]

    @property
    def bound(self) -> Bound:
        return no_bound

    def most(self, scenario: Scenario) -> Scalar | None:
        # Delay pays, by the evader's costs.
        return None


@final
class _Held(Pursuer):
    """Drives the wheel speeds (m/s) it is given."""

    wheels: Float[Array, "2 *lanes"]

    takes_lanes = True

    def steer(self, scenario: Scenario, world: World, key: PRNGKeyArray) -> Float[Array, "2 *lanes"]:
        return self.wheels


_OWN, _EACH = 7, 3
"""Entries of a pursuer's observation, and of each obstacle."""


def pursuers_view(scenario: Scenario, world: World) -> Float[Array, "observation *lanes"]:
    """The observation of a pursuer that learns, in its own axes: x ahead, y left.

    - 3 of the evader: position squashed, p/(1 + |p|), and exp(-c/0.2) for its clearance c (m)
    - 2 the evader's velocity in the last period / v_e; 2 its own wheel speeds in the last period / V
    - 3 per obstacle: position squashed, and exp(-c/0.2) for the evader's clearance c (m)

    It does not see the target. One that did learned to wait there, where no evader can do anything about it.
    """
    pose = world.pursuer

    def squashed(point: Float[AnyArray, "2 *lanes"]) -> list[Lanes]:
        seen = to_pursuer_frame(point, pose)
        scale = 1.0 / (1.0 + length(seen[0], seen[1]))
        return [seen[0] * scale, seen[1] * scale]

    def near(place: Float[AnyArray, "d *lanes"], contact: Scalar) -> Lanes:
        clearance = length(place[0] - world.evader[0], place[1] - world.evader[1]) - contact
        return jnp.exp(-jnp.maximum(clearance, 0.0) / NEAR_ROBOT)

    velocity = to_pursuer_axes(world.evader_velocity / scenario.evader_speed, pose[2])
    wheels = jnp.clip(world.wheel_speeds[0] / scenario.pursuer_speed, -1.0, 1.0)
    entries = [
        *squashed(world.evader),
        near(pose, scenario.capture_distance),
        *velocity,
        *wheels,
    ]
    for obstacle in world.obstacles:
        entries += [*squashed(obstacle[:2]), near(obstacle, scenario.collision_distance)]
    return stack(*entries)


@final
class LearnedPursuer(Pursuer):
    """A trained pursuer. It decides every `decision_steps` control periods and holds its wheel speeds."""

    actor: Actor
    decision_steps: int = eqx.field(static=True)

    takes_lanes = True

    def steer(self, scenario: Scenario, world: World, key: PRNGKeyArray) -> Float[Array, "2 *lanes"]:
        """**Raises** `ValueError` for another number of obstacles than in its training."""
        seen = pursuers_view(scenario, world)
        wanted = self.actor.body.weights[0].shape[0]
        if seen.shape[0] != wanted:
            raise ValueError(
                f"this pursuer was trained among {(wanted - _OWN) // _EACH} obstacles, this scenario has "
                f"{scenario.obstacle_count}: set obstacle_count"
            )
        lanes = seen.shape[1:]
        action = self.actor(seen.reshape(wanted, -1).T).T.reshape(2, *lanes)
        periods = jnp.round(world.time / scenario.control_period).astype(jnp.int32)
        due = periods % self.decision_steps == 0
        return jnp.where(due, scenario.pursuer_speed * action, real(world.wheel_speeds[0]))


EVADING = Evading()
"""The player that learns unless another is named."""
