"""Explain captures under the paper's shield: the motion its row assumes of the pursuer, and the actual
one."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float, PRNGKeyArray

from sidestep.loop.keys import episode_key
from sidestep.loop.rollout import Trajectory, rollout
from sidestep.trials.evaluation import Evaluation
from sidestep.world import Scenario

CAUSES = ("reversing", "head-on", "other")
"""`reversing`: the pursuer drove backwards, which the row takes for moving away. `head-on`: no velocity
satisfied the row. `other`: neither."""

_LAST_SECONDS = 0.5


@dataclass(frozen=True)
class Capture:
    """One capture, period by period, along the unit vector n from the pursuer to the evader.

    - `expected` m/s: the offset of the paper's row, V n.(cos theta, sin theta) - gamma h, which assumes that
      the pursuer drives forwards at full speed
    - `needed` m/s: the same with the pursuer's true speed v, v n.(cos theta, sin theta) - gamma h
    - `moved` m/s: the evader's n.u
    - `range_barrier` m: h = |p_e - p_d| - l
    - `pursuer`: index of the capturing pursuer
    - `decisive_period`: from this period to the end the evader moved less than needed
    """

    pursuer: int
    cause: str
    decisive_period: int
    normal: Float[np.ndarray, "t 2"]
    range_barrier: Float[np.ndarray, "t"]
    expected: Float[np.ndarray, "t"]
    needed: Float[np.ndarray, "t"]
    moved: Float[np.ndarray, "t"]


def explain_capture(scenario: Scenario, trajectory: Trajectory) -> Capture:
    """Explain the capture that ends an episode. **Raises** `ValueError` when it ended otherwise."""
    if trajectory.outcome != "captured":
        raise ValueError(f"the episode ended '{trajectory.outcome}', not in a capture")
    evader, pursuers = np.asarray(trajectory.worlds.evader), np.asarray(trajectory.worlds.pursuers)
    last = pursuers[-1, :, :2] - evader[-1]
    pursuer = int(np.argmin(np.hypot(last[:, 0], last[:, 1])))
    poses, wheels = pursuers[:-1, pursuer], np.asarray(trajectory.worlds.wheel_speeds)[1:, pursuer]
    offset = evader[:-1] - poses[:, :2]
    distance = np.hypot(offset[:, 0], offset[:, 1])
    normal = offset / np.maximum(distance, np.finfo(distance.dtype).tiny)[:, None]
    ahead = normal[:, 0] * np.cos(poses[:, 2]) + normal[:, 1] * np.sin(poses[:, 2])
    h = distance - float(scenario.capture_distance)
    spare = float(scenario.pursuer_gain) * h
    expected = float(scenario.pursuer_speed) * ahead - spare
    needed = wheels.mean(axis=-1) * ahead - spare
    moved = np.sum(normal * np.asarray(trajectory.action), axis=-1)

    final = slice(-max(1, round(_LAST_SECONDS / float(scenario.control_period))), None)
    closing = needed[final] + spare[final] > 0.0
    reversing = bool(np.any(closing & (wheels[final].mean(axis=-1) < 0.0)))
    beyond = expected > float(scenario.evader_speed)
    cause = "reversing" if reversing else "head-on" if bool(np.any(beyond[final])) else "other"
    calm = np.flatnonzero(moved >= needed - 1e-6)
    decisive = min(int(calm[-1]) + 1 if len(calm) else 0, trajectory.length - 1)
    return Capture(pursuer, cause, decisive, normal, h, expected, needed, moved)


def count_causes(scenario: Scenario, trajectories: Sequence[Trajectory]) -> dict[str, int]:
    """The number of these captures per cause, see `CAUSES`."""
    causes = [explain_capture(scenario, trajectory).cause for trajectory in trajectories]
    return {cause: causes.count(cause) for cause in CAUSES}


def examine_captures(
    scenario: Scenario,
    policy: Any,
    shield: Any,
    pursuer: Any,
    evaluation: Evaluation,
    key: PRNGKeyArray | int,
    *,
    most: int = 60,
) -> tuple[dict[str, int], Trajectory | None]:
    """Replay the captures of an evaluation, at most the first `most`, and count their causes.

    **Arguments:** those of the call of `evaluate`.

    **Returns** the number of captures per cause, and an example of the most frequent cause, of at least 3 s
    if there is one (None without captures).
    """
    numbers = evaluation.numbers_of("captured")[:most]
    found = [rollout(scenario, policy, shield, pursuer, episode_key(key, int(number))) for number in numbers]
    # Rounding differs between a single episode and a batch, so a borderline episode may end differently.
    found = [trajectory for trajectory in found if trajectory.outcome == "captured"]
    counts = count_causes(scenario, found)
    if not found:
        return counts, None
    usual = max(CAUSES, key=lambda cause: counts[cause])
    typical = [trajectory for trajectory in found if explain_capture(scenario, trajectory).cause == usual]
    lasting = 3.0 / float(scenario.control_period)
    return counts, next((trajectory for trajectory in typical if trajectory.length >= lasting), typical[0])
