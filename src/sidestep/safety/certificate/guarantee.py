"""The certificate: is the evader guaranteed never to be captured, from where, and how near does it get?

For one pursuer in the unbounded plane that may react at any instant, and an evader that decides once per
control period from measurements with bounded errors and age. The budget is

    l' = l + position + b rho heading + delay + sampling + tracking + sides  <=  l_max,

with the parts

- `position`, `heading`: what the errors can hide of the barrier, which changes by at most 1 per metre and
  b rho per rad
- `delay`: what the pursuer can gain unseen, v_e tau
- `sampling`: delta(T) of `sampled_design`
- `tracking`: what the same computation needs in addition if the motors do not drive the commanded velocity
- `sides`: what it needs beyond these parts, because an evader that measures with errors cannot always tell on
  which side of the pursuer's axis it is
"""

from __future__ import annotations

import math
from collections.abc import Callable, Collection
from dataclasses import replace

import numpy as np

from sidestep._bounds import DELAY, DISTANCE, HEADING_ERROR, TRACKING_ERROR, Bound, taken
from sidestep.safety.certificate.certificate import Certificate
from sidestep.safety.certificate.claims import claims_of
from sidestep.safety.certificate.nearest_changes import (
    MINE,
    Change,
    PairChange,
    check_mine,
    nearest_changes,
    nearest_pairs,
)
from sidestep.safety.certificate.obstacles import obstacle_clearance
from sidestep.safety.certificate.shield_check import shield_level
from sidestep.safety.certificate.situation import Situation, plain, situation_of
from sidestep.safety.certificate.survival import survival
from sidestep.safety.sampled.flow_map import seen_from, side_value
from sidestep.safety.sampled.sampled_design import (
    best_design,
    broken_level,
    delay_cost,
    outruns,
    tightest_angle,
)
from sidestep.safety.sampled.sampled_game import Design, SampledGame
from sidestep.safety.shields.adapted import covered, of_control_point
from sidestep.world.scenario import Scenario

_PLACE = Bound(shape=(2,), least=-1e6, most=1e6, unit="m")


def certify(
    scenario: Scenario,
    *,
    position_error: float = 0.0,
    heading_error: float = 0.0,
    delay: float = 0.0,
    own_motion_predicted: bool = True,
    tracking_error: float = 0.0,
    walls: bool = False,
    start: tuple[float, float] | None = None,
    target_distance: float | None = None,
    half_axle: float | None = None,
    control_period: float | None = None,
    check_shield: bool = True,
    obstacles: bool = False,
    obstacle: tuple[float, float] | None = None,
    search_drift: bool = False,
    mine: Collection[str] = MINE,
    progress: Callable[[str], None] | None = None,
) -> Certificate:
    """What can be guaranteed for a scenario's robots.

    For custom robots (`EvaderModel`, `PursuerModel`) the certificate is about the evader's control point, at
    distances that are longer by the offset, and about the differential drive that covers the pursuer.

    **Arguments:**

    - `position_error` m and `heading_error` rad bound every measurement of the pursuer; `delay` s is its age
    - `own_motion_predicted`: the evader adds its own motion during the delay
    - `tracking_error` m/s bounds |velocity driven - commanded velocity|
    - `walls`: the robots are in a bounded arena
    - `start` m, the evader in the pursuer's frame
    - `target_distance` m, used where the pursuer wins
    - `half_axle` m, `control_period` s, in place of the scenario's; they may be 0 here
    - `check_shield`: also compute what the shipped `game` shield keeps
    - `obstacles`: also say what can be kept from obstacles, by the clearance table, which takes minutes where
      none comes with sidestep; `obstacle` m, the place of one in the pursuer's frame to check with the
      `start`
    - `search_drift`: also search for the fastest drift of an obstacle that can be kept, for minutes
    - `mine`: what can be changed, of `nearest_changes.WHOSE` (evader, sensing, task, pursuer). These come
      first among the changes that would help, and are tried in pairs
    - `progress` gets, in words, what is computed next

    **Raises** `ValueError` naming the argument, its value and what is allowed.
    """
    tell = progress or (lambda _: None)
    for name, value, bound in (
        ("position_error", position_error, DISTANCE), ("heading_error", heading_error, HEADING_ERROR),
        ("delay", delay, DELAY), ("tracking_error", tracking_error, TRACKING_ERROR),
        ("target_distance", target_distance, DISTANCE), ("half_axle", half_axle, DISTANCE),
        ("control_period", control_period, DELAY), ("start", start, _PLACE), ("obstacle", obstacle, _PLACE),
    ):  # fmt: skip
        if value is not None:
            taken(name, value, bound)
    check_mine(mine)
    if obstacle is not None and start is None:
        raise ValueError(f"obstacle = {obstacle!r}: give the start, too, from which it is to be checked")
    situation = situation_of(scenario, half_axle, control_period, walls)
    game = replace(
        situation.game,
        position_error=float(position_error),
        heading_error=float(heading_error),
        delay=float(delay),
        own_motion_predicted=own_motion_predicted,
        tracking_error=float(tracking_error),
    )
    situation = replace(situation, game=game)
    tell("what can be held at this period")
    certificate = _answer(situation, mine, tell)
    if start is not None:
        margin = None if certificate.control_set is None else start_margin(certificate, start)
        certificate = replace(certificate, start=start, start_margin=margin)
    if check_shield and game.half_axle > 0.0 and game.control_period > 0.0 and game.evader_speed > 0.0:
        tell("what the game shield keeps")
        certificate = replace(certificate, shield=shield_level(covered(of_control_point(scenario))))
    if certificate.pursuer_wins or target_distance is not None:
        tell("how long the evader lasts")
        distance = plain(scenario.initial_separation)
        lasts = survival(game, situation.capture_distance, start, distance)
        certificate = replace(certificate, survival=lasts, target_distance=target_distance)
    if obstacles or search_drift or obstacle is not None:
        certificate = _with_obstacles(certificate, scenario, start, obstacle, search_drift, tell)
    return replace(certificate, claims=claims_of(certificate))


