"""Many worlds as one Gymnasium vector environment, all stepped in one compiled call."""

from __future__ import annotations

from typing import Any, final

import gymnasium
import jax
import numpy as np
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space
from jaxtyping import Float

from sidestep.bridges.gym import fleet as fleets
from sidestep.bridges.gym.calls import bundle_of, bundled, flat, packed, seed_words, unpacked
from sidestep.bridges.gym.fleet import AHEAD, Fleet, Spares
from sidestep.bridges.gym.rendering import Picture, check_render_mode
from sidestep.bridges.gym.spaces import action_space, checked_action, observation_space
from sidestep.bridges.gym.task import Task, make_task
from sidestep.bridges.gym.worlds import checked_options, given_world
from sidestep.world import World

_DRAWN_AT_ONCE = 256


def _launch(task: Task, words: Any, number: Any) -> tuple[list[Any], list[Any], Any]:
    fleet = fleets.launch(task, words, number)
    return _leaves(fleet), bundled(fleets.no_spares(fleet)), fleets.seen(task, fleet.episode)


def _place(task: Task, fleet: Fleet, world: World) -> tuple[list[Any], Any]:
    fleet = fleets.place(task, fleet, world)
    return _leaves(fleet), fleets.seen(task, fleet.episode)


def _follow(task: Task, fleet: Fleet, spares: Spares, where: Any) -> tuple[list[Any], Any]:
    fleet = fleets.follow(fleet, spares, where)
    return _leaves(fleet), fleets.seen(task, fleet.episode)


def _draw(task: Task, fleet: Fleet, spares: Spares, lanes: Any, numbers: Any) -> list[Any]:
    return bundled(fleets.draw(task, fleet, spares, lanes, numbers))


def _leaves(tree: Any) -> list[Any]:
    return jax.tree.leaves(tree)


def _stepper(mode: str) -> Any:
    def step(task: Task, fleet: Fleet, spares: Spares, actions: Any) -> tuple[Any, ...]:
        fleet, made = fleets.step(task, mode, fleet, spares, actions)
        return _leaves(fleet), made.observation, made.final, *packed(made.decision)

    return step


_STEP = {mode: _stepper(mode) for mode in (fleets.NEXT_STEP, fleets.SAME_STEP, fleets.DISABLED)}


