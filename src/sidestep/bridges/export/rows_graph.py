"""The rows of the shield `game` as a graph; the barriers themselves are in `sidestep.safety.barriers`.

A row n.u >= c is kept as N = -n, which points towards the other robot, and c in units of the evader's speed.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import jax.numpy as jnp
import numpy as np

from sidestep.bridges.export.graph import Graph, Tensor
from sidestep.bridges.export.scene import Scene
from sidestep.pursuit import CaptureGame
from sidestep.safety import Budget, GameShield
from sidestep.safety.barriers import KEEP_SIDE, LOST_SIDE, STEEPER
from sidestep.safety.sampling_margin import guarded, margins

_TINY = 1e-20
_SMALLEST = 1e-30


@dataclass(frozen=True)
class Constants:
    """The numbers in the rows: distances and sizes in m, slopes in 1/s, speeds in units of the evader's."""

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
    obstacle_gain: float
    tracking_error: float
    position_doubt: float = 0.0
    heading_doubt: float = 0.0


def constants_of(shield: GameShield) -> tuple[Constants, Constants]:
    """Those of a `game` shield: of its rows, at the distances that it keeps, and of the choice of sides,
    which knows of the budget only that it leaves a doubt on which side the evader is.

    **Raises** `ValueError` for what a graph cannot hold: a scenario of fixed speed, a pursuer gain of 0, a
    shield that is told the pursuers' velocities or lets the wish pick the side.
    """
    scenario, budget = shield.scenario, shield.budget
    if scenario.action != "velocity":
        raise ValueError(
            f"scenario field 'action' = {scenario.action!r}: an ONNX filter is for 'velocity' only; "
            "export with --format jax"
        )
    if not float(scenario.pursuer_gain) > 0.0:
        raise ValueError("scenario field 'pursuer_gain' = 0: an ONNX filter needs one greater than 0")
    if shield.known_velocity or shield.wish_picks_side:
        raise ValueError("an ONNX filter has the rows of make_shield('game', scenario); this shield's differ")
    sides = _constants(shield, None)
    if budget is None:
        return sides, sides
    doubts = float(budget.position_error), float(budget.heading_error)
    return _constants(shield, budget), replace(sides, position_doubt=doubts[0], heading_doubt=doubts[1])


def _constants(shield: GameShield, budget: Budget | None) -> Constants:
    scenario, kept = shield.scenario, guarded(shield.scenario, budget)
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
        eased=float(margins(scenario, budget)[0]),
        obstacle_gain=float(scenario.obstacle_gain) / speed,
        tracking_error=0.0 if budget is None else float(budget.tracking_error) / speed,
    )


def rows_towards_all(
    graph: Graph, constants: tuple[Constants, Constants], scene: Scene, sides: Tensor
) -> tuple[list[tuple[Tensor, Tensor]], Tensor]:
    """N `(batch, 1, 2)` and c `(batch, 1, 1)` towards each pursuer, then each obstacle; and the next sides,
    `(batch, m)`.

    `constants` as `constants_of` gives them; `sides` are those of the call before: +1 left of a pursuer's
    axis, -1 right, 0 none yet.
    """
    normals, offsets, chosen = _towards_pursuers(graph, constants, scene, sides)
    rows = _one_by_one(normals, offsets, scene.pursuers)
    if scene.obstacles:
        rows += _one_by_one(*_towards_obstacles(graph, constants[0], scene), scene.obstacles)
    return rows, chosen


def _one_by_one(normals: Tensor, offsets: Tensor, count: int) -> list[tuple[Tensor, Tensor]]:
    if count == 1:
        return [(normals, offsets)]
    return [(normals.part(i, i + 1, axis=1), offsets.part(i, i + 1, axis=1)) for i in range(count)]


def _towards_obstacles(graph: Graph, constants: Constants, scene: Scene) -> tuple[Tensor, Tensor]:
    """c = n.v - gain (distance - contact)."""
    begin, end = scene.pursuers, scene.count
    normals = scene.directions.part(begin, end, axis=1)
    distances = scene.distances.part(begin, end, axis=1)
    gain = constants.obstacle_gain
    fixed = gain * constants.collision + constants.tracking_error
    weights = np.array([[-1.0 / constants.speed], [-1.0 / constants.speed], [-gain]])
    return normals, graph.join(normals * scene.drifts, distances) @ weights + fixed


def _turned(vectors: Tensor, headings: Tensor, signs: Any) -> Tensor:
    """Vectors (x, y) by headings (c, s): (signs[0] x c + signs[1] y s, signs[2] y c + signs[3] x s)."""
    terms = (vectors @ _TERMS[0]) * (headings @ _TERMS[1])
    return terms @ (np.array([[1.0, 0.0], [1.0, 0.0], [0.0, 1.0], [0.0, 1.0]]) * np.reshape(signs, (4, 1)))


_TERMS = (
    np.array([[1.0, 0.0, 0.0, 1.0], [0.0, 1.0, 1.0, 0.0]]),
    np.array([[1.0, 0.0, 1.0, 0.0], [0.0, 1.0, 0.0, 1.0]]),
)
"""They make [x c, y s, y c, x s] of (x, y) and (c, s)."""


