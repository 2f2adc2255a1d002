"""Many worlds of ours, stepped together: what simulation, scaling and the accelerator's section time."""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from sidestep.loop.step import control_step
from sidestep.pursuit import make_pursuer
from sidestep.safety import make_shield, start_in_lanes
from sidestep.world import Scenario, World, load_scenario, to_velocity

AHEAD = (1.0, 0.0)
"""The action of every side's policy: straight at the target."""
_BLOCK = 1024


def stepper(
    scenario: Scenario, shield: str, pursuer: str, starts: World, periods: int, *, threads: int = 1
) -> Callable[[], None]:
    """`advance()`: all worlds by `periods` control periods, in compiled calls.

    `starts` holds the worlds in front (leading axis), as `drawn` gives them. Each decides in every period,
    and starts again where it began as soon as its episode has ended; so every period of every
    world is one that is lived through. With several threads they take turns at blocks of worlds small enough
    for a core's cache; the number of worlds is then a multiple of their size, or smaller.
    """
    guard, chase = make_shield(shield, scenario), make_pursuer(pursuer)
    count = starts.evader.shape[0]
    keys = jax.random.split(jax.random.key(1), count)
    size = count if threads == 1 else min(_BLOCK, max(1, count // threads))
    cuts = [slice(first, first + size) for first in range(0, count, size)]

    def period(start: World, at_start: Any, world: World, memory: Any, key: Any) -> tuple[World, Any]:
        ahead = jnp.broadcast_to(jnp.asarray(AHEAD, world.evader.dtype)[:, None], world.evader.shape)
        nominal = to_velocity(scenario, world, ahead)
        moved, after, events, _, _ = control_step(scenario, guard, chase, world, memory, nominal, key)
        ended = events.terminated | events.truncated
        again = lambda fresh, old: jnp.where(ended, fresh, old)  # noqa: E731
        return jax.tree.map(again, start, moved), jax.tree.map(again, at_start, after)

    @jax.jit
    def program(starts: World, at_start: Any, state: tuple[World, Any], keys: Any) -> tuple[World, Any]:
        def body(state: tuple[World, Any], _: None) -> tuple[tuple[World, Any], None]:
            return period(starts, at_start, *state, keys), None

        return jax.lax.scan(body, state, None, length=periods)[0]

    starts = jax.tree.map(lambda leaf: jnp.moveaxis(leaf, 0, -1), starts)
    blocks = [jax.tree.map(lambda leaf: leaf[..., cut], starts) for cut in cuts]  # noqa: B023
    memories = [eqx.filter_jit(start_in_lanes)(guard, block) for block in blocks]
    states = list(zip(blocks, memories, strict=True))
    keys = [keys[cut] for cut in cuts]

    def go_on(block: int) -> None:
        moved = program(blocks[block], memories[block], states[block], keys[block])
        states[block] = jax.block_until_ready(moved)

    pool, compiled = ThreadPoolExecutor(threads), False

    def advance() -> None:
        nonlocal compiled
        if len(blocks) == 1 or not compiled:
            # Else each thread would compile it.
            for block in range(len(blocks)):
                go_on(block)
            compiled = True
            return
        for _ in pool.map(go_on, range(len(blocks))):
            pass

    return advance


def drawn(scenario: Scenario, count: int, seed: int = 0) -> World:
    """`count` worlds as episodes start."""
    return jax.jit(jax.vmap(scenario.reset))(jax.random.split(jax.random.key(seed), count))


def crowded(count: int, obstacles: int, pursuers: int, seed: int = 0) -> tuple[Scenario, World]:
    """A scenario with that many of each, and worlds drawn evenly over a square that grows with their number.

    Starts are not checked as episodes' are: how long the arithmetic takes does not depend on it.
    """
    scenario = load_scenario("paper", obstacle_count=obstacles, pursuer_count=pursuers)
    half = 2.0 * np.sqrt(1.0 + obstacles + pursuers)
    random = np.random.default_rng(seed)

    def place(*shape: int) -> Any:
        return random.uniform(-half, half, (count, *shape))

    headings = random.uniform(-np.pi, np.pi, (count, pursuers, 1))
    drift = np.broadcast_to([0.02, 0.0], (count, obstacles, 2))
    worlds = jax.vmap(World)(
        jnp.asarray(place(2), dtype=float),
        jnp.asarray(np.concatenate([place(pursuers, 2), headings], axis=-1), dtype=float),
        jnp.asarray(np.concatenate([place(obstacles, 2), drift], axis=-1), dtype=float),
        jnp.asarray(place(2), dtype=float),
    )
    return scenario, worlds
