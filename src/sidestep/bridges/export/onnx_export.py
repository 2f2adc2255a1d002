"""A policy, the filter of `game`, or both as one ONNX model for onnxruntime alone."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from sidestep.bridges.export.files import as_text, check_what, facts, write_new
from sidestep.bridges.export.filter_graph import CORRECTED, TOLERANCE, Verdict, closest
from sidestep.bridges.export.graph import OPSET, Graph, Tensor
from sidestep.bridges.export.pair_graph import closest_of_pair
from sidestep.bridges.export.policy_graph import network, nominal_action
from sidestep.bridges.export.rows_graph import constants_of, rows_towards_all
from sidestep.bridges.export.scene import NO_NUMBER, Scene, read_scene
from sidestep.learning import LearnedPolicy
from sidestep.safety import GameShield, Status
from sidestep.world import Scenario, observation_names, observation_size

_STEEP = 1e12
_TEXTS = {
    "policy": "observation (see sidestep.world.observe) -> action in [-1, 1]^2, in the policy's frame",
    "filter": "state of the world, wished velocity and sides of the call before (0 at first) -> safe "
    "velocity, status and sides for the next call: the rows of the shield 'game' and its exact filter",
    "policy+filter": "state of the world and sides of the call before (0 at first) -> safe velocity, status "
    "and sides for the next call: the policy, then the rows of the shield 'game' and its exact filter",
}


def export_onnx(
    path: str | Path,
    scenario: Scenario,
    policy: LearnedPolicy | None,
    *,
    what: str = "policy+filter",
    shield: GameShield | None = None,
    run: str = "",
    overwrite: bool = False,
) -> dict[str, Any]:
    """Write an ONNX model (opset 17, symbolic batch, float32); returns its metadata.

    - `policy`: `observation (batch, n)` -> `action (batch, 2)`
    - `filter`: `evader (batch, 2)`, `pursuers (batch, m, 3)`, `obstacles (batch, k, 4)` unless k = 0,
      `wish (batch, 2)` in m/s, `sides (batch, m)` -> `velocity (batch, 2)` in m/s, `status (batch,)` int32,
      `next_sides (batch, m)`
    - `policy+filter`: the same with `target (batch, 2)` in place of `wish`

    `wish` is the nominal velocity. The filter is that of the shield `game`; the look-ahead of `joint` does
    not fit a small graph. It answers as `GameShield(scenario)` does, for non-finite input too; coordinates
    beyond 1e15 m count as not finite. It does not go round an obstacle that blocks the robot (`goes_round`).

    **Arguments:** `policy`, not needed for a `filter`; `shield`, a `game` shield, by default without a
    budget; `run`, the origin of the policy, stored in the metadata.

    **Raises** `ValueError` for an unknown `what`, a policy of another scenario, a shield or scenario that the
    graph does not support, a file that exists, or missing onnx.
    """
    check_what(scenario, what, policy)
    if policy is not None:
        policy.check_shape((observation_size(scenario),))
    if what == "policy+filter" and scenario.observation == "motion":
        raise ValueError(
            "this policy observes the pursuers' motion (observation = 'motion'), and a graph's state of the "
            "world has no wheel speeds: export the policy and the filter apart, or use the format jax"
        )
    shield = GameShield(scenario) if shield is None else shield
    graph = Graph()
    if what == "policy":
        assert policy is not None
        size = observation_size(scenario)
        action = network(graph, policy, graph.input("observation", "batch", size))
        graph.output("action", action, "batch", 2)
    else:
        _filtered(graph, shield, None if what == "filter" else policy)
    about = facts(
        scenario,
        what,
        None if what == "policy" else "game",
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


def _filtered(graph: Graph, shield: GameShield, policy: LearnedPolicy | None) -> None:
    """World in, safe velocity out."""
    scenario, constants = shield.scenario, constants_of(shield)
    m, speed = scenario.pursuer_count, float(scenario.evader_speed)
    scene = read_scene(graph, scenario, target=policy is not None)
    nominal, outside, valid = None, [], scene.valid
    if policy is not None:
        start = nominal_action(graph, scenario, policy, scene)
    else:
        start, nominal, excess, valid = _nominal_input(graph, speed, scene)
        outside = [excess]
    rows, sides = rows_towards_all(graph, constants, scene, graph.input("sides", "batch", m))
    if (m, len(rows)) == (1, 2):
        velocity, verdict = closest_of_pair(graph, start, rows[0], rows[1], speed, nominal)
    else:
        velocity, verdict = closest(graph, start, rows, m, speed, nominal)
    graph.output("velocity", velocity, "batch", 2)
    graph.output("status", _status(graph, verdict, outside, valid), "batch", kind="INT32")
    graph.output("next_sides", sides, "batch", m)


def _status(graph: Graph, verdict: Verdict, outside: list[Tensor], valid: Tensor) -> Tensor:
    """The largest grade that applies: of the filter, of a nominal action beyond the speed limit, invalid."""
    given, flags = verdict.weights.shape
    more = len(outside) + 1
    weights = np.zeros((given + more, flags + more))
    weights[:given, :flags] = verdict.weights
    weights[given:, flags:] = np.diag([1.0] * len(outside) + [-1.0])
    bias = np.array([-TOLERANCE] * (flags + len(outside)) + [0.5])
    margins = graph.linear(graph.join(*verdict.parts, *outside, valid), _STEEP * weights, _STEEP * bias)
    applies = graph.op("Clip", margins, 0.0, 1.0)
    grades = np.array([*verdict.grades, *[CORRECTED] * len(outside), float(Status.INVALID)])
    worst = graph.op("ReduceMax", applies * grades, axes=[1], keepdims=0)
    return graph.op("Cast", worst, to=6)


def _nominal_input(graph: Graph, speed: float, scene: Scene) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """The input `wish` (m/s), the nominal action: its projection on the unit disc, itself in units of the
    speed limit, its excess over the limit, and whether all inputs are finite; the last two `(batch, 1)`."""
    given = graph.input("wish", "batch", 2)
    known = given.over("ReduceL1") < NO_NUMBER
    valid = graph.op("Cast", known, to=1) * scene.valid
    nominal = graph.where(known, given, 0.0) * (scene.valid * (1.0 / speed))
    length = nominal.over("ReduceL2")
    farthest = 1.0 / float(np.finfo(np.float32).eps)
    start = nominal / graph.largest(length, 1.0)
    # Far outside the disc only the direction matters.
    near = start * graph.largest(graph.least(length, farthest), 1.0)
    return start, near, length - 1.0, valid
