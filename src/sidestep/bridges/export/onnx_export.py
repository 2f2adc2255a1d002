"""A policy, the filter of `game`, or both as one ONNX model for onnxruntime alone."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from sidestep.bridges.export.files import as_text, check_what, facts, write_new
from sidestep.bridges.export.filter_graph import CORRECTED, TOLERANCE, Verdict, closest
from sidestep.bridges.export.graph import OPSET, Graph, Tensor
from sidestep.bridges.export.pair_graph import closest_of_pair
from sidestep.bridges.export.policy_graph import network, wished
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
    """Write an ONNX model (opset 17, symbolic batch, float32) and return what it says about itself.

    - `policy`: `observation (batch, n)` -> `action (batch, 2)`
    - `filter`: `evader (batch, 2)`, `pursuers (batch, m, 3)`, `obstacles (batch, k, 4)` unless k = 0,
      `wish (batch, 2)` in m/s, `sides (batch, m)` -> `velocity (batch, 2)` in m/s, `status (batch,)` int32,
      `next_sides (batch, m)`
    - `policy+filter`: the same with `target (batch, 2)` in place of `wish`

    The filter is that of the shield `game`: what `joint` adds, looking ahead, does not fit a small graph. It
    answers as `GameShield(scenario)` does, non-finite input included; coordinates beyond 1e15 m count as not
    finite. It does not go round an obstacle that the robot is stuck behind (`goes_round`).

    **Arguments:** `policy` is not needed for a `filter`; `shield` a `game` shield with its budget, the plain
    one by default; `run` where the policy came from, for the record.

    **Raises** `ValueError` for an unknown `what`, a policy of another scenario, a shield or scenario that a
    graph cannot hold, a file that exists, or where onnx is not installed.
    """
    check_what(scenario, what, policy)
    if policy is not None:
        _check_policy(scenario, policy)
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


def _check_policy(scenario: Scenario, policy: LearnedPolicy) -> None:
    wanted, given = policy.actor.body.weights[0].shape[0], observation_size(scenario)
    if wanted != given:
        raise ValueError(
            f"this policy was trained on observations of {wanted} entries, this scenario has {given}: use "
            "the frame, pursuer_count and obstacle_count of its training"
        )


def _filtered(graph: Graph, shield: GameShield, policy: LearnedPolicy | None) -> None:
    """World in, safe velocity out."""
    scenario, constants = shield.scenario, constants_of(shield)
    m, speed = scenario.pursuer_count, float(scenario.evader_speed)
    scene = read_scene(graph, scenario, target=policy is not None)
    wish, outside, valid = None, [], scene.valid
    if policy is not None:
        start = wished(graph, scenario, policy, scene)
    else:
        start, wish, excess, valid = _given_wish(graph, speed, scene)
        outside = [excess]
    rows, sides = rows_towards_all(graph, constants, scene, graph.input("sides", "batch", m))
    if (m, len(rows)) == (1, 2):
        velocity, verdict = closest_of_pair(graph, start, rows[0], rows[1], speed, wish)
    else:
        velocity, verdict = closest(graph, start, rows, m, speed, wish)
    graph.output("velocity", velocity, "batch", 2)
    graph.output("status", _status(graph, verdict, outside, valid), "batch", kind="INT32")
    graph.output("next_sides", sides, "batch", m)


def _status(graph: Graph, verdict: Verdict, outside: list[Tensor], valid: Tensor) -> Tensor:
    """The largest grade that applies: the filter's, corrected for a wish beyond the speed limit, invalid."""
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


def _given_wish(graph: Graph, speed: float, scene: Scene) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """The input `wish` (m/s): its projection on the unit disc, itself in units of the speed limit, by how
    much it lies outside, and whether everything that came in was finite; the last two `(batch, 1)`."""
    given = graph.input("wish", "batch", 2)
    known = given.over("ReduceL1") < NO_NUMBER
    valid = graph.op("Cast", known, to=1) * scene.valid
    wish = graph.where(known, given, 0.0) * (scene.valid * (1.0 / speed))
    length = wish.over("ReduceL2")
    farthest = 1.0 / float(np.finfo(np.float32).eps)
    start = wish / graph.largest(length, 1.0)
    # Far out only its direction matters.
    near = start * graph.largest(graph.least(length, farthest), 1.0)
    return start, near, length - 1.0, valid
