"""The sentences of a certificate: what is proved, computed, only measured, and not claimed."""

from __future__ import annotations

import math

from sidestep.safety.certificate.certificate import Certificate, Claim
from sidestep.safety.clearance import Checked

PROVED, COMPUTED, MEASURED, NOT_CLAIMED = "proved", "computed", "measured", "not claimed"


def claims_of(certificate: Certificate) -> tuple[Claim, ...]:
    """All claims of a certificate, the main ones first."""
    situation = certificate.situation
    claims = [*_stand_ins(certificate), _winner(certificate)]
    if not situation.walls and situation.pursuer_count == 1:
        claims += _period(certificate)
    claims += [*_survival(certificate), *_shield(certificate), *_obstacles(certificate)]
    return (*claims, *_outside(certificate))


def _stand_ins(certificate: Certificate) -> list[Claim]:
    robots = certificate.situation.stands_for
    if not robots:
        return []
    text = (
        f"All of this is about {robots}. It holds for the real robots if their models are right about them."
    )
    return [Claim(COMPUTED, text)]


def _winner(certificate: Certificate) -> Claim:
    limit, wanted = certificate.largest_capture_distance, certificate.situation.capture_distance
    if math.isinf(limit):
        text = (
            "With perfect information in continuous time the evader, at least as fast as the pursuer, "
            "escapes at any capture distance by driving straight away."
        )
        return Claim(PROVED, text)
    lost = certificate.pursuer_wins
    outcome = "the pursuer captures from everywhere" if lost else "the evader can stay free for ever"
    text = (
        f"With perfect information in continuous time {outcome}: l = {wanted:.6g} m is "
        f"{'more' if lost else 'no more'} than l_max = b rho^2/sqrt(1 - rho^2) = {limit:.6g} m (Ruiz, "
        "Murrieta-Cid, Marroquin 2013)."
    )
    return Claim(PROVED, text if lost else f"{text} It must start outside the capture set K(l).")


def _assumptions(certificate: Certificate) -> str:
    game = certificate.situation.game
    measured = (
        f"measurements up to {game.position_error:g} m and {game.heading_error:g} rad off"
        if game.position_error > 0.0 or game.heading_error > 0.0
        else "exact measurements"
    )
    age = f", {game.delay:g} s old" if game.delay > 0.0 else ""
    own = "" if game.delay == 0.0 or game.own_motion_predicted else " and its own motion since not added"
    drives = (
        "" if game.tracking_error == 0.0 else f", driving up to {game.tracking_error:g} m/s off its commands"
    )
    return (
        f"deciding every {game.control_period:g} s on {measured}{age}{own}{drives}, against one "
        "pursuer that may do anything its wheels allow, at any instant"
    )


def _period(certificate: Certificate) -> list[Claim]:
    assumptions, clearance = _assumptions(certificate), certificate.guaranteed_clearance
    if math.isinf(clearance):
        text = (
            f"An evader that flees straight away, {assumptions}, never lets its distance fall by more than "
            f"what the pursuer gains unseen ({certificate.budget['delay']:.4g} m): even with its errors in "
            "direction it is as fast as the pursuer."
        )
        return [Claim(PROVED, text)]
    if clearance <= 0.0:
        return [Claim(NOT_CLAIMED, f"No distance can be shown to be kept by an evader {assumptions}.")]
    text = f"An evader {assumptions}, can keep at least {clearance:.6g} m for ever, at every instant."
    if certificate.control_set is not None:
        design = certificate.control_set
        text += (
            f" It stays out of the set of radius {design.level:.6g} m with tips at +-{design.tip:.6g} m "
            "on the "
            "pursuer's axis."
        )
    text += (
        " Computed on a grid, in double precision, with bounds that hold between its nodes too: the distance "
        "that this way of fleeing keeps is not smaller, and larger by at most "
        f"{certificate.grid_error:.2g} m."
    )
    better = (
        "That no other way of fleeing keeps more. Nobody keeps more than l_max = "
        f"{certificate.largest_capture_distance:.6g} m."
    )
    return [Claim(COMPUTED, text), Claim(NOT_CLAIMED, better)]


