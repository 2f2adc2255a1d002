"""Recorded episodes in a report, for its player: some seconds around the least clearance."""

from __future__ import annotations

import base64
import json
import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float
from markupsafe import Markup

from sidestep.loop import Trajectory
from sidestep.safety import Status
from sidestep.trials import WorstEpisode
from sidestep.views.html import shown_number
from sidestep.views.scene import drawn_half_axle, guarded
from sidestep.views.style import OUTCOME_WORDS, shield_words
from sidestep.world import Scenario

BEFORE, AFTER = 20.0, 6.0
"""Seconds shown before and after the least clearance; an episode may last for minutes."""

_STATIC = Path(__file__).parent / "play" / "static"
_STEPS = 65535


def tightest(episode: WorstEpisode) -> int:
    """The control period with the least clearance of the hazard for which the episode was chosen."""
    events = episode.trajectory.events
    nearness = events.pursuer_clearance if episode.hazard == "capture" else events.obstacle_clearance
    return int(np.argmin(np.asarray(nearness)))


def episodes_for_page(
    scenario: Scenario, shield: str, episodes: Sequence[WorstEpisode]
) -> list[dict[str, Any]]:
    """The player's data of these episodes of one run, as JSON values.

    Every series is quantised to 16 bits between its least and its largest value, which keeps four to five
    digits.
    """
    return [_packed(scenario, shield, episode) for episode in episodes]


def player(episodes: Sequence[Mapping[str, Any]]) -> dict[str, Markup]:
    """The player's parts for the page template: `data` as JSON, `script`, and `colours` as a style sheet.

    It uses the drawing code and the colours of the live page.
    """
    scene = (_STATIC / "scene.js").read_text(encoding="utf-8")
    text = json.dumps(list(episodes), allow_nan=False, separators=(",", ":"))
    return {
        # A script element ends at the first "</", even inside a string.
        "data": Markup(text.replace("<", "\\u003c")),
        "script": Markup(re.sub(r"^export ", "", scene, flags=re.MULTILINE)),
        "colours": Markup(_colours((_STATIC / "play.css").read_text(encoding="utf-8"))),
    }


def _colours(sheet: str) -> str:
    """The live page's colours, limited to the player, because the report uses other names."""
    declared = "\n".join(line for line in sheet.splitlines() if line.startswith("@property"))
    values = sheet.partition(":root {")[2].partition("}")[0]
    return f"{declared}\n.stage {{{values}}}"


def _packed(scenario: Scenario, shield: str, episode: WorstEpisode) -> dict[str, Any]:
    trajectory, period = episode.trajectory, float(scenario.control_period)
    moment = tightest(episode)
    first = max(0, moment - round(BEFORE / period))
    last = min(trajectory.length, moment + 1 + round(AFTER / period))
    worlds, slots = slice(first, last + 1), slice(first, last)
    poses = np.asarray(trajectory.worlds.pursuers)[worlds]
    obstacles = np.asarray(trajectory.worlds.obstacles)[worlds]
    wheels = np.asarray(trajectory.wheel_speeds)[slots]
    status = np.asarray(trajectory.status)[slots]
    series: dict[str, Any] = {
        "x": np.asarray(trajectory.worlds.evader)[worlds, 0],
        "y": np.asarray(trajectory.worlds.evader)[worlds, 1],
        "nx": np.nan_to_num(np.asarray(trajectory.nominal)[slots, 0]),
        "ny": np.nan_to_num(np.asarray(trajectory.nominal)[slots, 1]),
        "ax": np.asarray(trajectory.action)[slots, 0],
        "ay": np.asarray(trajectory.action)[slots, 1],
        "correction": np.asarray(trajectory.intervention)[slots],
        "lost": (status >= Status.INFEASIBLE).astype(float),
    }
    for name, clearance in (
        ("capture", trajectory.events.pursuer_clearance),
        ("collision", trajectory.events.obstacle_clearance),
    ):
        values = np.asarray(clearance)[slots]
        if np.all(np.isfinite(values)):
            series[name] = values
    for index in range(poses.shape[1]):
        series |= {f"p{index}{axis}": poses[:, index, i] for i, axis in enumerate("xy")}
        series[f"p{index}h"] = np.unwrap(poses[:, index, 2])
        series |= {f"w{index}{side}": wheels[:, index, i] for i, side in enumerate("lr")}
    for index in range(obstacles.shape[1]):
        series |= {f"o{index}{axis}": obstacles[:, index, i] for i, axis in enumerate("xy")}
    packed = {name: _steps(np.asarray(values, np.float64)) for name, values in series.items()}
    obstacle_speeds = np.asarray(trajectory.worlds.obstacles)[first, :, 2:]
    cut = first > 0 or last < trajectory.length
    return {
        "shield": shield,
        "shieldWords": shield_words(shield),
        "number": episode.number,
        "hazard": episode.hazard,
        "outcome": trajectory.outcome,
        "words": _words(trajectory, episode, period),
        "period": period,
        "start": first * period,
        "whole": trajectory.length * period,
        "cut": cut,
        "moment": (moment + 1 - first) * period,
        "pursuers": poses.shape[1],
        "obstacles": [[round(float(value), 5) for value in speed] for speed in obstacle_speeds],
        "target": [round(float(value), 4) for value in np.asarray(trajectory.worlds.target)[first]],
        "arena": float(scenario.arena_side),
        "reach": float(scenario.reach_distance),
        "numbers": {"pursuer_half_axle": drawn_half_axle(scenario), "capture_set": _capture_set(scenario)}
        | {
            name: float(getattr(scenario, name))
            for name in (
                "evader_speed",
                "pursuer_speed",
                "capture_distance",
                "collision_distance",
            )
        },
        "series": packed,
    }


def _capture_set(scenario: Scenario) -> list[float]:
    """Radius (m) and speed ratio of the capture set that every view draws, see `capture_set_outline`."""
    kept = guarded(scenario)
    return [float(kept.capture_distance), min(float(kept.evader_speed / kept.pursuer_speed), 1.0)]


def _words(trajectory: Trajectory, episode: WorstEpisode, period: float) -> str:
    """The outcome of an episode and why it is shown, in words."""
    events = trajectory.events
    ended = f"{OUTCOME_WORDS[trajectory.outcome]} after {shown_number(trajectory.length * period, 1, ' s')}"
    nearness = events.pursuer_clearance if episode.hazard == "capture" else events.obstacle_clearance
    least = float(np.min(np.asarray(nearness)))
    if least <= 0.0:
        return ended
    spare = shown_number(1000 * least, 1, " mm") if least < 0.05 else shown_number(least, 2, " m")
    return f"{ended}; {spare} from {episode.hazard}"


def _steps(values: Float[np.ndarray, "n"]) -> list[Any]:
    """Least value, step, and the values as numbers of steps: 16 bit, little-endian, in base 64."""
    low, high = float(np.min(values, initial=np.inf)), float(np.max(values, initial=-np.inf))
    if not len(values):
        return [0.0, 0.0, ""]
    step = (high - low) / _STEPS
    whole = np.rint((values - low) / step) if step > 0.0 else np.zeros_like(values)
    return [low, step, base64.b64encode(whole.astype("<u2").tobytes()).decode()]
