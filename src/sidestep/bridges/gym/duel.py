"""Evader and pursuers as learners: a PettingZoo parallel environment."""

from __future__ import annotations

from typing import Any, final

import equinox as eqx
import gymnasium
import jax
import jax.numpy as jnp
import numpy as np
from gymnasium import spaces
from gymnasium.utils import seeding
from jaxtyping import Array, Float

from sidestep._arrays import seed_number
from sidestep._packages import needed
from sidestep.bridges.gym.calls import bundle_of, bundled, flat, packed, seed_words, unpacked_one
from sidestep.bridges.gym.episode import EnvState, begin, begin_in, decide, seen
from sidestep.bridges.gym.rendering import Screen, check_render_mode
from sidestep.bridges.gym.spaces import action_space, checked_action, observation_space
from sidestep.bridges.gym.task import Task, make_task
from sidestep.bridges.gym.worlds import given_world
from sidestep.world import Scenario, World
from sidestep.world.capture_geometry import to_pursuer_frame
from sidestep.world.observation import NEAR_ROBOT

pettingzoo = needed("pettingzoo", "gym", "the environment in which the pursuer learns needs")

EVADER = "evader"
_ROUNDING = 1e-5


class _CommandedPursuers(eqx.Module):
    """Pursuers that drive the given wheel speeds (m/s)."""

    wheel_speeds: Float[Array, "m 2"]

    def steer_all(self, scenario: Scenario, world: World) -> Float[Array, "m 2"]:
        return self.wheel_speeds

    def __call__(self, scenario: Scenario, world: World, key: Any) -> Float[Array, "2"]:
        return self.wheel_speeds[0]


def pursuer_observation(scenario: Scenario, world: World) -> Float[Array, "size"]:
    """The observation of `world.pursuer` in its frame (x ahead, y left), scaled to about [-1, 1].

    Five entries per robot: position p/(1 + |p|) (2), a second vector (2) and exp(-c/0.2) for the clearance c
    (m). The second vector is the velocity over v_e for the evader and for obstacles, and the heading (cos,
    sin) for other pursuers. Order: evader, obstacles, other pursuers, then the target's p/(1 + |p|) (2).
    """
    pose = world.pursuer

    def turned(vector: Any) -> Any:
        return to_pursuer_frame(vector, jnp.concatenate([jnp.zeros_like(pose[:2]), pose[2:]]))

    def place(point: Any) -> Any:
        z = to_pursuer_frame(point, pose)
        return z / (1.0 + jnp.hypot(z[0], z[1]))

    def block(point: Any, vector: Any, contact: Any) -> list[Any]:
        gap = jnp.hypot(*(point - pose[:2])) - contact
        return [place(point), turned(vector), jnp.exp(-jnp.maximum(gap, 0.0) / NEAR_ROBOT)[None]]

    speed, capture = scenario.evader_speed, scenario.capture_distance
    entries = block(world.evader, world.evader_velocity / speed, capture)
    for obstacle in world.obstacles:
        entries += block(obstacle[:2], obstacle[2:] / speed, scenario.collision_distance)
    for other in world.pursuers[1:]:
        entries += block(other[:2], jnp.stack([jnp.cos(other[2]), jnp.sin(other[2])]), capture)
    return jnp.concatenate([*entries, place(world.target)]).astype(jnp.float32)


def _pursuer_space(scenario: Scenario) -> spaces.Box:
    drift = float(np.hypot(*np.asarray(scenario.obstacle_velocity)) / np.asarray(scenario.evader_speed))
    robot = [1.0] * 5
    obstacle = [1.0, 1.0, max(1.0, drift), max(1.0, drift), 1.0]
    bounds = [*robot, *obstacle * scenario.obstacle_count, *robot * (scenario.pursuer_count - 1), 1.0, 1.0]
    high = np.array(bounds, np.float32) * np.float32(1.0 + _ROUNDING)
    return spaces.Box(-high, high, dtype=np.float32)


def _observations(task: Task, episode: EnvState) -> tuple[Any, Any]:
    views = [
        pursuer_observation(task.scenario, episode.world.seen_by(index))
        for index in range(task.scenario.pursuer_count)
    ]
    return seen(task, episode), jnp.stack(views)