def _with_obstacles(
    certificate: Certificate,
    scenario: Scenario,
    start: tuple[float, float] | None,
    obstacle: tuple[float, float] | None,
    search_drift: bool,
    tell: Callable[[str], None],
) -> Certificate:
    """The certificate with what can be kept from obstacles, or why nothing can be said."""
    game = certificate.situation.game
    if certificate.situation.walls or certificate.situation.pursuer_count != 1:
        return replace(certificate, no_obstacles="it is computed for one pursuer in the open")
    if any((game.position_error, game.heading_error, game.delay, game.tracking_error)):
        return replace(certificate, no_obstacles="it is computed for exact measurements and motors")
    try:
        found = obstacle_clearance(
            scenario, start=start, obstacle=obstacle, search_drift=search_drift, tell=tell
        )
    except ValueError as error:
        return replace(certificate, no_obstacles=str(error))
    return replace(certificate, obstacles=found)


def _answer(situation: Situation, mine: Collection[str], tell: Callable[[str], None]) -> Certificate:
    game, wanted = situation.game, situation.capture_distance
    clearance, budget, held = clearance_of(situation)
    in_the_open = clearance >= wanted
    alone = not situation.walls and situation.pursuer_count == 1
    guaranteed = in_the_open and alone
    changes: tuple[Change, ...] = ()
    pairs: tuple[PairChange, ...] = ()
    if not guaranteed:
        tell("the nearest changes that make it hold")
        changes = nearest_changes(situation, clearance, mine)
        pairs = nearest_pairs(situation, budget, changes, mine)
    needed = wanted + delay_cost(game)
    control, start = _sets(game, needed if in_the_open else None, held) if alone else (None, None)
    unsure = 0.0
    if held is not None and math.isfinite(held.level):
        tell("the grid's error")
        unsure = max(broken_level(game, held) - held.level, 0.0)
    return Certificate(
        situation=situation,
        guaranteed=guaranteed,
        reason=_reason(situation, in_the_open),
        pursuer_wins=wanted > game.largest_capture_distance,
        guaranteed_clearance=clearance if alone else 0.0,
        largest_capture_distance=game.largest_capture_distance,
        budget=budget,
        grid_error=unsure,
        nearest_changes=changes,
        nearest_pairs=pairs,
        control_set=control,
        start_set=start,
    )


