"""The rows of the shield `game` as a graph; its barriers are in `safety.barriers`.

A row n.u >= c is stored as N = -n, which points towards the other robot, and c in units of the evader's
speed.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import jax.numpy as jnp
import numpy as np

from sidestep.bridges.export.graph import Graph, Tensor
from sidestep.bridges.export.levels_graph import Row
from sidestep.bridges.export.scene import Scene, for_each, picks
from sidestep.pursuit import CaptureGame
from sidestep.safety import GameShield
from sidestep.safety.barriers.pursuit_barrier import KEEP_SIDE, LOST_SIDE, STEEPER
from sidestep.safety.barriers.sampling_margin import sampling_margin, with_margins

_SMALLEST = 1e-30


@dataclass(frozen=True)
class Constants:
    """The constants of the rows: distances in m, gains in 1/s, speeds in units of the evader's.

    `unlost` is the sampling margin (m): within it, the evader's side does not count as lost.
    """

    speed: float
    pursuer_speed: float
    sure_speed: float
    half_axle: float
    capture: float
    collision: float
    cosine: float
    sine: float
    gain: float
    steep: float
    spare: float
    eased: float
    unlost: float
    obstacle_gain: float
    tracking_error: float
    position_doubt: float = 0.0
    heading_doubt: float = 0.0


def constants_of(shield: GameShield) -> tuple[Constants, Constants]:
    """The constants of a `game` shield's rows, and those of its choice of sides, where the budget also makes
    the evader's side uncertain.

    **Raises** `ValueError` for what the graph does not support: a scenario of fixed speed, a pursuer gain of
    0, a shield that gets the pursuers' velocities or lets the nominal action choose the side.
    """
    scenario, budget = shield.scenario, shield.budget
    if scenario.action != "velocity":
        raise ValueError(
            f"scenario field 'action' = {scenario.action!r}: an ONNX filter is for 'velocity' only; "
            "export with --format jax"
        )
    if not float(scenario.pursuer_gain) > 0.0:
        raise ValueError("scenario field 'pursuer_gain' = 0: an ONNX filter needs one greater than 0")
    if shield.known_velocity or shield.nominal_picks_side:
        raise ValueError("an ONNX filter has the rows of make_shield('game', scenario); this shield's differ")
    kept = _constants(shield)
    if budget is None:
        return kept, kept
    doubts = float(budget.position_error), float(budget.heading_error)
    return kept, replace(kept, position_doubt=doubts[0], heading_doubt=doubts[1])


def _constants(shield: GameShield) -> Constants:
    scenario, budget = shield.scenario, shield.budget
    kept = with_margins(scenario, budget)
    game, speed = CaptureGame.of(kept), float(scenario.evader_speed)
    usable = game.usable_angle
    gain = float(scenario.pursuer_gain)
    turning = float(game.pursuer_speed * jnp.tan(usable) / game.half_axle)
    return Constants(
        speed=speed,
        pursuer_speed=float(game.pursuer_speed) / speed,
        sure_speed=float(game.evader_speed) / speed,
        half_axle=float(game.half_axle),
        capture=float(game.capture_distance),
        collision=float(kept.collision_distance),
        cosine=float(jnp.cos(usable)),
        sine=float(jnp.sin(usable)),
        gain=gain / speed,
        steep=max(gain, STEEPER * turning) / speed,
        spare=max(float(game.largest_capture_distance - game.capture_distance), 0.0),
        eased=float(sampling_margin(scenario)),
        unlost=float(sampling_margin(scenario)) if budget is None else 0.0,
        obstacle_gain=float(scenario.obstacle_gain) / speed,
        tracking_error=0.0 if budget is None else float(budget.tracking_error) / speed,
    )


def rows_towards_all(
    graph: Graph, constants: tuple[Constants, Constants], scene: Scene, sides: Tensor
) -> tuple[list[Row], Tensor]:
    """The rows towards each pursuer, then each obstacle; and the next sides, `(batch, m)`.

    `constants` as from `constants_of`; `sides` of the previous call: +1 left of a pursuer's axis, -1 right,
    0 none yet.
    """
    normals, offsets, chosen = _towards_pursuers(graph, constants, scene, sides)
    rows = _one_by_one(normals, offsets, scene.pursuers)
    if scene.obstacles:
        rows += _one_by_one(*_towards_obstacles(graph, constants[0], scene), scene.obstacles)
    return rows, chosen


def _one_by_one(normals: Tensor, offsets: Tensor, count: int) -> list[Row]:
    if count == 1:
        return [(normals, offsets)]
    return [(normals.part(2 * i, 2 * i + 2), offsets.part(i, i + 1)) for i in range(count)]


def _towards_obstacles(graph: Graph, constants: Constants, scene: Scene) -> tuple[Tensor, Tensor]:
    """c = n.v - gain (distance - contact)."""
    m, k, gain = scene.pursuers, scene.obstacles, constants.obstacle_gain
    begin = 2 * scene.robots
    normals = scene.shortened().part(begin, begin + 2 * k)
    drifts = scene.flat.take([4 * (m + i) + axis for i in range(k) for axis in (2, 3)])
    fixed = gain * constants.collision + constants.tracking_error
    near = graph.linear(scene.distances, picks(scene.robots, *({m + i: -gain} for i in range(k))), fixed)
    along = for_each(k, [[-1.0 / constants.speed], [-1.0 / constants.speed]])
    return normals, graph.linear(normals * drifts, along, added=near)


def _towards_pursuers(
    graph: Graph, constants: tuple[Constants, Constants], scene: Scene, sides: Tensor
) -> tuple[Tensor, Tensor, Tensor]:
    """N `(batch, 2 m)`, c `(batch, m)` and the chosen sides."""
    m, (rows, choice) = scene.pursuers, constants
    # Rotations use the products [x c, y s, y c, x s] of a vector (x, y) and a heading (c, s).
    turn = graph.linear(scene.headings, picks(2 * m, *({j: 1.0} for i in range(m) for j in (i, m + i) * 2)))
    places = picks(4 * scene.robots, *({4 * i + j: 1.0} for i in range(m) for j in (0, 1, 1, 0)))
    # Scene rows point from the evader to the pursuer; z is the opposite, in the pursuer's frame. Where z is
    # 0 it counts as ahead and left.
    z = graph.linear(
        graph.linear(scene.flat, places) * turn,
        for_each(m, [[-1.0, 0.0], [-1.0, 0.0], [0.0, -1.0], [0.0, 1.0]]),
        np.tile([1e-30, 1e-36], m),
    )
    signs, away = z.apply("Sign"), z.apply("Abs")
    lengths = picks(scene.robots, *({i: 1.0} for i in range(m) for _ in (0, 1)))
    shares = away / graph.linear(scene.distances, lengths, 1e-30)

    bends = _bends(graph, rows, shares, m)
    middle, half, *margins = _both_sides(graph, rows, bends, away, None, m)
    if choice is not rows:
        doubt = _doubt(graph, choice, scene, away)
        _, _, *margins = _both_sides(graph, choice, _bends(graph, choice, shares, m), away, doubt, m)
    own = signs.take([2 * i + 1 for i in range(m)])
    # -1 where the chosen side is not the one the evader is on, else +1.
    kept = (_SMALLEST - _crosses(graph, margins, own * sides)).apply("Sign")
    chosen = own * kept
    offsets = middle + kept * half
    if rows.tracking_error:
        offsets = offsets + rows.tracking_error

    both = graph.join(signs, chosen)
    pointing = graph.linear(
        both, picks(3 * m, *({j: 1.0} for i in range(m) for j in (2 * i, 2 * m + i, 2 * m + i, 2 * i)))
    )
    cosine, sine = rows.cosine, rows.sine
    normal = graph.linear(
        bends,
        for_each(m, [[-1.0, 0.0, 0.0, -1.0], [0.0, 1.0, 1.0, 0.0]]),
        np.tile([cosine, sine, sine, cosine], m),
    )
    back = for_each(m, [[-1.0, 0.0], [1.0, 0.0], [0.0, -1.0], [0.0, -1.0]])
    return graph.linear(pointing * normal * turn, back), offsets, chosen


def _bends(graph: Graph, constants: Constants, shares: Tensor, m: int) -> Tensor:
    """Deviation of n from the tangent's normal, in the quadrant ahead and left: n = (cos S - first, sin S +
    second). It is 0 within the usable angle S; beyond it n points along z. `shares` is |z| over its
    length."""
    limits = np.tile([constants.cosine, -constants.sine], m)
    return graph.linear(shares, for_each(m, np.diag([-1.0, 1.0])), limits).apply("Relu")


def _doubt(graph: Graph, constants: Constants, scene: Scene, away: Tensor) -> Tensor:
    """Uncertainty (m) of the evader's distance from the axis, at most that distance, `(batch, m)`."""
    m = scene.pursuers
    lengths = picks(scene.robots, *({i: constants.heading_doubt} for i in range(m)))
    return graph.least(
        graph.linear(scene.distances, lengths, constants.position_doubt),
        away.take([2 * i + 1 for i in range(m)]),
    )


