"""The policy's part of a graph: its observation and its network.

The observation is that of `sidestep.world.observe`. The graph computes simpler terms in few nodes, and the
weights of the first layer combine them. A vector v in the policy's axes, for example, is given by v_x x,
v_y y, v_y x and v_x y, where (x, y) is the direction of the target.
"""

from __future__ import annotations

from typing import TypeAlias

import numpy as np

from sidestep.bridges.export.graph import Graph, Tensor
from sidestep.bridges.export.scene import Scene, picks
from sidestep.learning import LearnedPolicy
from sidestep.world import Scenario, observation_names
from sidestep.world.observation import FAR_TARGET, NEAR_ROBOT, NEAR_TARGET

Terms: TypeAlias = list[tuple[str, float]]
"""Of each entry: the observation it is a term of, and its factor."""


def network(
    graph: Graph,
    policy: LearnedPolicy,
    entries: Tensor,
    terms: Terms | None = None,
    names: list[str] | None = None,
) -> Tensor:
    """The policy's action in [-1, 1]^2, `(batch, 2)`, for `entries (batch, n)`.

    By default the entries are the observation. Otherwise `terms` describes them, and `names` are the names of
    the observation.
    """
    body = policy.actor.body
    layers = [(np.asarray(w), np.asarray(b)) for w, b in zip(body.weights, body.biases, strict=True)]
    layer = entries
    for index, (weight, bias) in enumerate(layers):
        if index == 0 and terms is not None and names is not None:
            weight = np.stack([scale * weight[names.index(name)] for name, scale in terms])
        layer = graph.op("Gemm", layer, weight, bias)
        layer = layer.apply("Tanh" if index == len(layers) - 1 else "Relu")
    return layer


def nominal_action(graph: Graph, scenario: Scenario, policy: LearnedPolicy, scene: Scene) -> Tensor:
    """The policy's nominal action, `(batch, 2)` in world axes and units of the evader's speed, of length at
    most 1; zero where an input is not finite."""
    action = network(
        graph, policy, *_observed(graph, scenario, _nearest_first(scene)), observation_names(scenario)
    )
    scale = scene.valid / graph.largest(action.over("ReduceL2"), 1.0)
    if scenario.frame == "world":
        return action * scale
    # (a, b) in axes along (x, y) and (-y, x).
    axes = graph.linear(scene.shortened(), _target_picks(scene, (0, 1, 1, 0)))
    both = graph.linear(action, picks(2, {0: 1.0}, {1: 1.0}, {0: 1.0}, {1: 1.0})) * axes
    return graph.linear(both, picks(4, {0: 1.0, 1: -1.0}, {2: 1.0, 3: 1.0})) * scale


def _target_picks(scene: Scene, order: tuple[int, ...]) -> np.ndarray:
    """Weights that select the target's direction from `Scene.shortened`."""
    n, k = scene.count, scene.obstacles
    return picks(2 * (n + 1 + k), *({2 * n + axis: 1.0} for axis in order))


def _nearest_first(scene: Scene) -> Scene:
    """The scene with pursuers and obstacles sorted by distance, as in the observation."""
    graph, m, k = scene.graph, scene.pursuers, scene.obstacles
    if max(m, k) <= 1:
        return scene
    groups, start = [], 0
    for count in (m, k):
        rows = scene.rows.part(start, start + count, axis=1)
        if count > 1:
            distances = scene.distances.part(start, start + count)
            _, order = graph.several("TopK", 2, distances, np.array([count]), axis=-1, largest=0, sorted=1)
            rows = graph.op("GatherND", rows, order.reshape(0, -1, 1), batch_dims=1)
        if count:
            groups.append(rows)
        start += count
    rows = graph.join(*groups, scene.rows.part(start, start + 1, axis=1), axis=1)
    return Scene(graph, rows, m, k, scene.has_target, scene.valid)


def _observed(graph: Graph, scenario: Scenario, scene: Scene) -> tuple[Tensor, Terms]:
    """Entries for the network, and their terms."""
    m, k, n = scene.pursuers, scene.obstacles, scene.count
    robots = [f"pursuer{i}" for i in range(m)] + [f"obstacle{i}" for i in range(k)]
    contact = np.array(
        [float(scenario.capture_distance)] * m + [float(scenario.collision_distance)] * k + [0.0]
    )
    scales = np.array([NEAR_ROBOT] * n + [NEAR_TARGET])
    near = graph.least(graph.linear(scene.distances, np.diag(-1.0 / scales), contact / scales), 0.0).apply(
        "Exp"
    )
    far = graph.linear(scene.distances, picks(n + 1, {n: 1.0 / FAR_TARGET})).apply("Tanh")
    terms = [(f"{robot}_near", 1.0) for robot in robots] + [("target_near", 1.0), ("target_far", 1.0)]

    # Vectors, out of p/(1 + |p|), headings and drifts.
    shortened = scene.shortened()
    width = 2 * (n + 1 + k)
    sources = (
        graph.join(shortened, scene.headings, scene.flat) if k else graph.join(shortened, scene.headings)
    )
    vectors = [(2 * i, 2 * i + 1, f"{robot}_x", f"{robot}_y", 1.0) for i, robot in enumerate(robots)]
    vectors += [(width + i, width + m + i, f"pursuer{i}_cos", f"pursuer{i}_sin", 1.0) for i in range(m)]
    drift = 1.0 / float(scenario.evader_speed)
    for i in range(k):
        begin = width + 2 * m + 4 * (m + i) + 2
        vectors.append((begin, begin + 1, f"obstacle{i}_vx", f"obstacle{i}_vy", drift))
    total = width + 2 * m + (4 * (n + 1) if k else 0)
    if scenario.frame == "world":
        columns = [index for x, y, *_ in vectors for index in (x, y)]
        terms += [(name, scale) for _, _, *names, scale in vectors for name in names]
        # Zero where the evader is at the target; the direction is not.
        row = graph.linear(scene.flat, picks(4 * (n + 1), {4 * n: 1.0}, {4 * n + 1: 1.0}))
        length = graph.linear(scene.distances, picks(n + 1, {n: 1.0}, {n: 1.0}), 1e-20)
        terms += [("target_cos", 1.0), ("target_sin", 1.0)]
        return graph.join(near, far, sources.take(columns), row / length), terms
    one = graph.linear(sources, picks(total, *({i: 1.0} for x, y, *_ in vectors for i in (x, y, y, x))))
    other = graph.linear(shortened, _target_picks(scene, (0, 1, 0, 1) * len(vectors)))
    for _, _, ahead, aside, scale in vectors:
        terms += [(ahead, scale), (ahead, scale), (aside, scale), (aside, -scale)]
    return graph.join(near, far, one * other), terms