def _begin(task: Task, words: Any, number: Any) -> tuple[Any, ...]:
    episode = begin(task, words, number)
    return jax.tree.leaves(episode), *_observations(task, episode)


def _begin_in(task: Task, world: World, words: Any, number: Any) -> tuple[Any, ...]:
    episode = begin_in(task, world, words, number)
    return jax.tree.leaves(episode), *_observations(task, episode)


def _step(task: Task, episode: EnvState, action: Any, wheels: Any) -> tuple[Any, ...]:
    pursuers = _CommandedPursuers(task.scenario.pursuer_speed * wheels)
    episode, decision = decide(eqx.tree_at(lambda task: task.pursuer, task, pursuers), episode, action)
    return jax.tree.leaves(episode), *_observations(task, episode), *packed(decision)


@final
class DuelEnv(pettingzoo.ParallelEnv):
    """A zero-sum game of the evader and its pursuers. All agents learn and act simultaneously.

    **Agents:** `evader`, as in `PursuedEnv`, behind `shield` (or `"none"`); and `pursuer`, or `pursuer_0`,
    `pursuer_1`, ... if there are several. A pursuer's action in [-1, 1]^2 is the left and right wheel's rim
    speed over `pursuer_speed`; its observation is `pursuer_observation`.

    **Rewards** sum to zero. The evader's is the scenario's reward, less `capture_penalty` (by default the
    scenario's `reach_reward`) for a capture or collision, times `reward_scale`. Each of the m pursuers gets
    minus 1/m of it. A collision thus counts as a capture.

    Other arguments and `info` as in `PursuedEnv`; an episode ends for all agents at once.
    """

    # Set for each environment, because `render_fps` depends on the task.
    metadata: dict[str, Any] = {  # noqa: RUF012
        "name": "sidestep_duel_v0",
        "render_modes": ["human", "rgb_array"],
        "render_fps": 20,
        "is_parallelizable": True,
    }

    def __init__(
        self,
        scenario: Any = "paper",
        shield: Any = "joint",
        decision_steps: int = 10,
        reward_scale: float = 1.0,
        capture_penalty: float | None = None,
        render_mode: str | None = None,
        **fields: Any,
    ):
        if "pursuer" in fields:
            raise ValueError("pursuer: in DuelEnv the pursuers learn; use PursuedEnv for a fixed strategy")
        self.render_mode = check_render_mode(render_mode)
        self.task = make_task(scenario, shield, "still", decision_steps, reward_scale, **fields)
        self.scenario = self.task.scenario
        penalty = float(self.scenario.reach_reward) if capture_penalty is None else float(capture_penalty)
        if not np.isfinite(penalty):
            raise ValueError(f"capture_penalty = {capture_penalty!r}: it must be a finite number")
        self._penalty = penalty * reward_scale
        self.metadata = {**type(self).metadata, "render_fps": self.task.pictures_per_second}
        count = self.scenario.pursuer_count
        self.pursuers = ["pursuer"] if count == 1 else [f"pursuer_{index}" for index in range(count)]
        self.possible_agents = [EVADER, *self.pursuers]
        self.agents: list[str] = []
        self.observation_spaces: dict[str, spaces.Box] = {
            EVADER: observation_space(self.scenario),
            **{agent: _pursuer_space(self.scenario) for agent in self.pursuers},
        }
        self.action_spaces = {agent: action_space() for agent in self.possible_agents}
        self._task, self._layout = bundled(self.task), bundle_of(self.task)
        shapes = jax.ShapeDtypeStruct((2,), np.uint32), jax.ShapeDtypeStruct((), np.int32)
        example = jax.eval_shape(begin, self.task, *shapes)
        self._inner = jax.tree.structure(example)
        self._words, self._number = np.zeros(2, np.uint32), -1
        self._episode: list[Any] | None = None
        self._screen = Screen(self.render_mode, self.scenario, self.task.shield, self.metadata["render_fps"])

    def observation_space(self, agent: str) -> spaces.Box:
        return self.observation_spaces[agent]

    def action_space(self, agent: str) -> spaces.Box:
        return self.action_spaces[agent]

    @property
    def world(self) -> World:
        """The current world. **Raises** `gymnasium.error.ResetNeeded` before the first `reset`."""
        if self._episode is None:
            raise gymnasium.error.ResetNeeded("call reset() before anything else")
        return jax.tree.unflatten(self._inner, self._episode).world

    def state(self) -> np.ndarray:
        """The global state for centralised critics: all positions (m), headings (rad) and velocities (m/s) in
        world axes."""
        world = self.world
        parts = (world.evader, world.evader_velocity, world.pursuers, world.obstacles, world.target)
        return np.concatenate([np.ravel(part) for part in parts]).astype(np.float32)

    def reset(
        self, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[dict[str, np.ndarray], dict[str, dict[str, Any]]]:
        if seed is not None:
            seed_number(seed)
        if seed is not None or self._number < 0:
            seed = seeding.np_random()[1] if seed is None else seed
            self._words, self._number = seed_words([seed])[:, 0], -1
        self._number += 1
        number = np.asarray(self._number, np.int32)
        # Unknown options are ignored, because PettingZoo's tests pass some.
        if options and "world" in options:
            leaves, structure = jax.tree.flatten(given_world(self.scenario, options["world"]))
            made = flat(_begin_in, self._layout, structure)((self._task, leaves), self._words, number)
        else:
            made = flat(_begin, self._layout)((self._task,), self._words, number)
        self._episode, observation, views = made
        self.agents = list(self.possible_agents)
        self._screen.follow(lambda: self.world, begun=True)
        return self._by_agent(observation, views), {agent: {} for agent in self.agents}

    def _by_agent(self, observation: Any, views: Any) -> dict[str, np.ndarray]:
        return {EVADER: np.array(observation), **dict(zip(self.pursuers, np.array(views), strict=True))}

    def step(self, actions: dict[str, Any]) -> tuple[dict[str, Any], ...]:
        if not self.agents:
            return {}, {}, {}, {}, {}
        missing = [agent for agent in self.agents if agent not in actions]
        if missing:
            raise ValueError(f"no action for {', '.join(missing)}")
        wheels = np.stack([checked_action(actions[agent], (2,)) for agent in self.pursuers])
        assert self._episode is not None
        program, action = flat(_step, self._layout, self._inner), checked_action(actions[EVADER], (2,))
        made = program((self._task, self._episode), action, wheels)
        self._episode, observation, views, floats, whole = made
        reward, terminated, truncated, info = unpacked_one(floats, whole)
        gained = reward - self._penalty * info["cost"]
        everybody = self.agents
        shares = {agent: -gained / len(self.pursuers) for agent in self.pursuers}
        self._screen.follow(lambda: self.world, info)
        if terminated or truncated:
            self.agents = []
        return (
            self._by_agent(observation, views),
            {EVADER: gained, **shares},
            dict.fromkeys(everybody, terminated),
            dict.fromkeys(everybody, truncated),
            {agent: dict(info) for agent in everybody},
        )

    def render(self) -> np.ndarray | None:
        """The scene as pixels (height, width, 3) with `rgb_array`; None with `human`, which uses a window."""
        return self._screen.pixels()

    def close(self) -> None:
        self._screen.close()


ID = "sidestep/Duel-v0"


def parallel_env(**arguments: Any) -> DuelEnv:
    """A `DuelEnv`; the constructor's name in PettingZoo modules."""
    return DuelEnv(**arguments)


def env(**arguments: Any) -> Any:
    """A `DuelEnv` as a PettingZoo AEC environment, in which agents act in turn."""
    from pettingzoo.utils import wrappers
    from pettingzoo.utils.conversions import parallel_to_aec

    return wrappers.OrderEnforcingWrapper(parallel_to_aec(DuelEnv(**arguments)))


if ID not in pettingzoo.parallel_registry:
    pettingzoo.register("parallel", ID, entry_point=f"{__name__}:parallel_env")
    pettingzoo.register("aec", ID, entry_point=f"{__name__}:env")
