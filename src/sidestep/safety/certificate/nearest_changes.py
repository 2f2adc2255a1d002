"""What would have to change for a guarantee to hold: one parameter alone, or two by the same share?"""

from __future__ import annotations

import math
from collections.abc import Callable, Collection, Mapping
from dataclasses import dataclass, replace

from sidestep.safety.certificate.situation import Situation
from sidestep.safety.sampled.sampled_design import delay_cost, largest_true, spare

_TOLERANCE = 2e-5
"""Of a change, as a share of the largest one tried."""
_SURPLUS = 1e-5
"""How much more than wanted a suggestion must hold, as a share of the largest level: the certificate's own
search ends a little below the level that can be held, and must still end above the one that is wanted."""
_DIGITS = 6
"""Significant digits of a suggestion: it holds as it is printed."""
_WORTH_IT = 0.9
"""A pair is worth naming if it asks for at most this share of what either change asks for alone."""
_MOST_PAIRS = 3
_MOST_SHARE = 0.95
"""Of a pair: one of the two always has to get smaller, and none may vanish."""

PARAMETERS: dict[str, str] = {
    "evader_speed": "m/s",
    "pursuer_speed": "m/s",
    "pursuer_half_axle": "m",
    "capture_distance": "m",
    "control_period": "s",
    "position_error": "m",
    "heading_error": "rad",
    "delay": "s",
    "tracking_error": "m/s",
}
"""What may be changed to make a guarantee hold, and its unit."""

WHOSE: dict[str, tuple[str, ...]] = {
    "evader": ("evader_speed", "tracking_error"),
    "sensing": ("control_period", "position_error", "heading_error", "delay"),
    "task": ("capture_distance",),
    "pursuer": ("pursuer_speed", "pursuer_half_axle"),
}
"""Who can change what: the evader's drive, its sensors and computer, what counts as capture, the pursuer."""

MINE = ("evader", "sensing", "task")
"""What can be changed unless something else is said: the evader is ours."""

_RISING = ("evader_speed", "pursuer_half_axle")
"""More of these helps; of all others less."""
_IN_GAME = {"pursuer_half_axle": "half_axle"}
_OWNER = {parameter: owner for owner, parameters in WHOSE.items() for parameter in parameters}


@dataclass(frozen=True)
class Change:
    """The nearest value of one parameter, the others as they are, with which the guarantee holds.

    `needed` is None where no value does; `whose` a key of `WHOSE`, `mine` whether it was said to be
    changeable.
    """

    parameter: str
    now: float
    needed: float | None
    unit: str
    whose: str
    mine: bool

    @property
    def share(self) -> float | None:
        """|needed - now|/now, infinite from 0; None where no value does."""
        if self.needed is None:
            return None
        return abs(self.needed - self.now) / self.now if self.now > 0.0 else math.inf


@dataclass(frozen=True)
class PairChange:
    """Two parameters changed by the same `share` of their values now, the smallest with which it holds."""

    changes: tuple[Change, Change]
    share: float


def check_mine(mine: Collection[str]) -> None:
    """**Raises** `ValueError` for a name that is no key of `WHOSE`."""
    for name in mine:
        if name not in WHOSE:
            raise ValueError(f"mine = {name!r}: it must be among {', '.join(WHOSE)}")


def nearest_changes(
    situation: Situation, clearance: float, mine: Collection[str] = MINE
) -> tuple[Change, ...]:
    """For each single parameter the nearest value with which the guarantee holds.

    Those that are `mine` first, of these those with an answer first, relatively small ones before large ones.
    On the safe side by the coarser grid that the search uses: the value named does hold, as it is printed.
    """
    found = {}
    for parameter in PARAMETERS:
        if parameter == "capture_distance":
            needed = _rounded(parameter, clearance) if clearance > 0.0 else None
        else:
            needed = _alone(situation, parameter)
        found[parameter] = None if _hopeless(situation) else needed
    changes = [_change(situation, parameter, needed, mine) for parameter, needed in found.items()]

    def order(change: Change) -> tuple[bool, bool, float]:
        share = change.share
        return not change.mine, share is None, 0.0 if share is None else share

    return tuple(sorted(changes, key=order))