def _towards_pursuers(
    graph: Graph, constants: tuple[Constants, Constants], scene: Scene, sides: Tensor
) -> tuple[Tensor, Tensor, Tensor]:
    """Both sides of each axis at once, [the other one, the evader's own], then the choice between them."""
    m, headings = scene.pursuers, scene.headings
    # The offset points from the evader to the pursuer; z the other way, in the pursuer's frame.
    z = _turned(scene.offsets.part(0, m, axis=1), headings, [-1.0, -1.0, -1.0, 1.0])
    end, own = graph.split((z + _SMALLEST).apply("Sign"), 1, 1)
    away = z.apply("Abs")
    shares = graph.largest(away, [_TINY, 0.0]) / graph.largest(z.over("ReduceL2"), _TINY)
    rows, choice = constants
    normal, h, rate = _both_sides(graph, rows, shares, away)
    _, seen, _ = _both_sides(graph, choice, shares, away)
    crossed = _crosses(graph, choice, away, seen, own * sides.reshape(0, m, 1))
    # -1 where the other side is followed, else +1.
    kept = (_SMALLEST - crossed).apply("Sign")
    offsets = ((rate - _allowance(graph, rows, h)) * (kept * [-0.5, 0.5] + 0.5)).over("ReduceSum")
    if rows.tracking_error:
        offsets = offsets + rows.tracking_error
    chosen = own * kept
    body = normal * graph.join(end, chosen)
    return _turned(body, headings, [-1.0, 1.0, -1.0, -1.0]), offsets, chosen.reshape(0, m)


def _both_sides(
    graph: Graph, constants: Constants, shares: Tensor, away: Tensor
) -> tuple[Tensor, Tensor, Tensor]:
    """n in the quadrant ahead and left; h (m) and the pursuer's rate V max(|n_x|, |sigma|/b), each on [the
    other side, the own]. `away` is |z| and `shares` that by its length."""
    # Along z beyond the usable angle, the tangent's within it.
    normal = graph.largest(graph.least(shares, [constants.cosine, 2.0]), [0.0, constants.sine])
    products = (normal @ _PAIRS[0]) * (away @ _PAIRS[1])
    turning = constants.pursuer_speed / constants.half_axle
    values, moments = graph.split(
        products
        @ np.array(
            [
                [1.0, 1.0, 0.0, 0.0],
                [0.0, 0.0, turning, turning],
                [0.0, 0.0, turning, -turning],
                [-1.0, 1.0, 0.0, 0.0],
            ]
        ),
        2,
        2,
    )
    straight = normal.part(0, 1) * constants.pursuer_speed
    return normal, values - constants.capture, graph.largest(moments.apply("Abs"), straight)


_PAIRS: tuple[Any, Any] = (
    np.array([[1.0, 1.0, 0.0, 0.0], [0.0, 0.0, 1.0, 1.0]]),
    np.array([[1.0, 0.0, 1.0, 0.0], [0.0, 1.0, 0.0, 1.0]]),
)
"""They make [n_x x, n_x y, n_y x, n_y y] of n and |z|."""


def _allowance(graph: Graph, constants: Constants, h: Tensor) -> Tensor:
    """alpha(h) of `PursuitBarrier`, in units of the evader's speed; it bends upwards above 0."""
    gained = h * constants.gain
    back = graph.least(gained + constants.gain * constants.eased, 0.0)
    if not np.isfinite(constants.spare) or constants.steep == constants.gain:
        return gained.apply("Relu") + back
    beyond = h * constants.steep - (constants.steep - constants.gain) * constants.spare
    return graph.largest(gained, beyond, 0.0) + back


def _crosses(graph: Graph, constants: Constants, away: Tensor, h: Tensor, same: Tensor) -> Tensor:
    """More than 0 where the side of the memory is not the evader's own (`same` is -1) and is kept all the
    same: the least of what is left of each condition, and the largest where one of two suffices."""
    across = away.part(1, 2)
    if constants.position_doubt or constants.heading_doubt:
        # On which side the evader is can be told only so well.
        doubt = away.over("ReduceL2") * constants.heading_doubt + constants.position_doubt
        doubt = graph.least(doubt, across)
        across = across - doubt
        h = h + doubt * [constants.sine, -constants.sine]
    turn = constants.cosine * constants.half_axle / constants.pursuer_speed
    ease = turn * constants.sure_speed - constants.sine * constants.capture
    reach = (_allowance(graph, constants, h) * turn + ease) - h * constants.sine
    in_front = away @ np.array([[constants.sine], [-constants.cosine]])
    h_other, h_own = graph.split(h, 1, 1)
    reach_other, reach_own = graph.split(reach, 1, 1)
    feasible = graph.least(h_other, reach_other * KEEP_SIDE - across)
    lost = graph.least(-graph.least(h_own, reach_own), LOST_SIDE * constants.capture - across)
    return graph.least(in_front, -0.5 - same, graph.largest(feasible, lost))