def _both_sides(
    graph: Graph, constants: Constants, bends: Tensor, away: Tensor, doubt: Tensor | None, m: int
) -> list[Tensor]:
    """Mean and half difference of the row offsets for the two sides of each pursuer's axis, and the margins
    of `_crosses`; each `(batch, m)`.

    All are piecewise linear in the products of n and z, and computed as a network of two layers with ReLU:
    |a| = (a)+ + (-a)+, max(a, b) = b + (a - b)+, and so on.
    """
    cosine, sine = constants.cosine, constants.sine
    normal = graph.linear(
        bends,
        for_each(m, [[-1.0, -1.0, 0.0, 0.0], [0.0, 0.0, 1.0, 1.0]]),
        np.tile([cosine, cosine, sine, sine], m),
    )
    place = graph.linear(away, for_each(m, [[1.0, 0.0, 1.0, 0.0], [0.0, 1.0, 0.0, 1.0]]))
    terms = graph.join(normal * place, bends, away, *([] if doubt is None else [doubt]))
    inner, outer = _layers(constants)
    widths = (4, 2, 2) if doubt is None else (4, 2, 2, 1)
    places = [sum(widths[:j]) * m + widths[j] * i + entry for i in range(m) for j in range(len(widths))
              for entry in range(widths[j])]  # fmt: skip
    used = sum(widths)
    first = np.zeros((used * m, m * inner.shape[1]))
    first[places] = for_each(m, inner[:used])
    # Ordered by quantity, then by pursuer.
    second = (
        for_each(m, outer[:-1])
        .reshape(-1, m, outer.shape[1])
        .transpose(0, 2, 1)
        .reshape(len(outer[:-1]) * m, -1)
    )
    hidden = graph.linear(terms, first, np.tile(inner[-1], m)).apply("Relu")
    found = graph.linear(hidden, second, np.repeat(outer[-1], m))
    return graph.split(found, *[m] * outer.shape[1])


