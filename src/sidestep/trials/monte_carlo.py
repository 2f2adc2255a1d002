"""Batched Monte Carlo: many episodes of any policy, shield and pursuer at once."""

from __future__ import annotations

from collections.abc import Callable
from itertools import pairwise
from typing import Any

import numpy as np
from jaxtyping import PRNGKeyArray

from sidestep._arrays import whole_number
from sidestep._threads import side_by_side, useful_threads
from sidestep.loop.crew import Crew, Trial
from sidestep.loop.episode import Task
from sidestep.loop.keys import as_key
from sidestep.loop.policies import HostPolicy, as_policy
from sidestep.loop.step import decision_steps_of
from sidestep.pursuit import as_pursuer
from sidestep.pursuit.foreign import runs_on_host
from sidestep.safety import Shield, as_shield
from sidestep.trials.evaluation import Evaluation
from sidestep.trials.intervention_map import InterventionMap, add_periods, map_reach, no_periods
from sidestep.world import Scenario

_WHOLE = 16
"""Lanes that every instruction set's vectors divide; others are computed one by one."""
_LEAST_WIDTH = 2 * _WHOLE


def evaluate(
    scenario: Scenario,
    policy: str | Callable[..., Any],
    shield: str | Shield,
    pursuer: str | Callable[..., Any],
    episodes: int,
    key: PRNGKeyArray | int,
    *,
    batch: int = 256,
    progress: Callable[[int, int], None] | None = None,
    mapped: bool = False,
    threads: int | None = None,
) -> Evaluation:
    """Run `episodes` independent episodes to their ends and report what happened.

    Episode i draws all its random numbers from `fold_in(key, i)`: neither `batch`, `threads` nor the number
    of episodes changes them (rounding may differ in the last digit between batch sizes).

    **Arguments:**

    - `policy` any `(observation) -> action in [-1, 1]^2`, in JAX or not, or `"goal-seeking"`; asked every
      `policy.decision_steps` control periods (1 if it has none)
    - `shield` a name or a `Shield`; `pursuer` a name, a `Pursuer` or a callable
      `(scenario, world, key) -> wheel speeds (2,)`
    - `key` a random key or a seed
    - `batch` episodes that run at once; `progress(finished, episodes)` is called between chunks
    - `mapped` whether to sum up where the shield stepped in, as `Evaluation.map`
    - `threads` at most so many share the episodes, each with its part of `batch`; as many as there are cores
      if not given. One where an accelerator computes, or a policy or pursuer runs on the host

    **Raises** `ValueError` for a number that is not positive, for an unknown name and for an answer of the
    wrong shape. An action that is not finite is passed on to the shield and counted as `invalid`;
    a pursuer whose wheel speeds are not finite stands still, which is counted as `pursuer_invalid`.
    """
    episodes, batch = whole_number("episodes", episodes), whole_number("batch", batch, most=2**20)
    policy, pursuer = as_policy(policy, scenario), as_pursuer(pursuer)
    decision_steps_of(policy)
    # Someone's code on the host would only be waited for by several threads.
    asked = isinstance(policy, HostPolicy) or runs_on_host(pursuer, scenario)
    most = 1 if asked else min(episodes, max(1, batch // _LEAST_WIDTH))
    threads = useful_threads(most if threads is None else min(most, whole_number("threads", threads)))
    width = batch if threads == 1 else -(-batch // (threads * _WHOLE)) * _WHOLE
    task = Task(scenario, policy, as_shield(shield, scenario), pursuer)
    reading = {"kept": no_periods(), "read": add_periods} if mapped else {}
    trial = Trial(task, as_key(key), width, **reading)
    shares = [episodes * share // threads for share in range(threads + 1)]
    crews = [Crew(trial, *share) for share in pairwise(shares)]
    if threads > 1:
        # Else each would compile it.
        crews[0].get_ready()
    finished = 0

    def tell(more: int) -> None:
        nonlocal finished
        finished += more
        if progress is not None:
            progress(finished, episodes)

    side_by_side(crews, tell)
    results = {name: np.concatenate([crew.results[name] for crew in crews]) for name in crews[0].results}
    where = None
    if mapped:
        where = InterventionMap.of_sums(
            float(map_reach(scenario)), np.sum([crew.sums for crew in crews], axis=0)
        )
    return _evaluation(scenario, results, where)


def _evaluation(
    scenario: Scenario, results: dict[str, np.ndarray], where: InterventionMap | None
) -> Evaluation:
    steps = results["steps"]
    return Evaluation(
        outcome=results["outcome"],
        returns=results["total_reward"],
        steps=steps,
        times=steps * np.asarray(scenario.control_period, dtype=float),
        min_pursuer_clearance=results["pursuer_clearance"],
        min_obstacle_clearance=results["obstacle_clearance"],
        interventions=results["interventions"],
        infeasible=results["infeasible"],
        invalid=results["invalid"],
        mean_correction=results["correction"] / steps,
        max_correction=results["max_correction"],
        map=where,
        pursuer_invalid=results["pursuer_invalid"],
    )
