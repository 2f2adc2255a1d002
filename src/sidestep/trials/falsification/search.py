"""The search for counterexamples: attacks in turn until the time is over, with all findings on disk."""

from __future__ import annotations

import time
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Any

import jax
import numpy as np

import sidestep
from sidestep import _interrupts
from sidestep._bounds import DURATION, EPISODES, check, taken
from sidestep.learning import load_policy
from sidestep.loop.policies import GOAL_SEEKING, as_policy
from sidestep.safety import Shield, as_shield
from sidestep.store.files import OutputError, json_safe, make_folder
from sidestep.store.runs import (
    NOT_BEGUN,
    OUTCOMES,
    RunError,
    append_metrics,
    create_run,
    open_run,
    read_metrics,
    read_summary,
    refuse_changes,
    write_json,
    write_summary,
    writing,
)
from sidestep.trials.falsification import learned_state as learned
from sidestep.trials.falsification.attacks import ATTACKS, Round, make_attack
from sidestep.trials.falsification.chases import GOALS, Target
from sidestep.trials.falsification.continuing import budget_for, check_policy, plan_for
from sidestep.trials.falsification.counterexamples import (
    Counterexample,
    describe_policy,
    make_counterexample,
    play,
    shield_name,
    write_counterexample,
)
from sidestep.trials.falsification.tallies import (
    COUNTERS,
    LEAST,
    Falsification,
    Plan,
    Progress,
    Tally,
    clearance_of,
)
from sidestep.trials.falsification.verdict import judge
from sidestep.world import Scenario, scenario_to_dict

_WANTED = {"capture": ("captured",), "collision": ("collided",), "both": ("captured", "collided")}
_EXAMINED = 16
_DEEPER = 1e-4


def check_plan(
    scenario: Scenario, plan: Plan, minutes: float | None = None, episodes: int | None = None
) -> None:
    """**Raises** `ValueError` naming an invalid field of the plan or limit, its value and what is allowed."""
    check(plan)
    for name, value, bound in (("minutes", minutes, DURATION), ("episodes", episodes, EPISODES)):
        if value is not None:
            taken(name, value, bound)
    if plan.goal not in GOALS:
        raise ValueError(f"goal = {plan.goal!r}: it must be one of {', '.join(map(repr, GOALS))}")
    if plan.goal == "collision" and scenario.obstacle_count == 0:
        raise ValueError("goal = 'collision', but the scenario has no obstacle to collide with")
    unknown = [name for name in plan.attacks if name not in ATTACKS]
    if unknown or not plan.attacks:
        raise ValueError(f"attacks = {list(plan.attacks)}: they must be some of {', '.join(ATTACKS)}")
    if len(set(plan.attacks)) < len(plan.attacks):
        raise ValueError(f"attacks = {list(plan.attacks)}: each may be named only once")
    if plan.seconds < float(scenario.control_period):
        raise ValueError(f"seconds = {plan.seconds!r}: it must be at least one control period")


def falsify(
    scenario: Scenario,
    policy: Any,
    shield: str | Shield,
    *,
    out: str | Path,
    plan: Plan | None = None,
    minutes: float | None = None,
    episodes: int | None = None,
    resume: bool = False,
    progress: Callable[[Progress], None] | None = None,
) -> Falsification:
    """Search for a pursuer and a start with which the evader is captured or collides.

    Attacks take turns; the one with the least time so far is next. Round r of an attack depends only on the
    seed, the attack and r. A lost chase is replayed alone through the control step, and kept only if it is
    lost again (see `Plan.most`).

    **Arguments:**

    - `policy`: `goal-seeking`, a run folder or any policy
    - `shield`: a name or a `Shield`
    - `out`: the folder to write, locked until the last file is written
    - `minutes`: duration of the search (3 unless `episodes` is given); on resuming, in addition to the time
      already used
    - `episodes`: after which an attack ends
    - `resume`: continue the search in `out`. The settings must equal the stored ones (`search_settings` reads
      them; the stored plan is the default). Without `minutes` and `episodes` the rest of the stored budget
      is used
    - `progress`: called after each round

    Ctrl-C ends the search and keeps its results.

    **Raises** `ValueError` for invalid settings (see `check_plan`), robots other than the built-in ones, or a
    folder that is occupied or cannot be resumed; `FolderInUseError` when another process writes there.
    """
    folder = Path(out)
    source = policy if isinstance(policy, (str, Path)) else None
    stored = open_run(folder, "falsification", otherwise=NOT_BEGUN) if resume else None
    if stored is not None:
        plan = plan_for(stored, plan)
    plan = plan or Plan()
    policy = _load(source) if source is not None else policy
    scenario.check_built_in(
        "the falsifier", "search with evaluate, over pursuers and starts, or falsify the problem that covers "
        "theirs, sidestep.safety.covered(of_control_point(scenario))",
    )  # fmt: skip
    check_plan(scenario, plan, minutes, episodes)
    shield_called = shield_name(shield, scenario)
    about = {
        "kind": "falsification",
        "scenario": scenario_to_dict(scenario),
        "shield": shield_called,
        "policy": describe_policy(policy, source),
        "version": sidestep.__version__,
        **{name: getattr(plan, name) for name in Plan.__dataclass_fields__},
    }
    if stored is not None:
        refuse_changes(folder, stored, about, ("scenario", "shield", *Plan.__dataclass_fields__))
        check_policy(folder, stored["policy"], about["policy"])
    target = Target(scenario, as_policy(policy, scenario), as_shield(shield, scenario))
    with writing(folder, resume=resume):
        if stored is None:
            about["budget"] = budget_for(folder, {}, 0.0, minutes, episodes)
            create_run(folder, about)
        for name in ("counterexamples", "checkpoints", "figures"):
            make_folder(folder / name)
        search = _RunningSearch(folder, target, shield_called, about, plan, progress)
        if stored is not None:
            about["budget"] = budget_for(folder, stored.get("budget", {}), search.before, minutes, episodes)
            if about["budget"] != stored.get("budget"):
                write_json(folder / "config.json", about)
        return search.run()