def _layers(constants: Constants) -> tuple[np.ndarray, np.ndarray]:
    """Weights of the two layers for one pursuer: a row per input, then the bias.

    Inputs: n_x x, n_x y, n_y x, n_y y, both values of `_bends`, x and y of |z|, the result of `_doubt`.
    """
    one = np.eye(10)
    n_x_x, n_x_y, n_y_x, n_y_y, bend, _, ahead, aside, doubt, unit = one
    turning = constants.pursuer_speed / constants.half_axle
    straight = constants.pursuer_speed * (constants.cosine * unit - bend)
    inner, outer_rows = [], []

    def positive(form: np.ndarray) -> int:
        inner.append(form)
        return len(inner) - 1

    sides = []
    for sign in (-1.0, 1.0):
        h = n_x_x + sign * n_y_y - constants.capture * unit - sign * constants.sine * doubt
        moment = turning * (n_x_y - sign * n_y_x)
        sides.append(
            (
                positive(h),
                positive(-h),
                positive(-h - constants.eased * unit),
                positive(h - min(constants.spare, 1e9) * unit),
                positive(moment - straight),
                positive(-moment - straight),
            )
        )
    base, across = positive(straight), positive(aside - doubt)
    front = constants.sine * ahead - constants.cosine * aside
    front_up, front_down = positive(front), positive(-front)

    size = len(inner) + 1
    hidden = np.eye(size)
    bias = hidden[-1]
    heights, offsets, reaches = [], [], []
    for up, down, beyond, steep, left, right in sides:
        height = hidden[up] - hidden[down]
        allowed = (
            constants.gain * (hidden[up] - hidden[beyond])
            + (constants.steep - constants.gain) * hidden[steep]
        )
        turn = constants.cosine * constants.half_axle / constants.pursuer_speed
        heights.append(height)
        offsets.append(hidden[base] + hidden[left] + hidden[right] - allowed)
        reaches.append(
            turn * (allowed + constants.sure_speed * bias)
            - constants.sine * (height + constants.capture * bias)
        )
    outer_rows = [
        (offsets[0] + offsets[1]) / 2.0,
        (offsets[1] - offsets[0]) / 2.0,
        hidden[front_up] - hidden[front_down],
        heights[0],
        KEEP_SIDE * reaches[0] - hidden[across],
        -heights[1] - constants.unlost * bias,
        -reaches[1],
        LOST_SIDE * constants.capture * bias - hidden[across],
    ]
    return np.stack(inner, axis=1), np.stack(outer_rows, axis=1)


def _crosses(graph: Graph, margins: list[Tensor], same: Tensor) -> Tensor:
    """Positive where the remembered side differs from the evader's side (`same` is -1) and is kept. It is the
    minimum over the conditions' margins, or the maximum where one of two conditions suffices."""
    in_front, other, other_reach, lost, lost_reach, narrow = margins
    feasible = graph.least(other, other_reach)
    hopeless = graph.least(graph.largest(lost, lost_reach), narrow)
    return graph.least(graph.least(in_front, -same), graph.largest(feasible, hopeless))
