"""From rows to a shield's answer: drop what is not finite, ask the filter, give the status."""

from __future__ import annotations

import functools

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from sidestep._arrays import AnyArray, fold, stack
from sidestep.safety.barriers.barrier import BarrierRows, ObstacleBarrier, compose
from sidestep.safety.filter.least_violation import root
from sidestep.safety.filter.projection import project
from sidestep.safety.filter.status import Status
from sidestep.safety.shields.shield import ShieldResult
from sidestep.world.scenario import Scenario
from sidestep.world.state import World


def known_parts(world: World) -> Bool[Array, "n *lanes"]:
    """For each pursuer and obstacle: whether its pose and the evader's position are finite.

    The world itself is asked, because a NaN can vanish on its way into a row: every comparison with it is
    false, and a `where` then takes the other case.
    """
    evader = _finite(world.evader)
    return jnp.concatenate([_finite(group, 1) & evader for group in (world.pursuers, world.obstacles)])


def _finite(components: Float[AnyArray, "..."], axis: int = 0) -> Bool[Array, "..."]:
    parts = (jax.lax.index_in_dim(components, i, axis, False) for i in range(components.shape[axis]))
    return functools.reduce(jnp.logical_and, map(jnp.isfinite, parts))


def decide(
    scenario: Scenario,
    world: World,
    nominal: Float[AnyArray, "2 *lanes"],
    rows: BarrierRows,
    *,
    enforced: bool,
    hard: int,
    known: Bool[Array, "n *lanes"] | None = None,
) -> ShieldResult:
    """The answer of a shield with these rows.

    **Arguments:** `enforced`: whether the rows are kept at all; `hard` the number of leading rows that are
    kept before the others; `known`: for each row, whether its robot and the evader are finite, by default
    from the world.
    """
    nominal = jnp.asarray(nominal, rows.values.dtype)
    known = known_parts(world) if known is None else known
    known &= jnp.isfinite(rows.values)
    if enforced:
        known &= jnp.isfinite(rows.offsets) & _finite(rows.normals, 1)
    finite = _finite(nominal)
    everything = fold(jnp.logical_and, known, True)
    # With part of the world unknown the nominal action counts as a stop.
    wanted = stack(*(jnp.where(everything, component, 0.0) for component in nominal))
    count = rows.offsets.shape[0] if enforced else 0
    projection = project(
        wanted,
        rows.normals[:count],
        jnp.where(known, rows.offsets, jnp.nan)[:count],
        scenario.evader_speed,
        hard=hard if enforced else 0,
        circle=scenario.action == "heading",
    )
    status = jnp.where(everything, projection.status, Status.INVALID).astype(projection.status.dtype)
    return ShieldResult(
        action=projection.action,
        status=status,
        barriers=jnp.where(known, rows.values, -jnp.inf),
        slack=projection.slack,
        intervention=correction(projection.action, jnp.where(finite, nominal, 0.0)),
    )


def correction(
    action: Float[AnyArray, "2 *lanes"], nominal: Float[AnyArray, "2 *lanes"]
) -> Float[Array, "*lanes"]:
    """|action - nominal| in m/s. Components of `nominal` beyond 1e15 m/s count as 1e15 m/s, because their
    squares, and so every sum of corrections, would be infinite."""
    x, y = (new - jnp.clip(old, -1e15, 1e15) for new, old in zip(action, nominal, strict=True))
    return root(x * x + y * y)


def as_changed(
    result: ShieldResult, nominal: Float[AnyArray, "2 *lanes"], changed: Bool[Array, "*lanes"]
) -> ShieldResult:
    """The answer to an action that a shield put in place of `nominal` (where `changed`), as one to `nominal`:
    at least `CORRECTED`, and with the whole intervention."""
    moved = correction(result.action, jnp.where(_finite(nominal), nominal, 0.0))
    return eqx.tree_at(
        lambda result: (result.status, result.intervention),
        result,
        (
            jnp.where(changed, jnp.maximum(result.status, Status.CORRECTED), result.status),
            jnp.where(changed, moved, result.intervention),
        ),
    )


def obstacle_rows(scenario: Scenario, world: World) -> BarrierRows:
    """The rows of `ObstacleBarrier` towards all obstacles."""
    barrier = ObstacleBarrier()
    return barrier.rows(scenario, world, barrier.update_memories(scenario, world))


def with_obstacles(towards_pursuers: BarrierRows, scenario: Scenario, world: World) -> BarrierRows:
    """The rows towards pursuers, then those of `ObstacleBarrier` towards all obstacles."""
    return compose(towards_pursuers, obstacle_rows(scenario, world))