def _load(source: str | Path) -> Any:
    return source if source == GOAL_SEEKING else load_policy(source)


class _RunningSearch:
    """The state of a running search."""

    def __init__(
        self,
        folder: Path,
        target: Target,
        shield: str,
        about: dict[str, Any],
        plan: Plan,
        progress: Callable[[Progress], None] | None,
    ):
        self.folder, self.target, self.shield, self.about, self.plan = folder, target, shield, about, plan
        self.progress = progress
        periods = max(1, round(plan.seconds / float(target.scenario.control_period)))
        self.limit = min(periods, target.scenario.episode_steps)
        self.attacks = {name: make_attack(name, plan.batch, self.limit) for name in plan.attacks}
        self.tallies = {name: Tally() for name in plan.attacks}
        for line in read_metrics(folder):
            self.tallies[line["attack"]].add(line)
        self.before = sum(tally.seconds for tally in self.tallies.values())
        # Rounds count from 0; the last number is reserved for the initial state.
        self.states = {
            name: learned.restored(
                folder, name, self.attacks[name].init(self._key(name, 2**31 - 1)), self.tallies[name].rounds
            )
            for name in plan.attacks
        }
        self.began = time.perf_counter()

    @property
    def elapsed(self) -> float:
        """Seconds of search, including those before a resume."""
        return self.before + time.perf_counter() - self.began

    def _key(self, name: str, number: int) -> Any:
        attack = jax.random.fold_in(jax.random.key(self.plan.seed), ATTACKS.index(name))
        return jax.random.fold_in(attack, number)

    @_interrupts.held()
    def run(self) -> Falsification:
        """Run rounds until the time is over or every attack has played its episodes."""
        minutes, episodes = self.about["budget"]["minutes"], self.about["budget"]["episodes"]
        budget = None if minutes is None else 60.0 * minutes
        interrupted, rounds = False, 0
        try:
            while budget is None or self.elapsed < budget:
                _interrupts.check()
                waiting = [
                    name for name in self.plan.attacks
                    if episodes is None or self.tallies[name].episodes < episodes
                ]  # fmt: skip
                if not waiting:
                    break
                name = min(waiting, key=lambda name: self.tallies[name].seconds)
                self._round(name)
                rounds += 1
                if self.progress is not None:
                    self.progress(Progress(name, self.tallies[name], self.tallies, self.elapsed, budget))
        except KeyboardInterrupt:
            interrupted = True
        except OutputError as error:
            with suppress(OutputError):
                write_summary(self.folder, self._summary(True))
            raise error.and_kept(self._kept()) from error.__cause__
        if not (rounds or interrupted) and (ended := self._ended_before()) is not None:
            return Falsification(self.folder, ended, self.tallies, False, had_ended=True)
        summary = self._summary(interrupted)
        try:
            write_summary(self.folder, summary)
        except OutputError as error:
            raise error.and_kept(self._kept()) from error.__cause__
        return Falsification(self.folder, summary, self.tallies, interrupted)

    def _kept(self) -> str:
        rounds = sum(tally.rounds for tally in self.tallies.values())
        found = sum(len(tally.kept) for tally in self.tallies.values())
        return f"Kept: {rounds} rounds of the search and {found} counterexamples in {self.folder}"

    def _ended_before(self) -> dict[str, Any] | None:
        """The summary if the search had already ended, else None."""
        try:
            summary = read_summary(self.folder)
        except RunError:
            return None
        return None if summary.get("interrupted", True) else summary

    def _round(self, name: str) -> None:
        began, tally = time.perf_counter(), self.tallies[name]
        key = self._key(name, tally.rounds)
        attack = self.attacks[name]
        state, result = attack.round(self.target, self.plan.goal, self.states[name], key)
        kept, unconfirmed = self._keep(name, result)
        self.states[name] = state
        if state is not None:
            learned.keep(self.folder, name, state, attack.rows(state), tally.rounds)
        line = json_safe(
            {
                "attack": name,
                "round": tally.rounds,
                "episodes": len(result.steps),
                "control_periods": result.simulated,
                "captured": np.sum(result.outcome == OUTCOMES.index("captured")),
                "collided": np.sum(result.outcome == OUTCOMES.index("collided")),
                "unconfirmed": unconfirmed,
                "pursuer_invalid": np.sum(~np.all(np.isfinite(result.wheels), axis=(-2, -1))),
                **{which: np.min(getattr(result, which)) for which in LEAST},
                "counterexamples": kept,
                "seconds": time.perf_counter() - began,
                "at": self.elapsed,
            }
        )
        append_metrics(self.folder, [line])
        tally.add(line)

    def _keep(self, name: str, result: Round) -> tuple[list[dict[str, Any]], int]:
        """Replay the lost chases, the deepest first, and keep those that `Plan.most` allows."""
        kept: list[dict[str, Any]] = []
        unconfirmed = 0
        for outcome in _WANTED[self.plan.goal]:
            clearances = getattr(result, clearance_of(outcome))
            lost = np.flatnonzero(result.outcome == OUTCOMES.index(outcome))
            count, least = self.tallies[name].deepest(outcome)
            for number in lost[np.argsort(clearances[lost], kind="stable")][:_EXAMINED]:
                found = self._examine(name, result, int(number))
                if found is None:
                    unconfirmed += 1
                    continue
                depth = found.about[clearance_of(outcome)]
                inside = found.about["assumption"] is None
                if count >= self.plan.most and depth >= least - _DEEPER and not inside:
                    continue
                count, least = count + 1, min(least, depth)
                kept.append(self._store(name, int(number), found))
        return kept, unconfirmed

    def _examine(self, name: str, result: Round, number: int) -> Counterexample | None:
        """The counterexample of a lost chase; None if its replay is not lost (rounding)."""
        world = jax.tree.map(lambda leaf: leaf[number], result.starts)
        wheels = result.wheels[number, : result.steps[number]]
        scenario, guaranteed = self.target.scenario, self.plan.guaranteed_clearance
        trajectory = play(scenario, self.target.policy, self.target.shield, world, wheels, self.limit)
        if trajectory.outcome != OUTCOMES[result.outcome[number]]:
            return None
        verdict = judge(scenario, self.shield, trajectory, guaranteed)
        return make_counterexample(
            scenario,
            trajectory,
            wheels,
            shield=self.shield,
            policy=self.about["policy"],
            seed=self.plan.seed,
            attack=name,
            round=self.tallies[name].rounds,
            limit=self.limit,
            assumption=verdict.assumption,
            words=verdict.words,
            guaranteed_clearance=guaranteed,
        )

    def _store(self, name: str, number: int, found: Counterexample) -> dict[str, Any]:
        file = f"counterexamples/{name}-{self.tallies[name].rounds:04d}-{number:03d}.npz"
        write_counterexample(self.folder / file, found)
        names = ("outcome", "time", "pursuer_clearance", "obstacle_clearance", "assumption", "words")
        return {"file": file, "attack": name, "at": self.elapsed, **{key: found.about[key] for key in names}}

    def _summary(self, interrupted: bool) -> dict[str, Any]:
        attacks = {}
        for name, tally in self.tallies.items():
            figures = {key: getattr(tally, key) for key in (*COUNTERS, *LEAST, "first")}
            attacks[name] = {**figures, "kept": len(tally.kept)}
        found = sorted((e for tally in self.tallies.values() for e in tally.kept), key=lambda e: e["at"])
        assumptions = [entry["assumption"] for entry in found]
        return json_safe(
            {
                **self.about,
                "seconds": self.elapsed,
                "interrupted": interrupted,
                "episodes": sum(tally.episodes for tally in self.tallies.values()),
                "control_periods": sum(tally.control_periods for tally in self.tallies.values()),
                "captured": sum(tally.captured for tally in self.tallies.values()),
                "collided": sum(tally.collided for tally in self.tallies.values()),
                "pursuer_invalid": sum(tally.pursuer_invalid for tally in self.tallies.values()),
                "first_seconds": found[0]["at"] if found else None,
                "kept": len(found),
                "inside_assumptions": sum(name is None for name in assumptions),
                "by_assumption": {str(name): assumptions.count(name) for name in dict.fromkeys(assumptions)},
                "attacks": attacks,
                "counterexamples": found,
            }
        )
