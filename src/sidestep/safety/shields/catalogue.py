"""Every shield and every barrier by name."""

import dataclasses
import warnings
from typing import Any

import equinox as eqx

from sidestep._arrays import traced
from sidestep.pursuit.game import CaptureGame
from sidestep.safety.barriers.barrier import Barrier, ObstacleBarrier, RangeBarrier
from sidestep.safety.barriers.budget import Budget
from sidestep.safety.barriers.pursuit_barrier import PursuitBarrier
from sidestep.safety.clearance import SPARE, ClearanceGame, shipped_table, table_for
from sidestep.safety.shields.adapted import AdaptedShield, covered, of_control_point
from sidestep.safety.shields.barrier_shield import shield_of
from sidestep.safety.shields.by_table import TableShield
from sidestep.safety.shields.game import GameShield
from sidestep.safety.shields.joint import JointShield
from sidestep.safety.shields.none import NoShield
from sidestep.safety.shields.paper import PaperShield
from sidestep.safety.shields.shield import Shield
from sidestep.world.model_probe import ModelWarning
from sidestep.world.scenario import Scenario

SHIELDS: dict[str, type[Shield]] = {
    "none": NoShield,
    "paper": PaperShield,
    "game": GameShield,
    "joint": JointShield,
}
"""Every shield by name, weakest first: figures and reports keep that order."""
BARRIERS: dict[str, Barrier] = {
    "obstacle": ObstacleBarrier(),
    "range": RangeBarrier(),
    "pursuit": PursuitBarrier(),
    "pursuit, velocity known": PursuitBarrier(known_velocity=True),
}
"""Every barrier by name."""
JOINT_FORMS: dict[str, type[Shield]] = {"joint:look-ahead": JointShield, "joint:table": TableShield}
"""The two forms of `joint` by name: `make_shield("joint", ...)` takes the second where it can."""
PURSUIT_SHIELDS = tuple(name for name, kind in (SHIELDS | JOINT_FORMS).items() if kind.keeps_pursuit_barrier)
"""Shields whose rows towards pursuers are those of the pursuit barrier. These take a budget."""


def make_shield(name: str, scenario: Scenario, budget: Budget | None = None) -> Shield:
    """The shield `name` (a key of `SHIELDS` or `JOINT_FORMS`) for a scenario; `budget` for those of
    `PURSUIT_SHIELDS` only.

    For custom robots (`EvaderModel`, `PursuerModel`) it is an `AdaptedShield`. `joint` decides by the
    clearance table that comes with sidestep for this scenario, if there is one and no budget is asked for,
    otherwise by looking ahead. `joint:table` takes that table or the one that `clearance_table` keeps, and
    solves for it, which takes minutes, where there is neither; it never looks ahead.

    **Raises** `ValueError` naming the known shields, or what is wrong with the budget, or why there is no
    table. **Warns** `BudgetWarning` where the budget exceeds what the game allows, `ModelWarning` where
    custom robots leave an evader that can be captured.
    """
    if name not in SHIELDS | JOINT_FORMS:
        raise ValueError(f"no shield {name!r}; use one of {', '.join(map(repr, SHIELDS | JOINT_FORMS))}")
    if not scenario.built_in:
        covering = of_control_point(scenario)
        if name in PURSUIT_SHIELDS:
            covering = covered(covering)
            _announce_beyond(covering)
        else:  # The others assume nothing about the pursuer's motion.
            covering = dataclasses.replace(covering, pursuer_model=None)
        return AdaptedShield(scenario, make_shield(name, covering, budget))
    if budget is not None:
        if name not in PURSUIT_SHIELDS:
            raise ValueError(
                f"the shield {name!r} keeps no budget; use {' or '.join(map(repr, PURSUIT_SHIELDS))}"
            )
        budget.announce(scenario)
    if name == "game":
        return GameShield(scenario, budget, goes_round=True)
    # Within a budget a table promises nothing, and on the physics twin it was less safe than to look ahead.
    if name == "joint" and budget is None and not traced(scenario):
        table = shipped_table(scenario)
        if table is not None:
            # A table promises nothing where several obstacles or pursuers matter at once, and after its time.
            # Nor is it exact: straight ahead of a pursuer, beside an obstacle, its set is now and then left.
            shield = TableShield(scenario, table)
            if table.periods is None:
                # The look-ahead comes to 0 up to rounding; it keeps what the table keeps.
                kept = scenario.capture_distance + shield.spare_pursuer
                scenario = eqx.tree_at(lambda scenario: scenario.capture_distance, scenario, kept)
            return dataclasses.replace(shield, otherwise=JointShield(scenario))
    if name == "joint:table":
        return TableShield(scenario, table_for(scenario), budget=budget)
    kind: Any = (SHIELDS | JOINT_FORMS)[name]
    return kind(scenario, budget=budget) if name in PURSUIT_SHIELDS else kind(scenario)


def _announce_beyond(covering: Scenario) -> None:
    """Warn where the pursuer wins the game that covers that of custom robots."""
    if traced(covering):
        return
    allowed, kept = float(CaptureGame.of(covering).largest_capture_distance), float(covering.capture_distance)
    if kept > allowed:
        speed, axle = float(covering.pursuer_speed), float(covering.pursuer_half_axle)
        warnings.warn(
            f"with these robots the evader's control point has to keep {kept:.3g} m away from a drive of rim "
            f"speed {speed:.3g} m/s and half axle {axle:.3g} m, and against a good one {allowed:.3g} m is "
            "the most: it may be caught. A smaller `offset`, a `covering` drive that can do less, or a "
            "faster evader would change that",
            ModelWarning,
            stacklevel=3,
        )


def as_shield(shield: str | Shield | Barrier, scenario: Scenario) -> Shield:
    """`shield` itself, or the one of that name for `scenario`, or the one that keeps a custom barrier."""
    if isinstance(shield, Barrier):
        return shield_of(shield, scenario)
    return make_shield(shield, scenario) if isinstance(shield, str) else shield


def checked_shield(shield: Any) -> Shield:
    """**Raises** `ValueError` for anything but a shield: a name alone does not say for which robots."""
    if isinstance(shield, Shield):
        return shield
    name = shield if isinstance(shield, str) else "joint"
    raise ValueError(
        f"shield = {shield!r}: it must be a sidestep.Shield, such as make_shield({name!r}, scenario) with "
        "the Scenario of the robots in this environment"
    )


def name_of(shield: Shield, scenario: Scenario) -> str | None:
    """The name under which `make_shield` gives this very shield; None if there is none."""
    names = [name for name, kind in SHIELDS.items() if type(shield) is kind]
    if isinstance(shield, TableShield):
        # Compared without solving for a table.
        if shipped_table(scenario) is None:
            alike = eqx.tree_equal(shield, TableShield(scenario, shield.table))
            return (
                "joint:table"
                if bool(alike) and shield.table.game == ClearanceGame.of(scenario, spare=SPARE, nearest=True)
                else None
            )
        names = ["joint", "joint:table"]
    elif isinstance(shield, JointShield):
        names = ["joint", "joint:look-ahead"]
    return next((n for n in names if bool(eqx.tree_equal(shield, make_shield(n, scenario)))), None)