def _survival(certificate: Certificate) -> list[Claim]:
    lasts = certificate.survival
    if lasts is None:
        return []
    where = f"From {lasts.distance:.4g} m" if lasts.start is None else f"From {lasts.start}"
    claims = []
    if math.isfinite(lasts.longest):
        span = f"{lasts.shortest:.3g} s"
        if lasts.start is None:
            span += (
                f" (at bearing {lasts.worst_bearing:.3g} rad) to {lasts.longest:.3g} s "
                f"(at {lasts.best_bearing:.3g} rad)"
            )
        text = (
            f"{where} capture takes {span} when both play best, in continuous time with perfect information: "
            "the pursuer can force it then and no sooner."
        )
        claims.append(Claim(PROVED, text))
    text = (
        f"{where} the evader can drive straight on for {lasts.certain_run:.4g} m in the worst direction and "
        f"for {lasts.longest_run:.4g} m in the best before it can be captured, whatever the pursuer does."
    )
    claims.append(Claim(COMPUTED, text))
    if certificate.target_distance is not None:
        claims.append(_target(certificate, lasts.certain_run, lasts.longest))
    return claims


def _target(certificate: Certificate, run: float, longest: float) -> Claim:
    target = f"A target {certificate.target_distance:g} m away"
    reach = certificate.situation.game.evader_speed * longest
    if certificate.target == "certain":
        text = f"{target} is reached before capture, wherever it lies, by driving straight at it."
        return Claim(COMPUTED, text)
    if certificate.target == "out of reach":
        text = (
            f"{target} cannot be reached for certain: it is farther than v_e times the longest time to "
            f"capture, {reach:.4g} m."
        )
        return Claim(PROVED, text)
    beyond = f"; beyond {reach:.4g} m none is" if math.isfinite(reach) else ""
    text = (
        f"That {target[0].lower()}{target[1:]} is reached: only up to {run:.4g} m it is, wherever it "
        f"lies{beyond}."
    )
    return Claim(NOT_CLAIMED, text)


def _shield(certificate: Certificate) -> list[Claim]:
    if certificate.shield is None:
        return []
    game, level = certificate.situation.game, certificate.shield
    exact = game.position_error == game.heading_error == game.delay == game.tracking_error == 0.0
    text = (
        f"The `game` shield as shipped, set to this capture distance, keeps {level.level:.4g} m whatever the "
        f"policy wants, from one pursuer{'' if exact else ' and, unlike the rest, with exact measurements'}. "
        f"Sampled on a grid of {level.error:.1g} m, not bounded between its nodes."
    )
    counted = (
        "How often given pursuers capture: `sidestep evaluate` and `sidestep falsify` count that, with 95 % "
        "bounds."
    )
    return [Claim(COMPUTED, text), Claim(MEASURED, counted)]


def _obstacles(certificate: Certificate) -> list[Claim]:
    situation, speed = certificate.situation, certificate.situation.game.evader_speed
    if situation.obstacle_count == 0:
        return []
    drift, share = situation.obstacle_speed, situation.obstacle_gain * situation.game.control_period
    if drift <= speed and share <= 1.0:
        claim = Claim(
            PROVED,
            f"The row towards one obstacle alone can always be kept (it drifts at {drift:.3g} m/s, the "
            "evader "
            f"makes {speed:.3g} m/s), and keeping it for a period keeps the collision distance at every "
            "instant: both move straight, and gain times period is at most 1.",
        )
    else:
        claim = Claim(
            NOT_CLAIMED,
            "Not even the row towards one obstacle alone: that needs an obstacle no faster than the evader "
            f"({drift:.3g} and {speed:.3g} m/s) and gain times period at most 1 (it is {share:.3g}).",
        )
    return [claim, *_together(certificate)]


