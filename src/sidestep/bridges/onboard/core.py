"""The decision core that a robot runs: poses and a wish go in, a safe velocity comes out, whatever happens.

It knows nothing of transports. Physics twin, ROS 2 node and robots of other kinds feed it poses with the time
at which they were true, ask it once per control period, and drive what it answers.
"""

from __future__ import annotations

import dataclasses
import math
import time
from collections import Counter
from collections.abc import Callable
from pathlib import Path
from typing import Any, final

import equinox as eqx
import numpy as np
from jaxtyping import Float

from sidestep.bridges.onboard.answering import Answering, Numbers, Seen
from sidestep.bridges.onboard.decision import LEVELS, Decision
from sidestep.bridges.onboard.readings import Gate, Reading
from sidestep.bridges.onboard.settings import OnboardSettings
from sidestep.bridges.onboard.tracks import EvaderTrack, ObstacleTrack, PursuerTrack
from sidestep.learning import load_policy
from sidestep.learning.control_step import decision_steps_of
from sidestep.safety import JointShield, Shield, Status, make_shield
from sidestep.safety.catalogue import BUDGETED
from sidestep.safety.way_out import way_out
from sidestep.trials.policies import GOAL_SEEKING, as_policy
from sidestep.world import Scenario, World

_CALM = 20
"""On-time decisions after which a core that fell behind looks ahead again."""


