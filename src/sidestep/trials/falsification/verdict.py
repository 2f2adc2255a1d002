"""Judge a counterexample: which assumption of the shield's guarantee it broke, if any."""

from __future__ import annotations

from dataclasses import dataclass

import jax
import numpy as np

from sidestep.loop.rollout import Trajectory
from sidestep.pursuit import CaptureGame
from sidestep.safety import PURSUIT_SHIELDS, Status, TableShield
from sidestep.safety.certificate.shield_check import shield_level
from sidestep.safety.clearance import ClearanceTable, shipped_table
from sidestep.trials.captures import explain_capture
from sidestep.trials.falsification.attackers import escape_margin
from sidestep.world import Scenario, World

ASSUMPTIONS: dict[str, str] = {
    "promise": "the shield promises something",
    "forwards": "the pursuer never drives backwards onto the evader (the paper's row)",
    "row": "the evader is fast enough to keep the row (the paper's row)",
    "straight": "the pursuer drives straight on at full speed (the paper's row)",
    "start": "the start lies outside the capture set and clear of obstacles",
    "one-pursuer": "there is one pursuer",
    "winner": "the capture distance is at most l_max, so that the evader can escape at all",
    "finite": "the policy and the world are finite numbers",
    "sampling": "the shield decides in continuous time, not once in a control period",
    "rounding": "numbers are exact",
    "slow-obstacles": "obstacles are slower than the evader",
    "alone": "the rows towards pursuer and obstacles can be kept together",
    "gaps": "obstacles stay so far apart that one at a time matters (the clearance table)",
    "table": "between its nodes the clearance table is right",
    "in-time": "what the clearance table keeps for some seconds can be kept for longer",
}
"""The assumptions of the shields' guarantees, by the names that verdicts use."""

_ROUNDING = 8.0


@dataclass(frozen=True)
class Verdict:
    """The `assumption` (a key of `ASSUMPTIONS`) that a counterexample broke, and how.

    None means that it broke none: then theory or code is wrong.
    """

    assumption: str | None
    words: str

    @property
    def inside(self) -> bool:
        """Whether all of the shield's assumptions held."""
        return self.assumption is None


def judge(
    scenario: Scenario, shield: str, trajectory: Trajectory, guaranteed_clearance: float | None = None
) -> Verdict:
    """The assumption that a lost episode under `shield` broke.

    **Arguments:** `guaranteed_clearance` the least clearance (m) from the pursuer that a certificate
    guarantees at this control period (below 0: a capture may happen, but not deeper). Without it, a capture
    counts as broken by `sampling` when the control period exceeds T_est/2, with T_est = 2 b m/(V l) and
    m = b rho - l tan S; up to that period no capture has been observed.

    **Raises** `ValueError` for an episode that ended neither in a capture nor in a collision.
    """
    outcome = trajectory.outcome
    if outcome not in ("captured", "collided"):
        raise ValueError(f"the episode ended '{outcome}', neither captured nor collided")
    if shield == "none":
        return Verdict("promise", "there is no shield")
    table = _table(scenario, shield)
    if table is None and shield not in ("paper", *PURSUIT_SHIELDS):
        return Verdict("promise", f"nothing is known of what the shield {shield!r} promises")
    common = _judge_input(scenario, trajectory)
    if common is not None:
        return common
    if table is not None:
        return _judge_table(scenario, table, trajectory)
    if outcome == "collided":
        return _judge_collision(scenario, shield, trajectory)
    if shield == "paper":
        return _judge_paper(scenario, trajectory)
    return _judge_capture(scenario, trajectory, guaranteed_clearance)


def certified_clearance(scenario: Scenario, shield: str) -> float | None:
    """The certified least clearance (m) from the pursuer under `shield` at this control period.

    Below 0 if a pursuer may capture between two decisions of the shield. None if there is no certificate:
    another shield, several pursuers, or a pursuer that wins the game. Takes seconds.
    """
    escapes = bool(CaptureGame.of(scenario).evader_can_escape)
    by_rows = shield in PURSUIT_SHIELDS and _table(scenario, shield) is None
    if not by_rows or scenario.pursuer_count != 1 or not escapes:
        return None
    kept = shield_level(scenario)
    return kept.level - kept.error - float(scenario.capture_distance)


def _table(scenario: Scenario, shield: str) -> ClearanceTable | None:
    """The clearance table that a shield of this name decides by."""
    return shipped_table(scenario) if shield in ("joint", "joint:table") else None


def _judge_table(scenario: Scenario, table: ClearanceTable, trajectory: Trajectory) -> Verdict:
    start: World = jax.tree.map(lambda leaf: leaf[0], trajectory.worlds)
    if scenario.pursuer_count != 1:
        return Verdict("one-pursuer", f"there are {scenario.pursuer_count} pursuers")
    if trajectory.outcome == "captured":
        verdict = _judge_capture(scenario, trajectory, guaranteed=-table.game.shortfall)
        if verdict.assumption is not None:
            return verdict
    margin = float(TableShield(scenario, table).margin(start))
    if margin < 0.0:
        return Verdict(
            "start", f"it starts {-1e3 * margin:.3g} mm inside what its clearance table keeps free"
        )
    if scenario.obstacle_count > 1:
        gap = table.smallest_gap
        places = np.asarray(trajectory.worlds.obstacles[:, :, :2])
        apart = np.linalg.norm(places[:, :, None] - places[:, None], axis=-1)
        apart = np.where(np.eye(apart.shape[-1], dtype=bool), np.inf, apart)
        if float(apart.min()) < gap:
            words = (
                f"two obstacles came within {apart.min():.3g} m of each other; its table is for {gap:.3g} m"
            )
            return Verdict("gaps", words)
    if table.periods is not None:
        seconds = table.periods * table.game.control_period
        return Verdict("in-time", f"its clearance table is for {seconds:.3g} s at a time, not for ever")
    return Verdict("table", "its clearance table is interpolated between its nodes, and not proved there")


