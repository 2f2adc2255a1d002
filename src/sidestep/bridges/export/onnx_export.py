"""A policy, a shield, or both as one ONNX model for onnxruntime alone."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from sidestep._packages import needed
from sidestep.bridges.export.exported import Exported, Field
from sidestep.bridges.export.files import as_text, check_looks_ahead, check_what, facts, write_new
from sidestep.bridges.export.graph import OPSET, Graph
from sidestep.bridges.export.onnx_code import write_numbers
from sidestep.bridges.export.program import Program
from sidestep.bridges.export.translate import translate
from sidestep.learning import LearnedPolicy
from sidestep.safety import GameShield, Shield
from sidestep.world import Scenario, observation_names, observation_size

_TEXTS = {
    "policy": "observation (see sidestep.world.observe) -> action in [-1, 1]^2, in the policy's frame",
    "filter": "state of the world, wished velocity and memory of the call before (0 at first) -> safe "
    "velocity, status and memory for the next call",
    "policy+filter": "state of the world and memory of the call before (0 at first) -> safe velocity, status "
    "and memory for the next call: the policy, then the shield",
}


def export_onnx(
    path: str | Path,
    scenario: Scenario,
    policy: LearnedPolicy | None,
    *,
    what: str = "policy+filter",
    shield: Shield | None = None,
    shield_name: str = "game",
    run: str = "",
    overwrite: bool = False,
) -> dict[str, Any]:
    """Write an ONNX model (opset 17, symbolic batch, float32); returns its metadata.

    - `policy`: `observation (batch, n)` -> `action (batch, 2)`
    - `filter`: `evader (batch, 2)`, `pursuers (batch, m, 3)`, `obstacles (batch, k, 4)` unless k = 0,
      `wish (batch, 2)` in m/s, and the shield's memory, such as `sides (batch, m)` -> `velocity (batch, 2)`
      in m/s, `status (batch,)` int32, and the memory for the next call, such as `next_sides (batch, m)`
    - `policy+filter`: the same with `target (batch, 2)`, and what else the policy observes, for `wish`

    `wish` is the nominal velocity. A memory of zeros is that of a start. The graph is translated from the
    traced JAX program, number by number (see `translate`).

    **Arguments:** `policy`, not needed for a `filter`; `shield`, by default `game` without a budget; `run`,
    the origin of the policy, stored in the metadata.

    **Raises** `ValueError` for an unknown `what`, a policy of another scenario, a shield that looks ahead or
    cannot be translated, a file that exists, or missing onnx.
    """
    needed("onnx", "export", "exporting needs")
    check_what(scenario, what, policy)
    if policy is not None:
        policy.check_shape((observation_size(scenario),))
    shield = GameShield(scenario) if shield is None else shield
    if what != "policy":
        check_looks_ahead(shield, shield_name, "ONNX")
    graph = Graph()
    _write(graph, Exported(scenario, policy, shield, what))
    about = facts(
        scenario,
        what,
        None if what == "policy" else shield_name,
        run=run,
        opset=OPSET,
        nodes=graph.size,
        **({} if policy is None else {"decision_steps": policy.decision_steps}),
        **({"observation": observation_names(scenario)} if what == "policy" else {}),
    )
    write_new(
        path, graph.model(what.replace("+", "_and_"), _TEXTS[what], as_text(about)), overwrite=overwrite
    )
    return about


def _write(graph: Graph, exported: Exported) -> None:
    """World in, safe velocity out."""
    after = [Field(f"next_{field.name}", field.shape, field.kind) for field in exported.memory]
    fields, function = [*exported.fields, *exported.memory], exported.both
    outputs = [Field("velocity", (2,), "f"), Field("status", (), "i"), *after]
    if exported.what == "policy":
        fields, outputs, function = [exported.seen], [Field("action", (2,), "f")], exported.acted
    elif exported.what == "filter":
        n = len(exported.fields)
        fields, function = [*fields[:n], exported.wish, *fields[n:]], exported.filtered
    program = Program()
    results = translate(program, function, [field.given(program) for field in fields])
    write_numbers(graph, program, fields, list(zip(outputs, results, strict=True)))