def nearest_pairs(
    situation: Situation,
    budget: Mapping[str, float],
    alone: Collection[Change],
    mine: Collection[str] = MINE,
) -> tuple[PairChange, ...]:
    """For the most useful pairs of what is `mine` the smallest equal change of both that makes it hold.

    A pair is named if it asks for clearly less than either change alone; at most three, the smallest first.

    **Arguments:** `budget` of the certificate, by which the worst measurement error is picked; `alone` what
    `nearest_changes` found.
    """
    if _hopeless(situation):
        return ()
    single = {change.parameter: change for change in alone}
    pairs = []
    for names in _useful(budget):
        if not all(_OWNER[name] in mine and single[name].now > 0.0 for name in names):
            continue
        shares = [share for name in names if (share := single[name].share) is not None]
        share = _together(situation, names, min(shares, default=math.inf))
        if share is not None and share <= _WORTH_IT * min(shares, default=math.inf):
            changes = [
                _change(situation, name, _rounded(name, _moved(name, single[name].now, share)), mine)
                for name in names
            ]
            pairs.append(PairChange((changes[0], changes[1]), share))
    return tuple(sorted(pairs, key=lambda pair: pair.share)[:_MOST_PAIRS])


def changed(situation: Situation, values: Mapping[str, float]) -> Situation:
    """The situation with other values of some `PARAMETERS`."""
    in_game = {
        _IN_GAME.get(name, name): value for name, value in values.items() if name != "capture_distance"
    }
    wanted = values.get("capture_distance", situation.capture_distance)
    return replace(situation, game=replace(situation.game, **in_game), capture_distance=wanted)


def _useful(budget: Mapping[str, float]) -> list[tuple[str, str]]:
    errors = {"position_error": "position", "heading_error": "heading", "delay": "delay"}
    worst = max(errors, key=lambda name: budget[errors[name]])
    return [
        ("evader_speed", "capture_distance"),
        ("evader_speed", "control_period"),
        ("evader_speed", worst),
        ("capture_distance", "control_period"),
        ("capture_distance", worst),
        ("evader_speed", "pursuer_speed"),
        ("pursuer_speed", "pursuer_half_axle"),
    ]


def _hopeless(situation: Situation) -> bool:
    return situation.walls or situation.pursuer_count > 1


def _now(situation: Situation, parameter: str) -> float:
    if parameter == "capture_distance":
        return situation.capture_distance
    return getattr(situation.game, _IN_GAME.get(parameter, parameter))


def _change(situation: Situation, parameter: str, needed: float | None, mine: Collection[str]) -> Change:
    owner = _OWNER[parameter]
    return Change(parameter, _now(situation, parameter), needed, PARAMETERS[parameter], owner, owner in mine)


def _extreme(situation: Situation, parameter: str) -> float:
    """How far a single parameter is changed at most."""
    game = situation.game
    if parameter == "evader_speed":
        return 2.0 * max(game.pursuer_speed, game.evader_speed) / math.cos(game.heading_error)
    if parameter == "pursuer_speed":
        return 1e-3 * game.evader_speed
    if parameter == "pursuer_half_axle":
        return 100.0 * max(game.half_axle, situation.capture_distance)
    return 0.0


def _alone(situation: Situation, parameter: str) -> float | None:
    now, extreme = _now(situation, parameter), _extreme(situation, parameter)
    if _hopeless(situation) or now == extreme:
        return None
    needed = _nearest(lambda value: _spare(changed(situation, {parameter: value})), now, extreme)
    return None if needed is None else _rounded(parameter, needed)


def _together(situation: Situation, names: tuple[str, str], most: float) -> float | None:
    """The smallest share by which both can be changed so that it holds; None where none below `most` does."""
    now = {name: _now(situation, name) for name in names}
    rising = [_extreme(situation, name) / now[name] - 1.0 for name in names if name in _RISING]
    most = min(most, _MOST_SHARE, *rising)

    def value(share: float) -> float:
        return _spare(changed(situation, {name: _moved(name, now[name], share) for name in names}))

    return _nearest(value, 0.0, most)


def _moved(parameter: str, now: float, share: float) -> float:
    return now * (1.0 + share if parameter in _RISING else 1.0 - share)


def _rounded(parameter: str, value: float) -> float:
    """`value` to as many digits as are printed, away from what fails."""
    if value == 0.0 or not math.isfinite(value):
        return value
    unit = 10.0 ** (math.floor(math.log10(abs(value))) - _DIGITS + 1)
    steps = math.ceil(value / unit) if parameter in _RISING else math.floor(value / unit)
    return float(f"{steps * unit:.{_DIGITS}g}")


def _spare(situation: Situation) -> float:
    game = situation.game
    surplus = _SURPLUS * min(game.largest_capture_distance, 100.0 * game.half_axle)
    return spare(game, situation.capture_distance + delay_cost(game) + surplus)


def _nearest(value: Callable[[float], float], now: float, extreme: float) -> float | None:
    """The point nearest to `now`, toward `extreme`, where a rising function is 0; None if it stays below."""
    if value(extreme) < 0.0:
        return None
    far = largest_true(lambda share: value(extreme + share * (now - extreme)), 0.0, 1.0, _TOLERANCE)
    return extreme + far * (now - extreme)
