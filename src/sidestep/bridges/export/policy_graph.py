"""The policy's part of a graph: what it observes, and its network.

The observation is that of `sidestep.world.observe`, in an order of entries that takes few nodes: the weights
of the first layer are put into that order instead.
"""

from __future__ import annotations

import numpy as np

from sidestep.bridges.export.graph import Graph, Tensor
from sidestep.bridges.export.scene import Scene
from sidestep.learning import LearnedPolicy
from sidestep.world import Scenario, observation_names
from sidestep.world.observation import FAR_TARGET, NEAR_ROBOT, NEAR_TARGET


def network(
    graph: Graph, policy: LearnedPolicy, entries: Tensor, order: list[tuple[int | None, float]] | None = None
) -> Tensor:
    """The policy's action in [-1, 1]^2, `(batch, 2)`, for `entries (batch, n)`.

    `order` says which entry of the observation each one is, None for one that it does not have, and by what
    it is to be multiplied; by default they are the observation itself.
    """
    body = policy.actor.body
    layers = [(np.asarray(w), np.asarray(b)) for w, b in zip(body.weights, body.biases, strict=True)]
    layer = entries
    for index, (weight, bias) in enumerate(layers):
        if index == 0 and order is not None:
            none = np.zeros_like(weight[0])
            weight = np.stack([none if entry is None else scale * weight[entry] for entry, scale in order])
        layer = graph.op("Gemm", layer, weight, bias)
        layer = layer.apply("Tanh" if index == len(layers) - 1 else "Relu")
    return layer


def wished(graph: Graph, scenario: Scenario, policy: LearnedPolicy, scene: Scene) -> Tensor:
    """The velocity that the policy asks for in a scene, `(batch, 1, 2)` in world axes and units of the
    evader's speed, of length at most 1; zero where something that came in is not finite."""
    axes = _frame_axes(scene) if scenario.frame == "target" else None
    entries = _observed(graph, scenario, _nearest_first(scene), axes)
    action = network(graph, policy, entries, _order(scenario))
    action = (action / graph.largest(action.over("ReduceL2"), 1.0)).reshape(0, 1, 2) * scene.valid
    return action if axes is None else action @ axes.transpose(0, 2, 1)


def _frame_axes(scene: Scene) -> Tensor:
    """`(batch, 2, 2)` from the world's axes to the policy's, for rows: its columns are the target's direction
    (x, y), and (-y, x)."""
    ahead = scene.directions.part(scene.count, scene.count + 1, axis=1)
    return (ahead @ np.array([[1.0, 0.0, 0.0, 1.0], [0.0, -1.0, 1.0, 0.0]])).reshape(0, 2, 2)


def _nearest_first(scene: Scene) -> Scene:
    """The same scene with pursuers and obstacles sorted, as the observation has them."""
    graph, m, k = scene.graph, scene.pursuers, scene.obstacles
    if max(m, k) <= 1:
        return scene
    groups, start = [], 0
    for count in (m, k):
        rows = scene.rows.part(start, start + count, axis=1)
        if count > 1:
            distances = scene.distances.part(start, start + count, axis=1).reshape(0, -1)
            _, order = graph.several("TopK", 2, distances, np.array([count]), axis=-1, largest=0, sorted=1)
            rows = graph.op("GatherND", rows, order.reshape(0, -1, 1), batch_dims=1)
        if count:
            groups.append(rows)
        start += count
    rows = graph.join(*groups, scene.rows.part(start, start + 1, axis=1), axis=1)
    return Scene(graph, rows, m, k, scene.has_target, scene.valid)


def _observed(graph: Graph, scenario: Scenario, scene: Scene, axes: Tensor | None) -> Tensor:
    """Entries in the order of `_order`, `(batch, n)`."""
    m, k, distances = scene.pursuers, scene.obstacles, scene.distances
    contact = [float(scenario.capture_distance)] * m + [float(scenario.collision_distance)] * k + [0.0]
    scales = [NEAR_ROBOT] * (m + k) + [NEAR_TARGET]
    clearances = (distances - np.reshape(contact, (-1, 1))).apply("Relu")
    near = (clearances * np.reshape(np.divide(-1.0, scales), (-1, 1))).apply("Exp")
    far = (distances * (1.0 / FAR_TARGET)).apply("Tanh")
    squashed = scene.offsets / (distances + 1.0)
    vectors = [squashed, scene.headings, *([scene.drifts] if k else [])]
    if axes is None:
        told = graph.join(*vectors, _target_direction(scene), axis=1)
    else:
        told = graph.join(*vectors, axis=1) @ axes
    return graph.join(graph.join(near, far), told, axis=1).reshape(0, -1)


def _target_direction(scene: Scene) -> Tensor:
    """(cos, sin) of the target, zero where the evader is upon it."""
    row = scene.offsets.part(scene.count, scene.count + 1, axis=1)
    distance = scene.distances.part(scene.count, scene.count + 1, axis=1)
    return row / scene.graph.largest(distance, 1e-20)


def _order(scenario: Scenario) -> list[tuple[int | None, float]]:
    """Which entry of the observation each entry of `_observed` is, and by what to multiply it."""
    names = {name: index for index, name in enumerate(observation_names(scenario))}
    m, k = scenario.pursuer_count, scenario.obstacle_count
    robots = [f"pursuer{i}" for i in range(m)] + [f"obstacle{i}" for i in range(k)]
    wanted = [entry for robot in robots for entry in (f"{robot}_near", "")] + ["target_near", "target_far"]
    wanted += [f"{robot}_{axis}" for robot in robots for axis in "xy"] + ["", ""]
    wanted += [f"pursuer{i}_{part}" for i in range(m) for part in ("cos", "sin")]
    wanted += [f"obstacle{i}_{part}" for i in range(k) for part in ("vx", "vy")]
    if scenario.frame == "world":
        wanted += ["target_cos", "target_sin"]
    drift = 1.0 / float(scenario.evader_speed)
    return [(names.get(name), drift if name.endswith(("vx", "vy")) else 1.0) for name in wanted]
