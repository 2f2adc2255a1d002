"""The attacks by name. An attack runs in rounds: batches of chases that can be replayed."""

from __future__ import annotations

import abc
from dataclasses import dataclass
from typing import Any, final

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int, Key, PRNGKeyArray

from sidestep._arrays import real
from sidestep.learning import TD3
from sidestep.safety.clearance import ClearanceTable, shipped_table
from sidestep.trials.falsification.attackers import (
    JointSaddle,
    Roster,
    bang_bang,
    built_in,
    herder,
    script,
    sideswiper,
)
from sidestep.trials.falsification.chases import Chase, Target, run_from
from sidestep.trials.falsification.cross_entropy import Search
from sidestep.trials.falsification.learned import PursuerTraining, train, untrained
from sidestep.trials.falsification.planned import Planning, chase_with_plans, search_starts
from sidestep.trials.falsification.starts import draw_starts, freedom
from sidestep.world import World


@dataclass(frozen=True)
class Round:
    """The result of a round of an attack, per chase.

    **Attributes:** `starts` worlds; `wheels (n, t, m, 2)` commanded, m/s; `steps` control periods to the end;
    `outcome` indices into `OUTCOMES`, -1 for a chase that had not ended; the least clearances and the least
    margin h, m; `searched` control periods simulated in addition, to find a plan.
    """

    starts: World
    wheels: Float[np.ndarray, "n t m 2"]
    steps: Int[np.ndarray, "n"]
    outcome: Int[np.ndarray, "n"]
    pursuer_clearance: Float[np.ndarray, "n"]
    obstacle_clearance: Float[np.ndarray, "n"]
    margin: Float[np.ndarray, "n"]
    searched: int = 0

    @property
    def simulated(self) -> int:
        """Number of control periods simulated."""
        return int(self.steps.sum()) + self.searched


def _round(starts: World, chases: Chase, wheels: Any, searched: int = 0) -> Round:
    get = np.asarray
    return Round(
        jax.tree.map(get, starts),
        get(wheels),
        get(chases.tally.steps),
        get(chases.outcome),
        get(chases.tally.pursuer_clearance),
        get(chases.tally.obstacle_clearance),
        get(chases.margin),
        searched,
    )


class Attack(eqx.Module):
    """An attack. `state` (a pytree of arrays, or None) is what it learns from round to round."""

    def init(self, key: PRNGKeyArray) -> Any:
        """The state before the first round."""
        return None

    def rows(self, state: Any) -> dict[str, int]:
        """Per leaf of the state, the number of leading rows to store, as for `write_arrays`."""
        return {}

    @abc.abstractmethod
    def round(self, target: Target, goal: str, state: Any, key: PRNGKeyArray) -> tuple[Any, Round]:
        """One round against `target`. **Returns** the new state and the round."""


def _starts(target: Target, key: PRNGKeyArray, count: int, edge_share: float) -> World:
    """Start worlds; the first `edge_share` of them at the edge of the capture set."""
    edge = np.arange(count) < round(edge_share * count)
    return draw_starts(target.scenario, jax.random.split(key, count), edge)


def _chased(
    target: Target, pursuer: Any, parts: Any, starts: World, periods: int, key: PRNGKeyArray
) -> Round:
    """A chase from every start; chase i is played by `pursuer(parts[i])`."""
    keys = jax.random.split(key, starts.evader.shape[0])
    return _round(starts, *run_from(target, pursuer, parts, starts, periods, keys))


@final
class Strategies(Attack):
    """The built-in strategies in turn, a quarter of them from the edge of the capture set."""

    roster: Roster
    chases: int = eqx.field(static=True)
    periods: int = eqx.field(static=True)

    def round(self, target: Target, goal: str, state: Any, key: PRNGKeyArray) -> tuple[Any, Round]:
        start_key, chase_key = jax.random.split(key)
        starts = _starts(target, start_key, self.chases, 0.25)
        numbers = jnp.arange(self.chases, dtype=jnp.int32) % len(self.roster.strategies)
        return None, _chased(target, self.roster, numbers, starts, self.periods, chase_key)


@final
class Herding(Attack):
    """Herders with various attack angles, towards the nearest obstacle or the target."""

    chases: int = eqx.field(static=True)
    periods: int = eqx.field(static=True)

    def round(self, target: Target, goal: str, state: Any, key: PRNGKeyArray) -> tuple[Any, Round]:
        start_key, chase_key, way_key, angle_key = jax.random.split(key, 4)
        starts = _starts(target, start_key, self.chases, 0.25)
        angles = jax.random.uniform(angle_key, (self.chases,), dtype=float, minval=0.2, maxval=1.2)
        parts = (jax.random.bernoulli(way_key, 0.3, (self.chases,)), angles)
        return None, _chased(target, herder, parts, starts, self.periods, chase_key)


@final
class Sideswiping(Attack):
    """Sideswipers of various patience, a quarter of them from the edge of the capture set."""

    chases: int = eqx.field(static=True)
    periods: int = eqx.field(static=True)

    def round(self, target: Target, goal: str, state: Any, key: PRNGKeyArray) -> tuple[Any, Round]:
        start_key, chase_key, patience_key, lead_key = jax.random.split(key, 4)
        starts = _starts(target, start_key, self.chases, 0.25)
        count = (self.chases,)
        patience = jax.random.uniform(patience_key, count, dtype=float, minval=0.1, maxval=1.2)
        lead = jax.random.uniform(lead_key, count, dtype=float, minval=-1.3, maxval=1.3)
        return None, _chased(target, sideswiper, (patience, lead), starts, self.periods, chase_key)


