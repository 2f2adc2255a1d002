"""The numbers of a game of evader, pursuer and obstacle."""

from __future__ import annotations

import math
from dataclasses import asdict, dataclass, field
from typing import Any

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from sidestep._arrays import Flag
from sidestep._bounds import within
from sidestep.safety.sampled.sampled_design import COARSE, best_angle, largest_true
from sidestep.safety.sampled.sampled_game import SampledGame
from sidestep.world import Scenario

SPARE = 0.0015
"""How much more (m) an obstacle must be away after each period in the tables that shields and certificates
read: it absorbs what interpolation loses."""


@dataclass(frozen=True)
class ClearanceGame:
    """An evader between one pursuer and one obstacle, a disc or a straight `wall`, in SI units.

    The evader (`evader_speed` v_e, holonomic) decides once per `control_period` T; the pursuer (rim speed V,
    `half_axle` b) must stay at least `capture_distance` l away, the obstacle, which drifts at up to
    `obstacle_speed` v_c in any direction, at least `collision_distance` d, and by `spare` more after each
    period. `angle` S' > S is the design angle of the set that the evader keeps from the pursuer; whether it
    `can_stop`, or always drives at full speed. `shortfall` (m) is how much more than `capture_distance` was
    asked for, where nobody can keep that for ever.

    Beside a `wall` d is the distance to it, and v_c how fast it moves along its normal. It is no wall to the
    pursuer: one that it stops too can do less.
    """

    evader_speed: float = field(metadata=within(above=0.0, most=1e3, unit="m/s"))
    pursuer_speed: float = field(metadata=within(above=0.0, most=1e3, unit="m/s"))
    half_axle: float = field(metadata=within(above=0.0, most=1e3, unit="m"))
    capture_distance: float = field(metadata=within(above=0.0, most=1e3, unit="m"))
    collision_distance: float = field(metadata=within(above=0.0, most=1e3, unit="m"))
    obstacle_speed: float = field(metadata=within(least=0.0, most=1e3, unit="m/s"))
    control_period: float = field(metadata=within(above=0.0, most=100.0, unit="s"))
    spare: float = field(metadata=within(least=0.0, most=1.0, unit="m"))
    angle: float = field(metadata=within(above=0.0, below=math.pi / 2.0, unit="rad"))
    can_stop: bool = True
    shortfall: float = field(default=0.0, metadata=within(least=0.0, most=1e3, unit="m"))
    wall: bool = False

    @staticmethod
    def of(
        scenario: Scenario, *, angle: float | None = None, spare: float = 0.0, nearest: bool = False
    ) -> ClearanceGame:
        """That of a scenario.

        **Arguments:** `angle` S' (rad), by default a quarter of the way from S to that with the most slack
        against the pursuer alone: a wider one shortens what is lost per period and lengthens the tip;
        `spare` (m), how much more an obstacle must be away after a period than the table says; `nearest`:
        where the evader cannot keep the capture distance for ever at this period, but nearly, that of a
        capture distance that it can keep, see `shortfall`.

        **Raises** `ValueError` where no angle lets the evader keep the capture distance at this period.
        """
        scenario.check_built_in("a clearance table", "there is none for other robots")
        wanted = float(scenario.capture_distance)
        level, angle = (wanted, angle) if angle is not None else _design(scenario, nearest)
        drift = float(np.hypot(*np.asarray(scenario.obstacle_velocity, float)))
        return ClearanceGame(
            evader_speed=float(scenario.evader_speed),
            pursuer_speed=float(scenario.pursuer_speed),
            half_axle=float(scenario.pursuer_half_axle),
            capture_distance=level,
            collision_distance=float(scenario.collision_distance),
            obstacle_speed=drift,
            control_period=float(scenario.control_period),
            spare=spare,
            angle=angle,
            can_stop=scenario.action == "velocity",
            shortfall=wanted - level,
        )

    def refuses(self, scenario: Scenario) -> str:
        """Why a table of this game does not serve a scenario; empty where it does: with the same robots and
        period, or an evader that has it easier."""
        if not scenario.built_in:
            return "it has robots of its own"
        if self.wall:
            return "its obstacles are discs, the table's is a wall"
        for name, value, harder in self._compared(scenario, np):
            solved = getattr(self, name)
            if _is_beyond(value, solved, harder):
                return f"its {name} is {float(value):.4g}, the table's {solved:.4g}"
        if self.can_stop and scenario.action != "velocity":
            return "its evader cannot stop, the table's can"
        return ""

    def serves(self, scenario: Scenario) -> Flag:
        """Whether a table of this game serves a scenario by its numbers, which may be traced; see `refuses`
        for the rest."""
        compared = self._compared(scenario, jnp)
        beyond = [_is_beyond(value, getattr(self, name), harder) for name, value, harder in compared]
        return ~jnp.any(jnp.stack(beyond))

    def _compared(self, scenario: Scenario, xp: Any) -> list[tuple[str, Any, int]]:
        """Names, a scenario's numbers, and whether larger (1) or smaller ones (-1) are harder for the evader,
        or any other (0)."""
        level = xp.asarray(scenario.capture_distance) - self.shortfall
        drift = xp.asarray(scenario.obstacle_velocity)
        return [
            ("evader_speed", xp.asarray(scenario.evader_speed), -1),
            ("pursuer_speed", xp.asarray(scenario.pursuer_speed), 0),
            ("half_axle", xp.asarray(scenario.pursuer_half_axle), 0),
            ("capture_distance", xp.maximum(level, 0.0), 1),
            ("collision_distance", xp.asarray(scenario.collision_distance), 1),
            ("obstacle_speed", xp.hypot(drift[0], drift[1]), 1),
            ("control_period", xp.asarray(scenario.control_period), 0),
        ]

    @property
    def as_dict(self) -> dict[str, float]:
        """Every number by name; `wall` only where it is one, so that files of discs stay as they were."""
        return {name: value for name, value in asdict(self).items() if name != "wall" or value}

    def velocities(self, headings: int) -> Float[np.ndarray, "n 2"]:
        """What the evader chooses from, m/s: full speed in evenly spread headings, those along the tip's
        normals exactly, and a stop if it can."""
        heading = 2.0 * math.pi * np.arange(headings) / headings
        for normal in (self.angle, math.pi - self.angle, math.pi + self.angle, 2.0 * math.pi - self.angle):
            heading[np.argmin(np.abs(heading - normal))] = normal
        full = self.evader_speed * np.stack([np.cos(heading), np.sin(heading)], -1)
        return np.concatenate([full, np.zeros((int(self.can_stop), 2))])

    def motions(self, turns: int, drives: int) -> Float[np.ndarray, "n 3"]:
        """Poses (m, m, rad) that the pursuer can reach in one period: the edge of what it reaches.

        For each of 2 `turns` + 1 final headings it drives as far as that turn leaves it, forwards and
        backwards, along `drives` headings from the first to the last.
        """
        period = self.control_period
        most = self.pursuer_speed * period / self.half_axle
        turn = np.linspace(-most, most, 2 * turns + 1)
        left = self.pursuer_speed * period - self.half_axle * np.abs(turn)
        along = turn[:, None] * np.linspace(0.0, 1.0, drives)
        poses = [
            np.stack([end * left[:, None] * np.cos(along), end * left[:, None] * np.sin(along)], -1)
            for end in (1.0, -1.0)
        ]
        heading = np.broadcast_to(turn[None, :, None, None], (2, *along.shape, 1))
        return np.unique(np.concatenate([np.stack(poses), heading], -1).reshape(-1, 3).round(15), axis=0)


