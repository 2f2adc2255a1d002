"""The policy `planner`: it knows the pursuer's strategy and imagines where each of many plans leads."""

from __future__ import annotations

from itertools import permutations
from typing import Any, TypeAlias, final

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from sidestep._arrays import in_lanes, length, stack
from sidestep.loop.episode import Episode, EpisodePolicy, Task, hold
from sidestep.loop.step import CAPTURED, COLLIDED, REACHED, RUNNING, control_step, outcome_of
from sidestep.safety import start_in_lanes
from sidestep.world import Scenario, World

SEGMENTS = 12
HEADINGS = 12
STRAIGHT = HEADINGS
"""The choice to drive straight at the target; smaller ones are headings in world axes."""
Plan: TypeAlias = Int[Array, "segments *lanes"]
"""One choice per segment."""
_HELD = (1, 2, 4, 8, 12)
"""Numbers of segments for which one heading is tried."""
_CHANGED = (1, 2)
"""Numbers of segments at the beginning of the last plan that one heading replaces."""


def _first_plans() -> np.ndarray:
    """The plans that are tried at every decision, as rows: straight there; one heading for a while, or two
    for two segments each, then straight there."""
    legs = [(heading,) * count for heading in range(HEADINGS) for count in _HELD]
    legs += [(one, one, other, other) for one, other in permutations(range(HEADINGS), 2)]
    return np.array([(*leg, *(STRAIGHT,) * (SEGMENTS - len(leg))) for leg in [(), *legs]], np.int32)


_FIRST_PLANS = _first_plans()


def chosen(scenario: Scenario, world: World, choice: Int[Array, "*lanes"]) -> Float[Array, "2 *lanes"]:
    """The nominal velocity (m/s, world axes) of a choice: always at full speed."""
    x, y = world.target[0] - world.evader[0], world.target[1] - world.evader[1]
    distance = jnp.maximum(length(x, y), jnp.finfo(x.dtype).tiny)
    angle = 2.0 * jnp.pi / HEADINGS * choice.astype(x.dtype)
    straight, speed = choice == STRAIGHT, scenario.evader_speed
    return stack(
        speed * jnp.where(straight, x / distance, jnp.cos(angle)),
        speed * jnp.where(straight, y / distance, jnp.sin(angle)),
    )


@final
class Planner(EpisodePolicy):
    """A receding-horizon planner that knows the world, the rows of the shield and the pursuer's strategy.

    A plan is a choice for each of 12 segments: one of 12 headings, or straight at the target. At the
    beginning of each segment the planner imagines every plan against the pursuer's own strategy, and follows
    the one that reaches the target first. If none does within the 12 segments, it follows the one that ends
    nearest to the target, and one that is captured or collides only if all are. The rest of the last plan is
    always among them. So while chases end as imagined, it is never slower than a straight drive that is
    imagined to arrive.

    **What it does not know.** Behind a shield that looks ahead, or has a table, it imagines only the shield's
    rows (`rows_only`), which cost a twentieth. Of a pursuer that draws random numbers it imagines other
    draws.

    It is a yardstick for policies that see an observation only: what it reaches is possible, but not the
    best.

    **Arguments:** `segment` in control periods; by `Planner.of` the time in which the evader drives two
    capture distances, 2.5 s for the paper's robots.
    """

    segment: int = eqx.field(static=True)

    @classmethod
    def of(cls, scenario: Scenario) -> Planner:
        """The planner for a scenario."""
        step = float(scenario.evader_speed * scenario.control_period)
        return cls(max(1, round(2.0 * float(scenario.capture_distance) / step)))

    def init(self, world: World) -> Plan:
        return jnp.full((SEGMENTS, *world.time.shape), STRAIGHT, jnp.int32)

    def __call__(self, task: Task, episode: Episode) -> Episode:
        def planned(episode: Episode) -> Plan:
            due = episode.running & (episode.tally.steps % self.segment == 0)
            return jax.lax.cond(due, lambda: self._best(task, episode), lambda: episode.plan)

        if episode.world.lanes:
            # One lane after the other, so that none waits for the imagined chases of another.
            each = jax.tree.map(lambda leaf: jnp.moveaxis(leaf, -1, 0), episode)
            plan = jnp.moveaxis(jax.lax.map(planned, each), 0, -1)
        else:
            plan = planned(episode)
        episode = eqx.tree_at(lambda episode: episode.plan, episode, plan)
        return hold(episode, chosen(task.scenario, episode.world, plan[0]))

    def _best(self, task: Task, episode: Episode) -> Plan:
        """The plan to follow in one episode."""
        rest = jnp.append(episode.plan[1:], STRAIGHT)
        headings = jnp.arange(HEADINGS, dtype=jnp.int32)[:, None]
        changed = [jnp.where(np.arange(SEGMENTS) < count, headings, rest) for count in _CHANGED]
        plans = jnp.concatenate([rest[None], _FIRST_PLANS, *changed])
        return plans[jnp.argmin(self._costs(task, episode, plans.T))]

    def _costs(self, task: Task, episode: Episode, plans: Int[Array, "segments n"]) -> Float[Array, "n"]:
        """What the plans lead to, the least cost is best: 0 for the target, else the distance left (m)."""
        count = plans.shape[-1]
        shield = getattr(task.shield, "rows_only", task.shield)
        world, memory = in_lanes((episode.world, episode.memory), count)
        if shield is not task.shield:
            memory = start_in_lanes(shield, world)
        keys = jax.random.split(jax.random.key(0), count)

        def more(carry: Any) -> Array:
            steps, _, _, outcome, _ = carry
            undecided = jnp.any(outcome == RUNNING) & ~jnp.any(outcome == REACHED)
            return (steps < SEGMENTS * self.segment) & undecided

        def period(carry: Any) -> Any:
            steps, world, memory, outcome, survived = carry
            nominal = chosen(task.scenario, world, plans[steps // self.segment])
            drawn = jax.vmap(jax.random.fold_in, in_axes=(0, None))(keys, steps)
            world, memory, events, _, _ = control_step(
                task.scenario, shield, task.pursuer, world, memory, nominal, drawn
            )
            running = outcome == RUNNING
            outcome = jnp.where(running, outcome_of(events), outcome)
            return steps + 1, world, memory, outcome, survived + running.astype(jnp.int32)

        none = jnp.zeros(count, jnp.int32)
        begun = (jnp.zeros((), jnp.int32), world, memory, none + RUNNING, none)
        _, world, _, outcome, survived = jax.lax.while_loop(more, period, begun)
        left = length(world.target[0] - world.evader[0], world.target[1] - world.evader[1])
        lost = (outcome == CAPTURED) | (outcome == COLLIDED)
        # Any loss costs more than any distance, an early one most.
        return jnp.where(lost, 1e6 - survived.astype(left.dtype), jnp.where(outcome == REACHED, 0.0, left))
