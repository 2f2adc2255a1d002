"""Results of a batch of episodes: counts, rates with intervals, clearances, interventions."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float, Int

from sidestep.store.files import json_safe
from sidestep.store.runs import OUTCOMES
from sidestep.trials.intervention_map import InterventionMap
from sidestep.trials.statistics import wilson_interval

_QUANTILES = (0.01, 0.05, 0.25, 0.5, 0.75, 0.95, 0.99)
REACHED_BY = (15, 30, 60, 120)
"""Times (s) by which the share of episodes that have reached the target is reported."""


@dataclass(frozen=True)
class Evaluation:
    """Results of `evaluate`, one entry per episode, in order of the episode numbers.

    - `outcome`: indices into `OUTCOMES`
    - `returns`, undiscounted; `steps`, control periods; `times` s
    - `min_pursuer_clearance` and `min_obstacle_clearance` m, infinite without such a robot
    - `interventions`, `infeasible`, `invalid`: numbers of control periods in which the shield did not answer
      with the nominal action, could not satisfy its rows, got non-finite input
    - `mean_correction` over all periods and `max_correction`, m/s
    - `map` of interventions, if requested
    - `pursuer_invalid`: control periods in which a pursuer's wheel speeds were not finite and it stood still
      (None: recorded by a version that did not count them)
    - `straight_times`, s: the time from the start to the target straight at full speed, which no policy can
      beat; `time_limit` of an episode, s (None: recorded by a version without them)
    """

    outcome: Int[np.ndarray, "episodes"]
    returns: Float[np.ndarray, "episodes"]
    steps: Int[np.ndarray, "episodes"]
    times: Float[np.ndarray, "episodes"]
    min_pursuer_clearance: Float[np.ndarray, "episodes"]
    min_obstacle_clearance: Float[np.ndarray, "episodes"]
    interventions: Int[np.ndarray, "episodes"]
    infeasible: Int[np.ndarray, "episodes"]
    invalid: Int[np.ndarray, "episodes"]
    mean_correction: Float[np.ndarray, "episodes"]
    max_correction: Float[np.ndarray, "episodes"]
    map: InterventionMap | None = None
    pursuer_invalid: Int[np.ndarray, "episodes"] | None = None
    straight_times: Float[np.ndarray, "episodes"] | None = None
    time_limit: float | None = None

    def numbers_of(self, outcome: str) -> Int[np.ndarray, "some"]:
        """Numbers of the episodes with this outcome; `rollout` with `episode_key` replays them."""
        return np.flatnonzero(self.outcome == OUTCOMES.index(outcome))

    def _count(self, outcome: str) -> int:
        return len(self.numbers_of(outcome))

    @property
    def episodes(self) -> int:
        """Number of episodes."""
        return len(self.outcome)

    @property
    def captured(self) -> int:
        """Episodes that ended with a capture, with or without a collision in the same period."""
        return self._count("captured")

    @property
    def collided(self) -> int:
        """Episodes that ended with a collision and no capture."""
        return self._count("collided")

    @property
    def reached(self) -> int:
        """Episodes that ended at the target, neither captured nor collided."""
        return self._count("reached")

    @property
    def timed_out(self) -> int:
        """Episodes ended by the time limit."""
        return self._count("timed_out")

    @property
    def safe(self) -> int:
        """Episodes without capture or collision."""
        return self.episodes - self.captured - self.collided

    @property
    def reach_time_median(self) -> float | None:
        """Median time (s) of the episodes that reached the target; None if none did."""
        times = self.times[self.numbers_of("reached")]
        return float(np.median(times)) if len(times) else None

    @property
    def times_to_target(self) -> Float[np.ndarray, "episodes"]:
        """Time (s) of each episode to the target; the time limit where it was not reached, for whatever
        reason, so that policies can be compared start by start. Without a `time_limit`, infinite there."""
        limit = np.inf if self.time_limit is None else self.time_limit
        return np.where(self.outcome == OUTCOMES.index("reached"), self.times, limit)

    def _share(self, periods: Int[np.ndarray, "episodes"]) -> float:
        return float(periods.sum() / self.steps.sum())

    @property
    def intervention_rate(self) -> float:
        """Share of control periods in which the shield did not answer with the nominal action."""
        return self._share(self.interventions)

    @property
    def infeasible_rate(self) -> float:
        """Share of control periods in which the shield could not satisfy its rows."""
        return self._share(self.infeasible)

    @property
    def invalid_rate(self) -> float:
        """Share of control periods in which the shield got non-finite input."""
        return self._share(self.invalid)

    def to_dict(self) -> dict[str, Any]:
        """JSON values: counts, `X_rate` with its 95 % Wilson interval `X_rate_low`, `X_rate_high` for X in
        captured, collided, reached, timed_out and safe, and summaries of the other attributes.

        `time_mean` is that of `times_to_target`, `straight_time_mean` that of `straight_times`, both in s;
        `reached_by` gives the share that had reached the target after so many seconds. Clearances without
        such a robot, and the median time without an episode that reached, are null.
        """
        counts = {name: self._count(name) for name in OUTCOMES} | {"safe": self.safe}
        report: dict[str, Any] = {"episodes": self.episodes, **counts}
        for name, count in counts.items():
            low, high = wilson_interval(count, self.episodes)
            report |= {
                f"{name}_rate": count / self.episodes,
                f"{name}_rate_low": low,
                f"{name}_rate_high": high,
            }

        def quantiles(values: np.ndarray) -> dict[str, float]:
            # Interpolation between infinite values (no such robot) would give NaN.
            if not np.all(np.isfinite(values)):
                return {f"{q:g}": np.inf for q in _QUANTILES}
            return {
                f"{q:g}": float(v) for q, v in zip(_QUANTILES, np.quantile(values, _QUANTILES), strict=True)
            }

        report |= {
            "reach_time_median": self.reach_time_median,
            "time_mean": float(np.mean(self.times_to_target)),
            "straight_time_mean": None
            if self.straight_times is None
            else float(np.mean(self.straight_times)),
            "time_limit": self.time_limit,
            "reached_by": {
                str(time): float(np.mean((self.times <= time) & (self.outcome == OUTCOMES.index("reached"))))
                for time in REACHED_BY
            },
            "mean_return": float(np.mean(self.returns)),
            "env_steps": int(self.steps.sum()),
            "min_pursuer_clearance": float(np.min(self.min_pursuer_clearance)),
            "min_obstacle_clearance": float(np.min(self.min_obstacle_clearance)),
            "pursuer_clearance_quantiles": quantiles(self.min_pursuer_clearance),
            "obstacle_clearance_quantiles": quantiles(self.min_obstacle_clearance),
            "intervention_rate": self.intervention_rate,
            "infeasible_rate": self.infeasible_rate,
            "invalid_rate": self.invalid_rate,
            "pursuer_invalid": None if self.pursuer_invalid is None else int(self.pursuer_invalid.sum()),
            "pursuer_invalid_episodes": None
            if self.pursuer_invalid is None
            else int(np.count_nonzero(self.pursuer_invalid)),
            "mean_correction": float(np.sum(self.mean_correction * self.steps) / np.sum(self.steps)),
            "max_correction": float(np.max(self.max_correction)),
        }
        return json_safe(report)