@final
class PursuedVectorEnv(VectorEnv):
    """`num_envs` worlds of `sidestep/Pursued-v0`, as `gymnasium.make_vec` makes them; arguments as there.

    `autoreset_mode` (an `AutoresetMode` or its value) says when an episode that has ended is followed by the
    next: `NEXT_STEP` (Gymnasium's default) with the next step, whose action that world then ignores, with
    reward 0; `SAME_STEP` at once, with the last observation and info in `info["final_obs"]` and
    `info["final_info"]`; `DISABLED` when `reset(options={"reset_mask": mask})` says so.

    `reset(seed=s)` seeds world i with s + i; a list gives each its own. World i then goes through the same
    episodes as a `PursuedEnv` with that seed, to rounding. Arrays in `info` are read-only views.
    """

    # Each has its own, with its own pictures per second.
    metadata: dict[str, Any] = {  # noqa: RUF012
        "render_modes": ["rgb_array"],
        "render_fps": 20,
        "autoreset_mode": AutoresetMode.NEXT_STEP,
    }

    def __init__(
        self,
        num_envs: int = 1,
        scenario: Any = "paper",
        shield: Any = "joint",
        pursuer: Any = "nash",
        decision_steps: int = 10,
        reward_scale: float = 1.0,
        autoreset_mode: AutoresetMode | str = AutoresetMode.NEXT_STEP,
        render_mode: str | None = None,
        **fields: Any,
    ):
        if isinstance(num_envs, bool) or not isinstance(num_envs, (int, np.integer)) or num_envs < 1:
            raise ValueError(f"num_envs = {num_envs!r}: it must be a whole number of at least 1")
        if render_mode not in (None, "rgb_array"):
            raise ValueError(f"render_mode = {render_mode!r}: many worlds are drawn as 'rgb_array' only")
        super().__init__()
        self.render_mode = check_render_mode(render_mode)
        self.num_envs = int(num_envs)
        try:
            self.autoreset_mode = AutoresetMode(autoreset_mode)
        except ValueError:
            modes = ", ".join(repr(mode.value) for mode in AutoresetMode)
            raise ValueError(f"autoreset_mode = {autoreset_mode!r}: it must be one of {modes}") from None
        self.task = make_task(scenario, shield, pursuer, decision_steps, reward_scale, **fields)
        self.scenario = self.task.scenario
        self.metadata = {
            **type(self).metadata,
            "render_fps": self.task.pictures_per_second,
            "autoreset_mode": self.autoreset_mode,
        }
        self.single_observation_space = observation_space(self.scenario)
        self.single_action_space = action_space()
        self.observation_space = batch_space(self.single_observation_space, self.num_envs)
        self.action_space = batch_space(self.single_action_space, self.num_envs)
        self._task, self._layout = bundled(self.task), bundle_of(self.task)
        self._words = np.zeros((2, self.num_envs), np.uint32)
        # Numbers of the episodes that run, and of the last one of each lane whose start has been drawn.
        self._numbers = np.full(self.num_envs, -1, np.int32)
        self._drawn = self._numbers.copy()
        self._ended = np.ones(self.num_envs, bool)
        self._fleet: list[Any] | None = None
        self._spares: list[Any] = []

    @property
    def worlds(self) -> World:
        """All worlds as they are now, with their axis in front. **Raises** `ResetNeeded` before a `reset`."""
        episode = jax.tree.unflatten(self._layouts[1], self._now()).episode
        return jax.tree.map(lambda leaf: np.moveaxis(np.asarray(leaf), -1, 0), episode.world)

    def _now(self) -> list[Any]:
        if self._fleet is None:
            raise gymnasium.error.ResetNeeded("call reset() before anything else")
        return self._fleet

    def _parts(self) -> tuple[list[Any], ...]:
        return self._task, self._now(), self._spares

    def reset(
        self, *, seed: int | list[int | None] | None = None, options: dict[str, Any] | None = None
    ) -> tuple[np.ndarray, dict[str, Any]]:
        told = checked_options(options, "world", "reset_mask")
        if "reset_mask" in told:
            if "world" in told:
                raise ValueError("options: 'world' starts all worlds anew and takes no 'reset_mask'")
            return self._reset_some(seed, told["reset_mask"])
        fresh = self._seed(seed)
        self._numbers = np.where(fresh, 0, self._numbers + 1).astype(np.int32)
        self._drawn = self._numbers.copy()
        launch = flat(_launch, self._layout)
        self._fleet, self._spares, observation = launch((self._task,), self._words, self._numbers)
        fleet = jax.eval_shape(fleets.launch, self.task, self._words, self._numbers)
        spares = bundle_of(jax.eval_shape(fleets.no_spares, fleet))
        self._layouts = self._layout, jax.tree.structure(fleet), spares
        if "world" in told:
            world = given_world(self.scenario, told["world"], (self.num_envs,))
            leaves, structure = jax.tree.flatten(world)
            place = flat(_place, *self._layouts[:2], structure)
            self._fleet, observation = place((self._task, self._now(), leaves))
        self._ended = np.zeros(self.num_envs, bool)
        return np.array(observation), {}

    def _seed(self, seed: Any) -> np.ndarray:
        """Take new seeds; which worlds got one."""
        if seed is None and self._fleet is None:
            seed = self.np_random_seed
        if seed is None:
            return np.zeros(self.num_envs, bool)
        if isinstance(seed, (int, np.integer)):
            super().reset(seed=int(seed))
            seed = [int(seed) + lane for lane in range(self.num_envs)]
        if len(seed) != self.num_envs:
            raise ValueError(f"{len(seed)} seeds for {self.num_envs} worlds")
        given = np.array([one is not None for one in seed])
        fresh = given | (self._numbers < 0)
        if np.any(fresh & ~given):
            drawn = self.np_random.integers(2**32, size=self.num_envs)
            seed = [drawn[lane] if one is None else one for lane, one in enumerate(seed)]
        words = seed_words([0 if one is None else one for one in seed])
        self._words = np.where(fresh, words, self._words)
        return fresh

    def _reset_some(self, seed: Any, mask: Any) -> tuple[np.ndarray, dict[str, Any]]:
        mask = np.asarray(mask)
        if mask.shape != (self.num_envs,) or mask.dtype != np.bool_ or not np.any(mask):
            raise ValueError(
                f"options['reset_mask'] must be {self.num_envs} booleans, at least one of them true"
            )
        if seed is not None:
            raise ValueError(
                "options['reset_mask'] starts the next episodes of these worlds; it takes no seed"
            )
        self._now()
        self._draw_ahead()
        self._fleet, observation = flat(_follow, *self._layouts)(self._parts(), mask)
        self._numbers[mask] += 1
        self._ended &= ~mask
        return np.array(observation), {}

    def _draw_ahead(self) -> None:
        """Draw the next starts of all lanes, if one has none left."""
        if not np.any(self._drawn <= self._numbers):
            return
        ahead = self._drawn[:, None] + np.arange(1, AHEAD + 1, dtype=np.int32)
        lanes, which = np.nonzero(ahead <= self._numbers[:, None] + AHEAD)
        numbers = ahead[lanes, which]
        draw, chunk = flat(_draw, *self._layouts), min(_DRAWN_AT_ONCE, AHEAD * self.num_envs)
        for first in range(0, len(lanes), chunk):
            some = np.full((2, chunk), self.num_envs, np.int32)
            part = lanes[first : first + chunk], numbers[first : first + chunk]
            some[:, : len(part[0])] = part
            self._spares = draw(self._parts(), some[0], some[1])
        self._drawn = self._numbers + AHEAD

    def step(self, actions: Any) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, dict[str, Any]]:
        mode = self.autoreset_mode
        if mode is AutoresetMode.DISABLED:
            if np.any(self._ended):
                raise gymnasium.error.ResetNeeded(
                    "an episode is over: call reset(options={'reset_mask': terminated | truncated}) first"
                )
        else:
            self._draw_ahead()
        made = self.program(checked_action(actions, (self.num_envs, 2)))
        self._fleet, observation, final, floats, whole = made
        reward, info = unpacked(floats, whole)
        truncated = info["timed_out"]
        terminated = info["captured"] | info["collided"] | info["reached"]
        if mode is AutoresetMode.NEXT_STEP:
            begun = self._ended
            info = self._masked(info, ~begun)
        else:
            begun = terminated | truncated
            info = self._final(info, final, begun) if mode is AutoresetMode.SAME_STEP else self._masked(info)
        self._ended = terminated | truncated
        reward = reward.astype(np.float64)
        if mode is not AutoresetMode.DISABLED:
            self._numbers = self._numbers + begun
        return np.array(observation), reward, terminated, truncated, info

    def program(self, actions: Float[np.ndarray, "worlds 2"]) -> tuple[Any, ...]:
        """What `step` computes, as arrays of the device, without taking the step."""
        return flat(_STEP[self.autoreset_mode.value], *self._layouts)(self._parts(), actions)

    def _masked(self, info: dict[str, Any], mask: np.ndarray | None = None) -> dict[str, Any]:
        """Vector infos: beside each entry, which worlds have it."""
        mask = np.ones(self.num_envs, bool) if mask is None else mask
        return {**info, **{f"_{name}": mask for name in info}}

    def _final(self, info: dict[str, Any], final: Any, ended: np.ndarray) -> dict[str, Any]:
        """Infos of `SAME_STEP`: those of worlds whose episode ended are in `final_info`."""
        infos = self._masked(info, ~ended)
        if np.any(ended):
            kept = {name: value.copy() for name, value in info.items()}
            for value in kept.values():
                value[ended] = 0
            infos |= kept
            last = np.full(self.num_envs, None, object)
            for lane in np.flatnonzero(ended):
                last[lane] = np.array(final[lane])
            infos |= {
                "final_obs": last,
                "_final_obs": ended.copy(),
                "final_info": self._masked(info, ended),
                "_final_info": ended.copy(),
            }
        return infos

    def render(self) -> tuple[np.ndarray, ...] | None:
        """The scene of every world as pixels, without the ways that were taken."""
        if self.render_mode is None:
            return None
        worlds, pictures = self.worlds, []
        for lane in range(self.num_envs):
            picture = Picture(self.scenario, self.task.shield)
            picture.follow(jax.tree.map(lambda leaf: leaf[lane], worlds))  # noqa: B023
            pictures.append(picture.drawn())
        return tuple(pictures)