def _judge_input(scenario: Scenario, trajectory: Trajectory) -> Verdict | None:
    start: World = jax.tree.map(lambda leaf: leaf[0], trajectory.worlds)
    h = float(escape_margin(scenario, start))
    if h <= 0.0:
        return Verdict("start", f"it starts {-h:.3g} m inside the capture set")
    gaps = np.hypot(*np.asarray(start.obstacles[:, :2] - start.evader).T) - float(scenario.collision_distance)
    if np.any(gaps <= 0.0):
        return Verdict("start", f"it starts {-float(gaps.min()):.3g} m inside an obstacle")
    if np.any(np.asarray(trajectory.status) == Status.INVALID):
        return Verdict("finite", "the shield was given numbers that are not finite")
    return None


def _judge_collision(scenario: Scenario, shield: str, trajectory: Trajectory) -> Verdict:
    speeds = np.hypot(*np.asarray(trajectory.worlds.obstacles[0, :, 2:]).T)
    fastest = float(np.max(speeds, initial=0.0))
    if fastest > float(scenario.evader_speed):
        return Verdict("slow-obstacles", f"an obstacle drifts at {fastest:.3g} m/s")
    clearance = float(np.min(np.asarray(trajectory.events.obstacle_clearance)))
    if clearance > -_exact(trajectory):
        return Verdict("rounding", f"the obstacle was touched by {-clearance:.2g} m, which is rounding")
    stuck = np.flatnonzero(np.asarray(trajectory.status) == Status.INFEASIBLE)
    if len(stuck):
        since = float(stuck[0]) * float(scenario.control_period)
        words = f"from {since:.2f} s on not all rows could be kept"
        if shield.startswith("joint"):
            words += "; what `joint` adds to them is measured, not proved"
        return Verdict("alone", words)
    return Verdict(None, "all rows could be kept all the time, and still it collided")


def _judge_paper(scenario: Scenario, trajectory: Trajectory) -> Verdict:
    cause = explain_capture(scenario, trajectory).cause
    if cause == "reversing":
        return Verdict("forwards", "the pursuer backed onto the evader, which the row took for leaving")
    if cause == "head-on":
        return Verdict("row", "no velocity of the evader satisfied the row")
    return Verdict("straight", "the pursuer did not drive as the row takes it to")


def _judge_capture(scenario: Scenario, trajectory: Trajectory, guaranteed: float | None) -> Verdict:
    game = CaptureGame.of(scenario)
    if scenario.pursuer_count != 1:
        return Verdict("one-pursuer", f"there are {scenario.pursuer_count} pursuers")
    largest, reach = float(game.largest_capture_distance), float(scenario.capture_distance)
    if not bool(game.evader_can_escape):
        return Verdict("winner", f"the capture distance {reach:.4g} m exceeds l_max = {largest:.4g} m")
    clearance = float(np.min(np.asarray(trajectory.events.pursuer_clearance)))
    exact = _exact(trajectory)
    if clearance > -exact:
        return Verdict("rounding", f"the evader was touched by {-clearance:.2g} m, which is rounding")
    depth = f"caught {-1e3 * clearance:.3g} mm deep"
    if guaranteed is not None:
        allowed = f"at this control period {max(0.0, -1e3 * guaranteed):.3g} mm cannot be ruled out"
        if clearance >= guaranteed - exact:
            return Verdict("sampling", f"{depth}; {allowed}")
        return Verdict(None, f"{depth}, but no more than {max(0.0, -1e3 * guaranteed):.3g} mm was possible")
    period, safe = float(scenario.control_period), _safe_period(scenario, game)
    if period > safe:
        return Verdict(
            "sampling",
            f"{depth}; the control period {1e3 * period:.3g} ms is longer than the {1e3 * safe:.2g} ms up to "
            "which none was ever seen",
        )
    return Verdict(None, f"{depth}, at a control period of {1e3 * period:.3g} ms")


def _exact(trajectory: Trajectory) -> float:
    """Rounding error (m) of distances in the floating-point precision."""
    evader = np.asarray(trajectory.worlds.evader)
    extent = float(np.max(np.abs(evader), initial=1.0))
    return _ROUNDING * float(np.finfo(evader.dtype).eps) * extent


def _safe_period(scenario: Scenario, game: CaptureGame) -> float:
    """T_est/2 in s, see `judge`; infinite for an evader at least as fast as the pursuer."""
    usable, axle = float(game.usable_angle), float(game.half_axle)
    speed, reach = float(game.pursuer_speed), float(game.capture_distance)
    spare = axle * np.cos(usable) - reach * np.tan(usable)
    return float(axle * max(spare, 0.0) / (speed * reach)) if usable > 0.0 else np.inf
