"""The decision core of a robot: from poses and a nominal velocity to a safe velocity, under any fault.

It is independent of transports. The twin, the ROS 2 node and other robots pass it poses with time stamps,
call it once per control period, and drive the velocity it returns.
"""

from __future__ import annotations

import math
import time
from collections import Counter
from collections.abc import Callable
from pathlib import Path
from typing import Any, final

import numpy as np
from jaxtyping import Float

from sidestep.loop.policies import GOAL_SEEKING, as_policy
from sidestep.loop.step import decision_steps_of
from sidestep.robot.answering import Answering, Answers, Estimate, Numbers
from sidestep.robot.decision import LEVELS, Decision
from sidestep.robot.estimates import Estimates
from sidestep.robot.intake import Intake
from sidestep.robot.pace import Pace
from sidestep.robot.readings import LARGEST, Reading, as_numbers
from sidestep.robot.settings import OnboardSettings
from sidestep.safety import PURSUIT_SHIELDS, Shield, Status, make_shield
from sidestep.world import Scenario, World


@final
class Onboard:
    """Decides for one evader. `OnboardSettings` describes its sensors, motors and reactions to faults.

    Pass poses with `see` and, without a policy, nominal velocities with `nominal`; set `target` for a policy.
    Call `decide` once per control period and drive its velocity until the next call. All times (s) must be of
    one clock. Not thread-safe.

    **Arguments:** `shield` a name, or a shield of this scenario (its budget then replaces that of the
    settings); `policy` None if the caller passes nominal velocities, `goal-seeking`, a run folder, or any
    policy; `answering` makes them into calls, by JAX, or with `sidestep.bridges.compiled.CompiledAnswering`
    by compiled C where that agrees.

    **Reactions to faults.**

    - Invalid poses are dropped and counted, see `Reading`.
    - The delay of a pursuer's pose is its age, or `budget.delay` if that is larger.
    - A pose older than usual gives level `degraded`. Older than `stale_after`, it gives `evade` (the robot
      ignores the nominal velocity and flees from the pursuer's last pose) or `stop`, according to `on_fault`.
    - The robot stops without a recent pose of itself, and until every robot of the scenario has been seen.
    - A lost nominal velocity counts as zero.
    - If `decide` is called late, the lateness is added to the delay. If that happens repeatedly, the shield
      decides by its rows, without looking ahead, until calls are on time again.
    - If the clock goes back, the robot stops for that period and all stamped data is forgotten. Decisions
      resume when poses and clock agree again.
    - After a pause, or a clock that jumped ahead, motions and the plan are forgotten.

    **Raises** `ValueError` or `TypeError` for invalid settings, shield, policy or target; nothing for invalid
    poses or times.
    """

    def __init__(
        self,
        scenario: Scenario,
        shield: str | Shield = "joint",
        policy: Any = None,
        settings: OnboardSettings | None = None,
        *,
        answering: Callable[..., Answers] = Answering,
    ):
        scenario.check_built_in(
            "the decision core", "give it the problem of the evader's control point, sidestep.safety.covered("
            "of_control_point(scenario)), and poses of that point, as sidestep.plants.air.Pilot does",
        )  # fmt: skip
        self.scenario, self.settings = scenario, settings or OnboardSettings()
        settings = self.settings
        self.settings.budget.check(scenario)
        if isinstance(shield, str):
            budget = settings.budget if shield in PURSUIT_SHIELDS else None
            shield = make_shield(shield, scenario, budget)
            # Motors that reverse the velocity within a period need no model.
            gained = settings.motor_acceleration * float(scenario.control_period)
            if gained < 2.0 * float(scenario.evader_speed):
                shield = shield.with_acceleration(settings.motor_acceleration)
        if isinstance(policy, (str, Path)) and policy != GOAL_SEEKING:
            # Not before: it takes a tenth of a second, and many cores have no such policy.
            from sidestep.learning import load_policy

            policy = load_policy(policy)
        self._policy = None if policy is None else as_policy(policy, scenario)
        self._decision_steps = 1 if policy is None else decision_steps_of(self._policy)
        self._shield = shield
        self._whole = answering(shield, self._policy)
        self._rows = answering(shield, self._policy, rows_only=True) if shield.looks_ahead else None
        self._period = float(scenario.control_period)
        self._speed = float(scenario.evader_speed)
        self._target = np.full(2, np.nan) if policy is not None else np.zeros(2)
        self.reset()

    def reset(self) -> None:
        """Forget all poses, nominal velocities, faults and commands; keep the compiled programs and the
        target."""
        self._estimates = Estimates(self.scenario, self.settings)
        self._pace = Pace(self._period, self.settings)
        self._intake = Intake(self._period + self.settings.future_tolerance)
        self._last_nominal: tuple[float, Numbers] | None = None
        self._held = np.full(2, np.nan)
        self._now: float | None = None
        self._decided = 0
        self._memory: Any = None

    @property
    def counts(self) -> Counter[tuple[str, Reading]]:
        """Counts per source and `Reading` since the last `reset`: poses of each robot (`evader`, `pursuer 0`,
        ...), nominal velocities (`nominal`), and invalid times of decisions (`clock`)."""
        return self._intake.counts

    @property
    def target(self) -> Float[np.ndarray, "2"]:
        """The policy's target, m, world axes."""
        return self._target.copy()

    @target.setter
    def target(self, place: Any) -> None:
        point = as_numbers(place, (2,))
        if isinstance(point, Reading):
            raise ValueError(f"target = {place!r}: it must be two finite numbers (x, y), m")
        self._target = point

    def see(self, robot: Any, stamp: Any, pose: Any, index: Any = 0, *, now: Any = None) -> Reading:
        """Pass a pose of `evader`, `pursuer` or `obstacle`: x, y (m) and heading (rad; optional for
        obstacles).

        `stamp` (s) is the time of the measurement. `now`, the clock (s), detects stamps from the future.
        Without it, a stamp more than a period ahead of the last decision waits for the next one
        (`Reading.WAITING`), and one more than 1 s ahead is refused. Invalid input is counted; nothing is
        raised.
        """
        gate = self._estimates.gate(robot, index)
        if gate is None:
            return self._intake.unknown(robot, index)
        shapes = ((2,), (3,)) if robot == "obstacle" else ((3,),)
        return self._intake.judge(gate.name, gate.take, stamp, as_numbers(pose, *shapes), now, self._now)

    def nominal(self, stamp: Any, velocity: Any, *, now: Any = None) -> Reading:
        """Pass a nominal velocity (m/s, world axes) of time `stamp` (s); only without a policy. `now` and
        invalid input as for `see`.

        **Raises** `ValueError` if the core has a policy.
        """
        if self._policy is not None:
            raise ValueError("this core has a policy and takes no nominal velocity")
        numbers = as_numbers(velocity, (2,))
        return self._intake.judge("nominal", self._take_nominal, stamp, numbers, now, self._now)

    def _take_nominal(self, stamp: float, velocity: Numbers, now: float | None) -> Reading:
        if np.any(np.abs(velocity) > LARGEST):
            return Reading.TOO_LARGE
        if now is not None and stamp > now + self.settings.future_tolerance:
            return Reading.FROM_THE_FUTURE
        if self._last_nominal is not None and stamp < self._last_nominal[0]:
            return Reading.OUT_OF_ORDER
        self._last_nominal = (stamp, velocity)
        return Reading.ACCEPTED

    def warm_up(self) -> float:
        """Compile everything that decisions need, including the fallback; returns the seconds it took."""
        begun = time.perf_counter()
        m, k = self.scenario.pursuer_count, self.scenario.obstacle_count
        place = np.zeros(2)
        still = place, np.zeros((m, 2)), 0.0
        seen = Estimate(place, np.full((m, 3), 1.0), np.full((k, 4), 2.0), place + 1.0, *still)
        memory = self._whole.start(seen)
        self._whole(seen, place, True, False, 0.0, memory)
        if self._rows is not None:
            self._rows(seen, place, True, False, 0.0, memory)
        return time.perf_counter() - begun

    def decide(self, now: Any) -> Decision:
        """The command for the period that begins at `now` (s). Raises nothing: if the time is invalid, or not
        later than the previous one, the robot stops for the period."""
        begun = time.perf_counter()
        clock = as_numbers(now, ())
        if isinstance(clock, Reading):
            self.counts[("clock", clock)] += 1
            words = f"the clock cannot be used ({clock.value}): stopped for this period"
            return self._stop([*self._intake.take_news(), words], begun)
        now = float(clock)
        if self._now is not None and now <= self._now:
            return self._stop(self._turned_back(now), begun, now)
        self._intake.settle(now)
        reactions = self._intake.take_news()
        self._forget_ahead(now, reactions)
        lateness = self._paced(now, reactions)
        level = int(self._pace.late or self._pace.behind)
        self._now = now

        acts = now + self.settings.response
        if unseen := self._estimates.unseen():
            reactions.append(f"{', '.join(unseen)} not seen yet: standing still")
            return self._stop(reactions, begun, now)
        delay, grade = self._ages(now, reactions)
        level = max(level, grade)
        if level == LEVELS.index("stop"):
            return self._stop(reactions, begun, now)
        given, lost = self._given_nominal(now, reactions)
        level = max(level, int(lost))
        seen = self._estimate(acts)
        if self._memory is None:
            self._memory = self._whole.start(seen)
        delay = max(delay, float(self.settings.budget.delay)) + lateness
        ask = self._decided % self._decision_steps == 0
        flee = level >= LEVELS.index("evade")
        answering = (self._rows if self._pace.behind else None) or self._whole
        answer, memory = answering(seen, given, ask, flee, delay, self._memory)
        self._memory = memory
        if not np.all(np.isfinite(answer.action)):
            self._forget_plan()
            reactions.append("the shield's answer was not finite: stopped for this period")
            return self._stop(reactions, begun, now)
        self._estimates.evader.told(now, answer.action)
        self._decided += 1
        if not flee:
            self._held = answer.nominal
        computed = time.perf_counter() - begun
        return Decision(
            velocity=answer.action,
            nominal=answer.nominal,
            status=answer.status,
            level=LEVELS[level],
            reactions=tuple(reactions),
            barriers=answer.barriers,
            slack=answer.slack,
            intervention=answer.intervention,
            clearance=answer.clearance,
            latency=now - self._estimates.newest() + computed,
            compute_seconds=computed,
            _seen=seen,
            _plan=lambda: self._whole.plan(seen, memory),
        )

    def _turned_back(self, now: float) -> list[str]:
        """Handle a clock that goes back to `now` (s), or stands still; returns the reactions."""
        assert self._now is not None
        back, self._now = self._now - now, now
        self.counts[("clock", Reading.OUT_OF_ORDER)] += 1
        if not back:
            return [
                *self._intake.take_news(),
                f"the clock stands still at {now:.6g} s: stopped for this period",
            ]
        # Old stamps are not comparable with new ones: a robot last seen a minute ago could appear to have
        # been seen just now.
        self._estimates.forget()
        self._last_nominal = None
        self._forget_plan()
        self._pace.interrupted()
        self._intake.settle(now)
        forgotten = "poses, motions, nominal velocity and plan are forgotten"
        words = f"the clock went back by {back:.6g} s: {forgotten}; stopped for this period"
        return [*self._intake.take_news(), words]

    def _forget_ahead(self, now: float, reactions: list[str]) -> None:
        """Forget data accepted before the clock was known whose stamps prove to be from the future."""
        latest = self._intake.latest(now)
        names = self._estimates.forget(beyond=latest)
        if self._last_nominal is not None and self._last_nominal[0] > latest:
            self._last_nominal = None
            names.append("nominal")
        for name in names:
            self.counts[(name, Reading.FROM_THE_FUTURE)] += 1
            reactions.append(f"{name}: its stamp is ahead of the clock, forgotten")

    def _forget_plan(self) -> None:
        """Forget sides and plan, and have the policy decide next, because the world has changed."""
        self._memory = None
        self._decided += -self._decided % self._decision_steps

    def _paced(self, now: float, reactions: list[str]) -> float:
        """The lateness of decisions (s) to add to the delay; after a pause sides and plan are forgotten."""
        late = self._pace.called(now)
        if self._pace.paused:
            self.counts[("clock", Reading.JUMP)] += 1
            self._forget_plan()
            gap = f"no decision for {late + self._period:.6g} s (a pause, or a clock set ahead)"
            reactions.append(f"{gap}: sides and plan are forgotten")
        elif late:
            reactions.append(f"late by {1e3 * late:.1f} ms: allowed for as delay")
        if self._pace.behind and self._rows is not None:
            reactions.append("fell behind: rows only, no look-ahead")
        return self._pace.lateness

    def _ages(self, now: float, reactions: list[str]) -> tuple[float, int]:
        """The largest delay (s) of a pursuer's pose, and the level according to the ages of all poses."""
        settings, level, delay = self.settings, 0, 0.0
        usual = max(float(settings.budget.delay) - settings.response, 0.0) + self._period
        for robot, gate in self._estimates:
            assert gate.track.stamp is not None
            age = now - gate.track.stamp
            # Evader and obstacles are extrapolated by their known motion.
            if robot == "pursuer":
                delay = max(delay, self._unpredicted(age))
            if age <= usual:
                continue
            milliseconds = 1e3 * age
            if age <= settings.stale_after:
                level = max(level, LEVELS.index("degraded"))
                reactions.append(f"{gate.name}: last seen {milliseconds:.0f} ms ago, allowed for")
                continue
            stops = robot == "evader" or settings.on_fault == "stop"
            level = max(level, LEVELS.index("stop" if stops else "evade"))
            left = "standing still" if stops else "fleeing from where it may be"
            reactions.append(f"{gate.name}: stale, last seen {milliseconds:.0f} ms ago: {left}")
        return delay, level

    def _unpredicted(self, age: float) -> float:
        """The delay (s) in the budget for a pursuer's pose of this age (s)."""
        settings = self.settings
        if not settings.predict_pursuer:
            return age + settings.response
        # The pose is extrapolated to actuation time, less reliably with age.
        return float(settings.budget.delay) + max(age - self._period, 0.0)

    def _given_nominal(self, now: float, reactions: list[str]) -> tuple[Numbers, bool]:
        """The nominal velocity (m/s), and whether it was lost. With a policy it is the one held from the last
        decision."""
        if self._policy is not None:
            return self._held, False
        if self._last_nominal is None:
            reactions.append("no nominal velocity yet: holding still unless pressed")
            return np.zeros(2), True
        stamp, velocity = self._last_nominal
        if now - stamp > self.settings.nominal_timeout:
            age = 1e3 * (now - stamp)
            reactions.append(f"nominal velocity lost, {age:.0f} ms old: holding still unless pressed")
            return np.zeros(2), True
        return velocity, False

    def world(self, now: Any) -> World | None:
        """The estimated world when a command given at `now` (s) acts; None before every robot has been seen,
        and for an invalid time."""
        clock = as_numbers(now, ())
        if isinstance(clock, Reading) or self._estimates.unseen():
            return None
        return self._estimate(float(clock) + self.settings.response).world()

    def _estimate(self, acts: float) -> Estimate:
        with np.errstate(all="ignore"):
            return self._estimates.at(acts, self._target, self._decided * self._period)

    def _stop(self, reactions: list[str], begun: float, now: float | None = None) -> Decision:
        if now is not None:
            self._estimates.evader.told(now, np.zeros(2))
        computed = time.perf_counter() - begun
        n = self.scenario.pursuer_count + self.scenario.obstacle_count
        return Decision(
            velocity=np.zeros(2),
            nominal=np.full(2, np.nan),
            status=Status.INVALID,
            level="stop",
            reactions=tuple(reactions),
            barriers=np.full(n, -np.inf),
            slack=-math.inf,
            intervention=math.nan,
            clearance=math.nan,
            latency=math.nan,
            compute_seconds=computed,
            _seen=None,
            _plan=lambda: np.zeros((0, 2)),
        )