@final
class Onboard:
    """Decides for one evader; see `OnboardSettings` for what it is told of its sensors and of faults.

    Feed it with `see` and, without a policy, `nominal`; set `target` for a policy; call `decide` once per
    control period and drive what it answers until the next. Times (s) are of any one monotonic clock, the
    same for poses and decisions. Not for several threads at once.

    **Arguments:** `shield` a name, or a shield of this scenario (then its own budget counts, not that of the
    settings); `policy` None if wishes are fed in, `goal-seeking`, a run folder, or any policy.

    **Reactions.** Poses that are not finite, out of order, from the future or jumps are dropped and counted.
    A pursuer's pose is allowed for by its age, or by `budget.delay` if that is more. One older than usual
    means `degraded`; older than `stale_after`, `evade` (the wish is ignored, the robot flees from the pursuer
    as last seen) or `stop`, as `on_fault` says; without its own pose, or before every robot of the scenario
    has been seen, the robot stops. A lost wish counts as a wish to stand still. A core that is called late
    adds the lateness to the delay, and if it happens again and again decides by the rows alone, without
    looking ahead, until it has kept pace for a while. A clock that goes back stops the robot for that period.

    **Raises** `ValueError` or `TypeError` for settings, a shield, a policy or a target that cannot be.
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
            "of_control_point(scenario)), and poses of that point, as sidestep.bridges.flight.Pilot does",
        )  # fmt: skip
        self.scenario, self.settings = scenario, settings or OnboardSettings()
        settings = self.settings
        self.settings.budget.check(scenario)
        if isinstance(shield, str):
            budget = settings.budget if shield in BUDGETED else None
            shield = make_shield(shield, scenario, budget)
            # Motors that turn the robot round within a period are as good as none.
            gained = settings.motor_acceleration * float(scenario.control_period)
            if isinstance(shield, JointShield) and gained < 2.0 * float(scenario.evader_speed):
                shield = dataclasses.replace(shield, acceleration=settings.motor_acceleration)
        self._shield = shield
        self._init = eqx.filter_jit(shield.init)
        if isinstance(policy, (str, Path)) and policy != GOAL_SEEKING:
            policy = load_policy(policy)
        self._policy = None if policy is None else as_policy(policy, scenario)
        self._decision_steps = 1 if policy is None else decision_steps_of(self._policy)
        self._whole = Answering(shield, self._policy)
        rows = shield.rows_only if isinstance(shield, JointShield) else None
        self._rows = None if rows is None else Answering(rows, self._policy)
        self._period = float(scenario.control_period)
        self._speed = float(scenario.evader_speed)
        self._target = np.full(2, np.nan) if policy is not None else np.zeros(2)
        self.reset()

    def reset(self) -> None:
        """Forget all poses, wishes, faults and commands; keep what was compiled, and the target."""
        settings, scenario = self.settings, self.scenario
        noise = settings.position_noise, settings.heading_noise
        rim, axle = float(scenario.pursuer_speed), float(scenario.pursuer_half_axle)
        drift = float(np.hypot(*np.asarray(scenario.obstacle_velocity, float)))
        tracking = max(float(settings.budget.tracking_error), 0.05 * self._speed)
        motors = settings.actuation_delay, settings.motor_lag, settings.motor_acceleration
        self._evader = EvaderTrack(*noise, tracking, *motors)
        self._pursuers = [PursuerTrack(*noise, rim, axle) for _ in range(scenario.pursuer_count)]
        self._obstacles = [
            ObstacleTrack(noise[0], drift, settings.obstacle_acceleration)
            for _ in range(scenario.obstacle_count)
        ]
        turns = math.inf, rim / axle
        self._gates = {
            "evader": [Gate(self._evader, self._speed, turns[0], settings)],
            "pursuer": [Gate(track, rim, turns[1], settings) for track in self._pursuers],
            "obstacle": [Gate(track, max(drift, rim), 0.0, settings) for track in self._obstacles],
        }
        self.counts: Counter[tuple[str, Reading]] = Counter()
        self._dropped: Counter[tuple[str, Reading]] = Counter()
        self._wish: tuple[float, Numbers] | None = None
        self._held = np.full(2, np.nan)
        self._now: float | None = None
        self._late_in_a_row, self._on_time, self._lateness, self._behind = 0, 0, 0.0, False
        self._decided = 0
        self._memory: Any = None

    @property
    def target(self) -> Float[np.ndarray, "2"]:
        """Where the policy is to go, m, world axes."""
        return self._target.copy()

    @target.setter
    def target(self, place: Any) -> None:
        point = np.asarray(place, float)
        if point.shape != (2,) or not np.all(np.isfinite(point)):
            raise ValueError(f"target = {place!r}: it must be two finite numbers (x, y), m")
        self._target = point

    def see(
        self, robot: str, stamp: float, pose: Any, index: int = 0, *, now: float | None = None
    ) -> Reading:
        """A pose of `evader`, `pursuer` or `obstacle`: x, y (m) and, but for obstacles, heading (rad).

        `stamp` (s) is when it was true. `now`: the clock, to know a stamp from the future; that of the last
        decision otherwise, one second on. **Raises** `ValueError` for a pose of the wrong length.
        """
        gates = self._gates.get(robot, [])
        if not 0 <= index < len(gates):
            return self._count(f"{robot} {index}", Reading.UNKNOWN_ROBOT)
        numbers = np.asarray(pose, float)
        length = 2 if robot == "obstacle" else 3
        if numbers.shape not in ((length,), (3,)):
            raise ValueError(f"pose of {robot} = {pose!r}: it must be {length} numbers")
        if now is None and self._now is not None:
            now = self._now + 1.0
        gate = gates[index]
        reading = gate.take(float(stamp), numbers[:length], now)
        if gate.relocated:
            gate.relocated = False
            self._dropped[(_name(robot, index), Reading.ACCEPTED)] += 1
        return self._count(_name(robot, index), reading)

    def nominal(self, stamp: float, velocity: Any) -> Reading:
        """A wished velocity (m/s, world axes), given at `stamp` (s); only without a policy.

        **Raises** `ValueError` where a policy decides, or for anything but two numbers.
        """
        if self._policy is not None:
            raise ValueError("this core has a policy of its own: it takes no nominal velocity")
        numbers = np.asarray(velocity, float)
        if numbers.shape != (2,):
            raise ValueError(f"nominal velocity = {velocity!r}: it must be two numbers, m/s")
        if not (math.isfinite(stamp) and np.all(np.isfinite(numbers))):
            return self._count("nominal", Reading.NOT_FINITE)
        if self._now is not None and stamp > self._now + 1.0:
            return self._count("nominal", Reading.FROM_THE_FUTURE)
        if self._wish is not None and stamp < self._wish[0]:
            return self._count("nominal", Reading.OUT_OF_ORDER)
        self._wish = (float(stamp), numbers)
        return self._count("nominal", Reading.ACCEPTED)

    def _count(self, name: str, reading: Reading) -> Reading:
        self.counts[(name, reading)] += 1
        if reading is not Reading.ACCEPTED:
            self._dropped[(name, reading)] += 1
        return reading

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
            self._rows(seen, place, True, False, 0.0, memory.sides)
        return time.perf_counter() - begun

    def decide(self, now: float) -> Decision:
        """The command for the period that begins at `now` (s). Never raises for what was seen or wished."""
        begun = time.perf_counter()
        reactions = self._dropped_since()
        level = 0
        if not math.isfinite(now) or (self._now is not None and now <= self._now):
            reactions.append(f"the clock went from {self._now} s to {now} s: stopped for this period")
            return self._stop(reactions, begun, now)
        lateness = self._pace(now, reactions)
        level = max(level, int(self._late_in_a_row > 0 or self._behind))
        self._now = now

        acts = now + self.settings.response
        unseen = self._unseen()
        if unseen:
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
        if self._behind and self._rows is not None:
            answer, sides = self._rows(seen, wished, ask, flee, delay, self._memory.sides)
            self._memory = eqx.tree_at(lambda memory: memory.sides, self._memory, sides)
        else:
            answer, self._memory = self._whole(seen, wished, ask, flee, delay, self._memory)
        if not np.all(np.isfinite(answer.action)):
            reactions.append("the shield's answer was not finite: stopped for this period")
            return self._stop(reactions, begun, now)
        self._evader.told(now, answer.action)
        self._decided += 1
        if not flee:
            self._held = answer.nominal
        newest = max(gate.track.stamp or -math.inf for gates in self._gates.values() for gate in gates)
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
            latency=now - newest + computed,
            compute_seconds=computed,
            _seen=seen,
            _plan=self._planner(seen, self._memory),
        )

    def _planner(self, seen: Seen, memory: Any) -> Callable[[], Float[np.ndarray, "n 2"]]:
        shield = self._shield
        if not isinstance(shield, JointShield) or not self.scenario.pursuer_count:
            return lambda: np.zeros((0, 2))
        return lambda: np.asarray(way_out(shield, seen.world(), memory), float)

    def _dropped_since(self) -> list[str]:
        """What was not believed since the last decision, in words."""
        words = []
        for (name, reading), count in sorted(self._dropped.items(), key=lambda item: item[0][0]):
            if reading is Reading.ACCEPTED:
                words.append(f"{name}: is somewhere else now, its track begins anew")
            else:
                words.append(f"{name}: {count} {reading.value}, dropped")
        self._dropped.clear()
        return words

    def _pace(self, now: float, reactions: list[str]) -> float:
        """By how much (s) this decision is late; whether to go without looking ahead from now on."""
        since, limit = self._now, self.settings.late_after * self._period
        if since is None:
            return 0.0
        late = max(now - since - self._period, 0.0) if now - since > limit else 0.0
        if late:
            self._late_in_a_row, self._on_time = self._late_in_a_row + 1, 0
            reactions.append(f"late by {1e3 * late:.1f} ms: allowed for as delay")
        else:
            self._late_in_a_row, self._on_time = 0, self._on_time + 1
        if self._late_in_a_row >= self.settings.late_limit and not self._behind:
            self._behind = True
        elif self._behind and self._on_time >= _CALM:
            self._behind = False
        if self._behind and self._rows is not None:
            reactions.append("fell behind: rows only, no look-ahead")
        # What was late once may be so again: forgotten over some periods.
        self._lateness = max(late, 0.8 * self._lateness if self._lateness > 1e-4 else 0.0)
        return self._lateness

    def _unseen(self) -> list[str]:
        return [
            _name(robot, index)
            for robot, gates in self._gates.items()
            for index, gate in enumerate(gates)
            if gate.track.stamp is None
        ]

    def _ages(self, now: float, reactions: list[str]) -> tuple[float, int]:
        """From the oldest pursuer's pose to when the command acts (s), and the level that all ages leave."""
        settings, level, delay = self.settings, 0, 0.0
        usual = max(float(settings.budget.delay) - settings.response, 0.0) + self._period
        for robot, gates in self._gates.items():
            for index, gate in enumerate(gates):
                assert gate.track.stamp is not None
                age = now - gate.track.stamp
                # Evader and obstacles are where their known motion has taken them.
                if robot == "pursuer":
                    delay = max(delay, self._unpredicted(age))
                if age <= usual:
                    continue
                name, milliseconds = _name(robot, index), 1e3 * age
                if age <= settings.stale_after:
                    level = max(level, LEVELS.index("degraded"))
                    reactions.append(f"{name}: last seen {milliseconds:.0f} ms ago, allowed for")
                    continue
                stops = robot == "evader" or settings.on_fault == "stop"
                level = max(level, LEVELS.index("stop" if stops else "evade"))
                left = "standing still" if stops else "fleeing from where it may be"
                reactions.append(f"{name}: stale, last seen {milliseconds:.0f} ms ago: {left}")
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

    def world(self, now: float) -> World | None:
        """Where everything is thought to be when a command given at `now` (s) acts; None before every robot
        has been seen."""
        return None if self._unseen() else self._estimate(now + self.settings.response).world()

    def _estimate(self, acts: float) -> Seen:
        """Everything as it should be when the command acts; pursuers as last seen unless told otherwise."""
        predict = self.settings.predict_pursuer
        pursuers = [track.at(acts if predict else track.stamp or acts) for track in self._pursuers]
        obstacles = [np.concatenate([track.at(acts), track.velocity]) for track in self._obstacles]
        wheels = [track.wheel_speeds() for track in self._pursuers]
        return Seen(
            evader=self._evader.at(acts)[:2],
            pursuers=np.array(pursuers).reshape(-1, 3),
            obstacles=np.array(obstacles).reshape(-1, 4),
            target=self._target,
            velocity=self._evader.velocity_at(acts),
            wheel_speeds=np.array(wheels).reshape(-1, 2),
            time=self._decided * self._period,
        )

    def _stop(self, reactions: list[str], begun: float, now: float) -> Decision:
        if math.isfinite(now):
            self._evader.told(now, np.zeros(2))
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


def _name(robot: str, index: int) -> str:
    return robot if robot == "evader" else f"{robot} {index}"