_NEARLY = 0.95
"""Share of the capture distance that an evader must be able to keep to keep it nearly."""
_BELOW = 0.998
"""Share of the largest distance that it can keep: the design angle then has some slack."""


def _is_beyond(value: Any, solved: float, harder: int) -> Any:
    """Whether a number is harder for the evader than the one solved for, beyond rounding."""
    off = harder * (value - solved) if harder else abs(value - solved)
    return off > 1e-6 * solved


def _design(scenario: Scenario, nearest: bool) -> tuple[float, float]:
    """The capture distance (m) and the angle (rad) of `ClearanceGame.of`."""
    game = SampledGame(
        float(scenario.evader_speed),
        float(scenario.pursuer_speed),
        float(scenario.pursuer_half_axle),
        float(scenario.control_period),
    )
    level = wanted = float(scenario.capture_distance)
    widest, slack = best_angle(game, level, COARSE)
    if nearest and not slack >= 0.0:
        level = _BELOW * largest_true(
            lambda level: best_angle(game, level, COARSE)[1], _NEARLY * wanted, wanted, 1e-4 * wanted
        )
        widest, slack = best_angle(game, level, COARSE)
    if not slack >= 0.0:
        raise ValueError(
            f"no design angle keeps the pursuer {wanted:g} m away at a period of {game.control_period:g} s "
            "for ever, so there is no clearance table; `sidestep certify` shows what would do"
        )
    return level, game.usable_angle + 0.25 * (widest - game.usable_angle)
