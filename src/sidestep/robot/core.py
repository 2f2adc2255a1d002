"""The decision core that a robot runs: poses and a wish go in, a safe velocity comes out, whatever happens.

It knows nothing of transports. Physics twin, ROS 2 node and robots of other kinds feed it poses with the time
at which they were true, ask it once per control period, and drive what it answers.
"""

from __future__ import annotations

import math
import time
from collections import Counter
from pathlib import Path
from typing import Any, final

import equinox as eqx
import numpy as np
from jaxtyping import Float

from sidestep.learning import load_policy
from sidestep.loop.policies import GOAL_SEEKING, as_policy
from sidestep.loop.step import decision_steps_of
from sidestep.robot.answering import Answering, Numbers, Seen
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
    """Decides for one evader; see `OnboardSettings` for what it knows of its sensors and of faults.

    Feed it with `see` and, without a policy, `nominal`; set `target` for a policy; call `decide` once per
    control period and drive what it answers until the next. Times (s) are of one clock, the same for poses
    and decisions. Not for several threads at once.

    **Arguments:** `shield` a name, or a shield of this scenario (then its own budget counts, not that of the
    settings); `policy` None if nominal velocities are fed in, `goal-seeking`, a run folder, or any policy.

    **Reactions.** Poses that are no numbers, of the wrong length, not finite, too large, out of order, from
    the future or jumps are dropped and counted. A pursuer's pose is allowed for by its age, or by
    `budget.delay` if that is more. One older than usual means `degraded`; older than `stale_after`, `evade`
    (the nominal velocity is ignored, the robot flees from the pursuer as last seen) or `stop`, as `on_fault`
    says; without its own pose, or before every robot of the scenario has been seen, the robot stops. A lost
    nominal velocity counts as zero. A core that is called late adds the lateness to the delay, and if it
    happens again and again decides by the rows alone, without looking ahead, until it has kept pace for a
    while. A clock that goes back stops the robot for that period; everything that has a time is forgotten,
    and decisions go on as soon as poses and clock agree again. So they do after a pause, or a clock that
    went ahead: then motions and the plan are forgotten.

    **Raises** `ValueError` or `TypeError` for settings, a shield, a policy or a target that cannot be, and
    nothing for what is seen or for the time of a decision.
    """

    def __init__(
        self,
        scenario: Scenario,
        shield: str | Shield = "joint",
        policy: Any = None,
        settings: OnboardSettings | None = None,
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
            # Motors that turn the robot round within a period are as good as none.
            gained = settings.motor_acceleration * float(scenario.control_period)
            if gained < 2.0 * float(scenario.evader_speed):
                shield = shield.with_acceleration(settings.motor_acceleration)
        self._shield = shield
        self._init = eqx.filter_jit(shield.init)
        if isinstance(policy, (str, Path)) and policy != GOAL_SEEKING:
            policy = load_policy(policy)
        self._policy = None if policy is None else as_policy(policy, scenario)
        self._decision_steps = 1 if policy is None else decision_steps_of(self._policy)
        self._whole = Answering(shield, self._policy)
        self._rows = Answering(shield, self._policy, rows_only=True) if shield.looks_ahead else None
        self._period = float(scenario.control_period)
        self._speed = float(scenario.evader_speed)
        self._target = np.full(2, np.nan) if policy is not None else np.zeros(2)
        self.reset()

    def reset(self) -> None:
        """Forget all poses, wishes, faults and commands; keep what was compiled, and the target."""
        self._estimates = Estimates(self.scenario, self.settings)
        self._pace = Pace(self._period, self.settings)
        self._intake = Intake(self._period + self.settings.future_tolerance)
        self._wish: tuple[float, Numbers] | None = None
        self._held = np.full(2, np.nan)
        self._now: float | None = None
        self._decided = 0
        self._memory: Any = None

    @property
    def counts(self) -> Counter[tuple[str, Reading]]:
        """What became of the poses of each robot (`evader`, `pursuer 0`, ...), of nominal velocities
        (`nominal`) and of times of decisions that could not be used (`clock`), since the last `reset`."""
        return self._intake.counts

    @property
    def target(self) -> Float[np.ndarray, "2"]:
        """Where the policy is to go, m, world axes."""
        return self._target.copy()

    @target.setter
    def target(self, place: Any) -> None:
        point = as_numbers(place, (2,))
        if isinstance(point, Reading):
            raise ValueError(f"target = {place!r}: it must be two finite numbers (x, y), m")
        self._target = point

    def see(self, robot: Any, stamp: Any, pose: Any, index: Any = 0, *, now: Any = None) -> Reading:
        """A pose of `evader`, `pursuer` or `obstacle`: x, y (m) and, but for obstacles, heading (rad).

        `stamp` (s) is when it was true. `now`: the clock (s), to know a stamp from the future. Without it a
        stamp more than a period ahead of the last decision waits for the next one (`Reading.WAITING`), and
        one more than a second ahead is refused. Raises nothing: what cannot be used is counted.
        """
        gate = self._estimates.gate(robot, index)
        if gate is None:
            return self._intake.unknown(robot, index)
        shapes = ((2,), (3,)) if robot == "obstacle" else ((3,),)
        return self._intake.judge(gate.name, gate.take, stamp, as_numbers(pose, *shapes), now, self._now)

    def nominal(self, stamp: Any, velocity: Any, *, now: Any = None) -> Reading:
        """A wished velocity (m/s, world axes), given at `stamp` (s); only without a policy. `now` and what
        cannot be used: as for `see`.

        **Raises** `ValueError` where a policy decides, whatever is given.
        """
        if self._policy is not None:
            raise ValueError("this core has a policy of its own: it takes no nominal velocity")
        numbers = as_numbers(velocity, (2,))
        return self._intake.judge("nominal", self._take_wish, stamp, numbers, now, self._now)

    def _take_wish(self, stamp: float, velocity: Numbers, now: float | None) -> Reading:
        if np.any(np.abs(velocity) > LARGEST):
            return Reading.TOO_LARGE
        if now is not None and stamp > now + self.settings.future_tolerance:
            return Reading.FROM_THE_FUTURE
        if self._wish is not None and stamp < self._wish[0]:
            return Reading.OUT_OF_ORDER
        self._wish = (stamp, velocity)
        return Reading.ACCEPTED

    def warm_up(self) -> float:
        """Compile what decisions need, the fall-back included; returns the seconds it took."""
        begun = time.perf_counter()
        m, k = self.scenario.pursuer_count, self.scenario.obstacle_count
        place = np.zeros(2)
        still = place, np.zeros((m, 2)), 0.0
        seen = Seen(place, np.full((m, 3), 1.0), np.full((k, 4), 2.0), place + 1.0, *still)
        memory = self._init(seen.world())
        self._whole(seen, place, True, False, 0.0, memory)
        if self._rows is not None:
            self._rows(seen, place, True, False, 0.0, memory)
        return time.perf_counter() - begun

    def decide(self, now: Any) -> Decision:
        """The command for the period that begins at `now` (s). Raises nothing: at a time that is none, or not
        after the one before, the robot stands still for the period."""
        begun = time.perf_counter()
        clock = as_numbers(now, ())
        if isinstance(clock, Reading):
            self.counts[("clock", clock)] += 1
            words = f"the clock cannot be used ({clock.value}): stopped for this period"
            return self._stop([*self._intake.told(), words], begun)
        now = float(clock)
        if self._now is not None and now <= self._now:
            return self._stop(self._turned_back(now), begun, now)
        self._intake.settle(now)
        reactions = self._intake.told()
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
        wished, lost = self._wished(now, reactions)
        level = max(level, int(lost))
        seen = self._estimate(acts)
        if self._memory is None:
            self._memory = self._init(seen.world())
        delay = max(delay, float(self.settings.budget.delay)) + lateness
        ask = self._decided % self._decision_steps == 0
        flee = level >= LEVELS.index("evade")
        answering = (self._rows if self._pace.behind else None) or self._whole
        answer, memory = answering(seen, wished, ask, flee, delay, self._memory)
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
            _plan=lambda: np.asarray(self._shield.plan(seen.world(), memory), float),
        )

    def _turned_back(self, now: float) -> list[str]:
        """The clock goes back to `now` (s), or stands still: what happened and was forgotten, in words."""
        assert self._now is not None
        back, self._now = self._now - now, now
        self.counts[("clock", Reading.OUT_OF_ORDER)] += 1
        if not back:
            return [*self._intake.told(), f"the clock stands still at {now:.6g} s: stopped for this period"]
        # No stamp from before compares with those that follow: a robot last seen a minute ago could seem
        # to have been seen just now.
        self._estimates.forget()
        self._wish = None
        self._forget_plan()
        self._pace.interrupted()
        self._intake.settle(now)
        forgotten = "poses, motions, nominal velocity and plan are forgotten"
        words = f"the clock went back by {back:.6g} s: {forgotten}; stopped for this period"
        return [*self._intake.told(), words]

    def _forget_ahead(self, now: float, reactions: list[str]) -> None:
        """Forget what was believed before the clock was known, and turns out to be from its future."""
        latest = self._intake.latest(now)
        names = self._estimates.forget(beyond=latest)
        if self._wish is not None and self._wish[0] > latest:
            self._wish = None
            names.append("nominal")
        for name in names:
            self.counts[(name, Reading.FROM_THE_FUTURE)] += 1
            reactions.append(f"{name}: its stamp is ahead of the clock, forgotten")

    def _forget_plan(self) -> None:
        """Sides, plan and the policy's last wish are those of another world: begin anew, the policy asked."""
        self._memory = None
        self._decided += -self._decided % self._decision_steps

    def _paced(self, now: float, reactions: list[str]) -> float:
        """What to allow for (s) since decisions come late; after a pause, what was kept in mind goes."""
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
        """From the oldest pursuer's pose to when the command acts (s), and the level that all ages leave."""
        settings, level, delay = self.settings, 0, 0.0
        usual = max(float(settings.budget.delay) - settings.response, 0.0) + self._period
        for robot, gate in self._estimates:
            assert gate.track.stamp is not None
            age = now - gate.track.stamp
            # Evader and obstacles are where their known motion has taken them.
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
        """The delay (s) that a pursuer's pose of this age is to be paid for."""
        settings = self.settings
        if not settings.predict_pursuer:
            return age + settings.response
        # Driven on to when the command acts; what that is worth fades with the age.
        return float(settings.budget.delay) + max(age - self._period, 0.0)

    def _wished(self, now: float, reactions: list[str]) -> tuple[Numbers, bool]:
        """The wish to filter, and whether it was lost; a policy's is computed with the decision."""
        if self._policy is not None:
            return self._held, False
        if self._wish is None:
            reactions.append("no nominal velocity yet: holding still unless pressed")
            return np.zeros(2), True
        stamp, wished = self._wish
        if now - stamp > self.settings.nominal_timeout:
            age = 1e3 * (now - stamp)
            reactions.append(f"nominal velocity lost, {age:.0f} ms old: holding still unless pressed")
            return np.zeros(2), True
        return wished, False

    def world(self, now: Any) -> World | None:
        """Where everything is thought to be when a command given at `now` (s) acts; None before every robot
        has been seen, and for a time that is none."""
        clock = as_numbers(now, ())
        if isinstance(clock, Reading) or self._estimates.unseen():
            return None
        return self._estimate(float(clock) + self.settings.response).world()

    def _estimate(self, acts: float) -> Seen:
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