def _together(certificate: Certificate) -> list[Claim]:
    """Pursuer and obstacles at once."""
    found = certificate.obstacles
    if found is None:
        text = (
            "Pursuer and obstacles together: each row can be kept alone, both at once cannot always. A "
            "pursuer can pin the evader where one direction is safe and an obstacle lies in it. Where its "
            "row goes first, what is said about capture holds, and collisions are counted, not excluded."
        )
        if certificate.no_obstacles:
            text += f" There is no clearance table here: {certificate.no_obstacles}."
        return [Claim(NOT_CLAIMED, text)]
    worst = max(found.directions, key=lambda direction: direction.worst)
    lasting = "for ever" if found.seconds is None else f"for {found.seconds:.3g} s"
    text = (
        f"Pursuer and one obstacle together: an evader outside the capture set of "
        f"{found.game.capture_distance:.6g} m (h' >= 0, design angle {math.degrees(found.game.angle):.3g} "
        f"deg) that has every obstacle's centre farther than "
        f"{found.beyond:.3g} m away can stay free of both {lasting}, deciding every "
        f"{found.game.control_period:g} s on exact measurements, while the obstacle drifts at up to "
        f"{found.drift:.3g} m/s in any direction. Nearer ones matter by direction and h': most, "
        f"{worst.worst:.3g} m at h' = {worst.height:g} m, where the obstacle lies "
        f"{abs(math.degrees(worst.towards)):.0f} deg off the pursuer's axis. From a table solved on a grid "
        "and interpolated, with spare drift for what that loses."
    )
    claims = [Claim(COMPUTED, text)]
    if found.checked is not None:
        claims.append(_proved_share(found.checked))
    gaps = (
        f"Several obstacles: while their centres stay at least {found.smallest_gap:.3g} m apart only one at "
        "a time matters, and the same holds."
    )
    claims.append(Claim(COMPUTED, gaps))
    if found.fastest_drift is not None:
        claims.append(
            Claim(
                COMPUTED,
                f"The fastest drift at which there is such a distance at all (below 1 m): "
                f"{found.fastest_drift:.3g} m/s, on a coarse grid.",
            )
        )
    claims += _start_and_obstacle(certificate)
    measured = (
        "How often an evader behind `joint` is lost to given pursuers and to the table's own worst case: "
        "`sidestep falsify` counts that."
    )
    between = (
        "What lies between the table's nodes. Where an obstacle lies dead ahead of the pursuer, the distance "
        "that it must have jumps within a degree, and an evader that goes by the table alone (`joint:table`) "
        "is led there and lost now and then. `joint` looks ahead there, which is measured, not certified."
    )
    closer = "Obstacles that stand closer to each other than that, or to a wall."
    claims += [Claim(MEASURED, measured), Claim(NOT_CLAIMED, between), Claim(NOT_CLAIMED, closer)]
    if found.seconds is not None:
        later = f"That an evader that keeps the table's set now still can in {found.seconds:.3g} s."
        claims.append(Claim(NOT_CLAIMED, later))
    return claims


def _proved_share(checked: Checked) -> Claim:
    return Claim(
        MEASURED,
        f"How much of that table is proved: of {checked.boxes} small boxes of states, drawn where it "
        f"matters, {checked.verified} verify for a drift of up to {checked.drift:g} m/s, with bounds that "
        f"hold at every state, motion and instant (at least {100.0 * checked.at_least:.3g} % of such boxes, "
        f"at 95 %). In {checked.refuted} a motion was found that leaves the set. The rest is undecided.",
    )


def _start_and_obstacle(certificate: Certificate) -> list[Claim]:
    found = certificate.obstacles
    assert found is not None
    if found.start_clearance is None or found.start_worst is None or found.start_height is None:
        return []
    if found.start_height < 0.0:
        inside = f"it lies {-found.start_height:.3g} m inside the set to keep out of"
        return [Claim(NOT_CLAIMED, f"Anything about obstacles from {certificate.start}: {inside}.")]
    text = (
        f"From {certificate.start} an obstacle must be at least {found.start_clearance:.3g} m away in the "
        f"worst direction, {math.degrees(found.start_worst):.0f} deg from the pursuer's heading."
    )
    claims = [Claim(COMPUTED, text)]
    if found.obstacle is not None and found.obstacle_margin is not None:
        margin = found.obstacle_margin
        if margin >= 0.0:
            text = f"One at {found.obstacle} is {1e3 * margin:.3g} mm farther away than needed there."
            claims.append(Claim(COMPUTED, text))
        else:
            text = f"That both can be kept with one at {found.obstacle}: {-1e3 * margin:.3g} mm are missing."
            claims.append(Claim(NOT_CLAIMED, text))
    return claims


def _outside(certificate: Certificate) -> list[Claim]:
    situation = certificate.situation
    walls = "Anything inside walls: all this is for the unbounded plane."
    if situation.walls:
        walls = (
            "That the evader is safe for ever inside walls: in a bounded arena even a differential "
            "drive of the "
            "evader's own speed captures in the end (Ruiz and Isler, arXiv 1508.06333)."
        )
    several = (
        f"Anything about {situation.pursuer_count} pursuers at once: the shield asks for a row towards "
        "each, but "
        "no theory says that all can be kept."
    )
    model = (
        "Robots that move otherwise than modelled: velocities are taken to be reached at once, and "
        "wheels not "
        "to slip."
    )
    if situation.stands_for:
        model = "Robots that move otherwise than their models say."
    texts = [walls, *([several] if situation.pursuer_count > 1 else []), model]
    return [Claim(NOT_CLAIMED, text) for text in texts]
