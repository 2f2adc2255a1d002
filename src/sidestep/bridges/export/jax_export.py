"""Export a policy and any shield as JAX programs that run without this package."""

from __future__ import annotations

import io
import json
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
from jax import export

from sidestep._arrays import real
from sidestep._packages import needed
from sidestep.bridges.export.files import check_what, facts, write_new
from sidestep.loop.step import decide
from sidestep.safety import Shield
from sidestep.world import Scenario, World, observation_size

PLATFORMS = ("cpu", "cuda", "tpu")
"""Platforms an exported program runs on."""
_NO_DATE = (1980, 1, 1, 0, 0, 0)


def export_jax(
    path: str | Path,
    scenario: Scenario,
    policy: Callable[..., Any] | None,
    *,
    what: str = "policy+filter",
    shield: Shield,
    shield_name: str = "",
    run: str = "",
    overwrite: bool = False,
) -> dict[str, Any]:
    """Write a zip of `jax.export` programs and `about.json`; returns the content of `about.json`.

    - `policy`: `action = policy(observation)`
    - `start`: `memory = start(evader, pursuers, obstacles, target, wheel_speeds)`, a tuple of arrays
    - `step`: `velocity, status, barriers, slack, *memory = step(evader, pursuers, obstacles, target,
      wheel_speeds, *memory)`; for a `filter` the nominal velocity (m/s) comes before the memory

    Shapes as in `World`, with a symbolic batch axis in front; `joint` takes one world, without batch axis.
    Read a program with `jax.export.deserialize` and run it with `.call`; that needs jax and flatbuffers.

    **Raises** `ValueError` for an unknown `what`, a missing policy, a file that exists, or missing
    flatbuffers.
    """
    needed("flatbuffers", "export", "exporting needs")
    check_what(scenario, what, policy)
    programs: dict[str, bytes] = {}
    batched = what == "policy" or shield.takes_lanes
    if what == "policy":
        programs["policy"] = _program(policy, [real(jnp.zeros(observation_size(scenario)))], batched)
    else:
        programs = _shield_programs(scenario, policy if what == "policy+filter" else None, shield, batched)
    about = facts(
        scenario,
        what,
        None if what == "policy" else shield_name,
        run=run,
        batch="symbolic" if batched else "none: one world at a time",
        platforms=list(PLATFORMS),
        jax=jax.__version__,
        **({} if policy is None else {"decision_steps": int(getattr(policy, "decision_steps", 1))}),
    )
    write_new(path, _archive(programs, about), overwrite=overwrite)
    return about


def _shield_programs(
    scenario: Scenario, policy: Callable[..., Any] | None, shield: Shield, batched: bool
) -> dict[str, bytes]:
    m, k = scenario.pursuer_count, scenario.obstacle_count
    place = real(jnp.zeros(2))
    state = [place, real(jnp.zeros((m, 3))), real(jnp.zeros((k, 4))), place, real(jnp.zeros((m, 2)))]

    def world_of(evader: Any, pursuers: Any, obstacles: Any, target: Any, wheel_speeds: Any) -> World:
        return World(evader, pursuers, obstacles, target, wheel_speeds=wheel_speeds)

    example = shield.init(world_of(*state))
    memory, structure = jax.tree.flatten(example)

    def start(*state: Any) -> tuple[Any, ...]:
        return tuple(jax.tree.leaves(shield.init(world_of(*state))))

    def step(*arguments: Any) -> tuple[Any, ...]:
        world, rest = world_of(*arguments[:5]), arguments[5:]
        if policy is None:
            nominal, *rest = rest
        else:
            nominal = decide(scenario, policy, world)
        result, after = shield(world, nominal, jax.tree.unflatten(structure, rest))
        return (result.action, result.status, result.barriers, result.slack, *jax.tree.leaves(after))

    action = [place] if policy is None else []
    return {
        "start": _program(start, state, batched),
        "step": _program(step, [*state, *action, *memory], batched),
    }


def _program(function: Any, examples: list[Any], batched: bool) -> bytes:
    """`function` exported for arguments of these shapes and dtypes, as bytes."""
    if batched:
        function = jax.vmap(function)
        (batch,) = export.symbolic_shape("batch")
        shapes = [jax.ShapeDtypeStruct((batch, *one.shape), one.dtype) for one in examples]
    else:
        shapes = [jax.ShapeDtypeStruct(one.shape, one.dtype) for one in examples]
    return bytes(export.export(jax.jit(function), platforms=PLATFORMS)(*shapes).serialize())


def _archive(programs: dict[str, bytes], about: dict[str, Any]) -> bytes:
    """A zip file whose bytes depend only on its content."""
    buffer = io.BytesIO()
    entries = {**programs, "about.json": json.dumps(about, indent=2, sort_keys=True).encode()}
    with zipfile.ZipFile(buffer, "w") as file:
        for name, content in entries.items():
            file.writestr(zipfile.ZipInfo(name, _NO_DATE), content, zipfile.ZIP_DEFLATED)
    return buffer.getvalue()
