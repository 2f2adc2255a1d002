"""Batched Monte Carlo: many episodes of any policy, shield and pursuer in parallel."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import AbstractContextManager, nullcontext
from itertools import pairwise
from typing import Any

import numpy as np
from jaxtyping import PRNGKeyArray

from sidestep._arrays import whole_number
from sidestep._threads import side_by_side, useful_threads
from sidestep.loop.batch import EpisodeBatch, Trial
from sidestep.loop.episode import Task, straight_times
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
"""The number of lanes should be a multiple of this; the CPU computes remaining lanes one by one."""
_LEAST_WIDTH = 2 * _WHOLE


Hook = Callable[[str], AbstractContextManager[Callable[..., None]]]
"""Opens a progress display for a labelled part: returns a context manager that yields a callable."""


def quiet(label: str) -> AbstractContextManager[Callable[..., None]]:
    """The `Hook` that shows nothing."""
    return nullcontext(lambda *_: None)


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
    """Run `episodes` independent episodes to their ends and return their results.

    Episode i draws its random numbers from `fold_in(key, i)`. They do not depend on `batch`, `threads` or the
    number of episodes; rounding may differ between batch sizes.

    **Arguments:**

    - `policy` any `(observation) -> action in [-1, 1]^2`, in JAX or not, or `"goal-seeking"`; it decides
      every `policy.decision_steps` control periods (1 if it has no such attribute). Or `"planner"`, which
      knows the pursuer's strategy, see `Planner`
    - `shield` a name or a `Shield`; `pursuer` a name, a `Pursuer` or a callable
      `(scenario, world, key) -> wheel speeds (2,)`
    - `key` a random key or a seed
    - `batch` episodes run at once; `progress(finished, episodes)` is called between chunks
    - `mapped` whether to map the interventions, as `Evaluation.map`
    - `threads` the largest number of threads, which share `batch`; by default the number of cores. Always one
      on an accelerator, or if policy or pursuer runs on the host

    **Raises** `ValueError` for a number that is not positive, an unknown name, and an answer of the wrong
    shape. A non-finite action goes to the shield and counts as `invalid`. A pursuer whose wheel speeds are
    not finite stands still, which counts as `pursuer_invalid`.
    """
    episodes, batch = whole_number("episodes", episodes), whole_number("batch", batch, most=2**20)
    policy, pursuer = as_policy(policy, scenario, in_episode=True), as_pursuer(pursuer)
    decision_steps_of(policy)
    # Python code on the host runs in one thread at a time.
    on_host = isinstance(policy, HostPolicy) or runs_on_host(pursuer, scenario)
    most = 1 if on_host else min(episodes, max(1, batch // _LEAST_WIDTH))
    threads = useful_threads(most if threads is None else min(most, whole_number("threads", threads)))
    width = batch if threads == 1 else -(-batch // (threads * _WHOLE)) * _WHOLE
    task = Task(scenario, policy, as_shield(shield, scenario), pursuer)
    reading = {"kept": no_periods(), "read": add_periods} if mapped else {}
    trial = Trial(task, as_key(key), width, **reading)
    shares = [episodes * share // threads for share in range(threads + 1)]
    batches = [EpisodeBatch(trial, *share) for share in pairwise(shares)]
    if threads > 1:
        # Otherwise every thread would compile.
        batches[0].get_ready()
    finished = 0

    def report(more: int) -> None:
        nonlocal finished
        finished += more
        if progress is not None:
            progress(finished, episodes)

    side_by_side(batches, report)
    names = batches[0].results
    results = {name: np.concatenate([part.results[name] for part in batches]) for name in names}
    where = None
    if mapped:
        where = InterventionMap.of_sums(
            float(map_reach(scenario)), np.sum([part.sums for part in batches], axis=0)
        )
    return _evaluation(scenario, results, where)


def _evaluation(
    scenario: Scenario, results: dict[str, np.ndarray], where: InterventionMap | None
) -> Evaluation:
    steps, period = results["steps"], np.asarray(scenario.control_period, dtype=float)
    return Evaluation(
        outcome=results["outcome"],
        returns=results["total_reward"],
        steps=steps,
        times=steps * period,
        min_pursuer_clearance=results["pursuer_clearance"],
        min_obstacle_clearance=results["obstacle_clearance"],
        interventions=results["interventions"],
        infeasible=results["infeasible"],
        invalid=results["invalid"],
        mean_correction=results["correction"] / steps,
        max_correction=results["max_correction"],
        map=where,
        pursuer_invalid=results["pursuer_invalid"],
        straight_times=straight_times(scenario, results["distance"]),
        time_limit=float(scenario.episode_steps * period),
    )