@final
class Saddles(Attack):
    """`JointSaddle` by the clearance table of the shield or of the scenario, half of them from the edge of
    the capture set."""

    chases: int = eqx.field(static=True)
    periods: int = eqx.field(static=True)
    two_steps: bool = eqx.field(static=True)

    def round(self, target: Target, goal: str, state: Any, key: PRNGKeyArray) -> tuple[Any, Round]:
        start_key, chase_key, pull_key = jax.random.split(key, 3)
        starts = _starts(target, start_key, self.chases, 0.5)
        pull = jax.random.uniform(pull_key, (self.chases, 2), dtype=float) * jnp.array([0.1, 0.02])
        table = getattr(target.shield, "table", None) or shipped_table(target.scenario)
        saddle = _Saddle(table, self.two_steps)
        return None, _chased(target, saddle, pull, starts, self.periods, chase_key)


class _Saddle(eqx.Module):
    """A call with a pull returns the `JointSaddle` with it."""

    table: ClearanceTable | None
    two_steps: bool = eqx.field(static=True)

    def __call__(self, pull: Float[Array, "2"]) -> JointSaddle:
        """The saddle with this `pull`."""
        return JointSaddle(self.table, pull, self.two_steps)


@eqx.filter_jit
def _bang_bang_plans(scenario: Any, keys: Key[Array, "n"], periods: int, longest: Array) -> Array:
    return jax.vmap(lambda key: bang_bang(scenario, key, periods, longest))(keys)


@final
class BangBang(Attack):
    """Wheel speeds of +V or -V that switch at random, half of them from the edge of the capture set."""

    chases: int = eqx.field(static=True)
    periods: int = eqx.field(static=True)

    def round(self, target: Target, goal: str, state: Any, key: PRNGKeyArray) -> tuple[Any, Round]:
        start_key, plan_key = jax.random.split(key)
        starts = _starts(target, start_key, self.chases, 0.5)
        keys = jax.random.split(plan_key, self.chases)
        plans = _bang_bang_plans(target.scenario, keys, self.periods, real(40.0))
        parts = (plans, jnp.zeros(self.chases, jnp.int32))
        return None, _chased(target, script, parts, starts, self.periods, plan_key)


@final
class CrossEntropy(Attack):
    """Searches start and wheel speeds together, then replans during the chase."""

    planning: Planning
    chases: int = eqx.field(static=True)
    periods: int = eqx.field(static=True)
    edge: bool = eqx.field(static=True)

    def round(self, target: Target, goal: str, state: Any, key: PRNGKeyArray) -> tuple[Any, Round]:
        start_key, search_key, chase_key = jax.random.split(key, 3)
        bases = _starts(target, start_key, self.chases, 1.0 if self.edge else 0.5)
        free = real(freedom(target.scenario, edge=self.edge))
        starts, knots, _ = search_starts(target, self.planning, bases, free, goal, search_key)
        chases, wheels = chase_with_plans(target, self.planning, starts, knots, self.periods, goal, chase_key)
        drawn, planned = self.planning.start_search, self.planning.search
        plans = wheels.shape[1] // self.planning.execute
        searched = self.chases * (
            drawn.population * drawn.iterations * self.planning.opening
            + plans * planned.population * planned.iterations * self.planning.horizon
        )
        return None, _round(starts, chases, wheels, searched)


@final
class Learned(Attack):
    """A pursuer that TD3 trains against this shield."""

    training: PursuerTraining

    def init(self, key: PRNGKeyArray) -> Any:
        return untrained(self.training, key)

    def rows(self, state: Any) -> dict[str, int]:
        return {".ring.rows": min(int(state.ring.written), self.training.capacity)}

    def round(self, target: Target, goal: str, state: Any, key: PRNGKeyArray) -> tuple[Any, Round]:
        start_key, training_key = jax.random.split(key)
        starts = _starts(target, start_key, self.training.chases, 0.5)
        state, chases, wheels = train(target, self.training, state, starts, goal, training_key)
        return state, _round(starts, chases, wheels)


ATTACKS = (
    "pursuers",
    "bang-bang",
    "herder",
    "sideswipe",
    "cross-entropy",
    "edge",
    "learned",
    "joint-saddle",
    "two-step",
)
"""The names of all attacks, in the order of their turns."""


def make_attack(name: str, batch: int = 256, periods: int = 1200) -> Attack:
    """The attack `name`.

    **Arguments:** `batch` chases or plans at once, which determines memory and the length of a round;
    `periods` the longest chase, in control periods.

    **Raises** `ValueError` naming the known attacks.
    """
    few = max(1, batch // 32)
    if name == "pursuers":
        return Strategies(built_in(), batch, periods)
    if name == "herder":
        return Herding(batch, periods)
    if name == "sideswipe":
        return Sideswiping(batch, periods)
    if name == "bang-bang":
        return BangBang(batch, min(periods, 600))
    if name == "cross-entropy":
        drawn = Search(64, 8, 6)
        return CrossEntropy(
            Planning(Search(48, 6, 3), drawn, 4, 64, 8, 80), few, min(periods, 400), edge=False
        )
    if name == "edge":
        drawn = Search(64, 8, 8)
        return CrossEntropy(
            Planning(Search(48, 6, 3), drawn, 1, 24, 4, 32), few, min(periods, 160), edge=True
        )
    if name in ("joint-saddle", "two-step"):
        return Saddles(max(1, batch // 4), periods, name == "two-step")
    if name == "learned":
        algorithm = TD3(discount=0.97, actor_learning_rate=1e-3, critic_learning_rate=1e-3, hidden=(128, 128))
        chases = max(1, batch // 8)
        return Learned(PursuerTraining(algorithm, chases=chases, decisions=max(1, min(periods, 400) // 4)))
    raise ValueError(f"no attack {name!r}; use one of {', '.join(map(repr, ATTACKS))}")