def clearance_of(situation: Situation) -> tuple[float, dict[str, float], Design | None]:
    """What an evader alone with one pursuer in the open can keep for ever (m), the budget, and what holds it.

    The capture distance is guaranteed if the clearance is at least that.
    """
    game, wanted = situation.game, situation.capture_distance
    limit = game.largest_capture_distance
    tracked = replace(game, position_error=0.0, heading_error=0.0, delay=0.0)
    exact = replace(tracked, tracking_error=0.0)
    held = best_design(game)
    sampled = held if exact == game else best_design(exact)
    driven = sampled if exact == tracked else best_design(tracked)
    levels = [0.0 if design is None else design.level for design in (sampled, driven)]
    clearance = 0.0 if held is None else max(held.level - delay_cost(game), 0.0)
    if outruns(game, wanted + delay_cost(game)):
        clearance = math.inf
    budget = _budget(game, wanted, clearance, *levels)
    # The parts of the plain budget bound the clearance too, where they happen to be the stricter ones.
    if math.isfinite(clearance) and math.isfinite(limit):
        clearance = max(min(clearance, limit - budget["total"]), 0.0)
    return clearance, budget, held


def _budget(
    game: SampledGame, wanted: float, clearance: float, sampled: float, driven: float
) -> dict[str, float]:
    limit = game.largest_capture_distance
    ratio = min(game.evader_speed / game.pursuer_speed, 1.0)
    parts = {
        "position": game.offset_error,
        "heading": game.half_axle * ratio * game.heading_error,
        "delay": delay_cost(game),
        "sampling": limit - sampled if math.isfinite(limit) else 0.0,
        "tracking": sampled - driven if math.isfinite(limit) else 0.0,
    }
    used = sum(parts.values())
    spent = limit - clearance if math.isfinite(limit) and math.isfinite(clearance) else used
    parts["sides"] = max(spent - used, 0.0)
    total = sum(parts.values())
    return {**parts, "total": total, "required": wanted + total}


def _sets(
    game: SampledGame, needed: float | None, held: Design | None
) -> tuple[Design | None, Design | None]:
    """Control and start set: the smallest that protect the capture distance, or else the best there is."""
    control = held if held is not None and math.isfinite(held.level) else None
    if needed is not None:
        angle = 0.0 if outruns(game, needed) else tightest_angle(game, needed)
        control = control if angle is None else Design(angle, needed)
    if control is None:
        return None, None
    turned = control.level * math.tan(control.angle) * game.heading_error
    return control, Design(control.angle, control.level + game.offset_error + turned)


def start_margin(certificate: Certificate, start: tuple[float, float]) -> float:
    """How far (m) a measured start lies outside the set that the certified law keeps the evader out of.

    The least over all true positions that the errors allow; 0 or more is a certified start.
    """
    game, control = certificate.situation.game, certificate.control_set
    assert control is not None
    point = np.asarray(start, float)
    side = -1.0 if point[1] < 0.0 else 1.0
    errors = np.array([-game.heading_error, 0.0, game.heading_error])
    zero = np.zeros(3)
    true = seen_from(np.broadcast_to(point, (3, 2)), np.stack([zero, zero, errors], -1))
    return float(np.min(side_value(true, control.angle, side))) - game.offset_error - control.level


def _reason(situation: Situation, in_the_open: bool) -> str:
    limit = situation.game.largest_capture_distance
    if situation.walls:
        return "inside walls no evader is safe for ever, not even from a pursuer of its own speed"
    if situation.pursuer_count > 1:
        return f"no guarantee is known against {situation.pursuer_count} pursuers, only against one"
    if in_the_open:
        return "the evader can keep the capture distance for ever"
    if situation.capture_distance > limit:
        return f"the pursuer wins: the capture distance is more than l_max = {limit:.6g} m"
    return "the evader would win with perfect information and no delay; the budget exceeds what is there"
