"""What the shield node and the policy node share: subscriptions, decisions, diagnostics."""

import abc
import json
import math
import time
from typing import Any

from diagnostic_msgs.msg import DiagnosticArray
from rclpy.duration import Duration
from rclpy.node import Node
from std_msgs.msg import String
from visualization_msgs.msg import MarkerArray

from sidestep_ros import quality, reports
from sidestep_ros.commands import Attitude, Commands
from sidestep_ros.cycle import Cycle, Late
from sidestep_ros.log import DecisionLog
from sidestep_ros.markers import Painter
from sidestep_ros.messages import COMMAND_TYPES
from sidestep_ros.parameters import DECIDING, SCENARIO, TOPICS, Parameter, declare
from sidestep_ros.robots import Robots
from sidestep_ros.settings import check_topics, make_onboard_settings, make_scenario
from sidestep_ros.times import Times

_STOP_SECONDS = 0.3
_REHEARSALS = 3


class OnboardNode(Node, abc.ABC):
    """Receives poses, decides with `sidestep.robot.Onboard`, and sends commands.

    A concrete node defines its further parameters (`own_parameters`), its decision core (`make_onboard`) and
    its further subscriptions (`listen`).
    """

    own_parameters: tuple[Parameter, ...] = ()

    def __init__(self, name: str, **options: Any):
        super().__init__(name, **options)
        self.values = declare(self, (*SCENARIO, *TOPICS, *DECIDING, *self.own_parameters))
        check_topics(self.values)
        self.scenario = make_scenario(self.values)
        period = float(self.scenario.control_period)
        self.times = Times(self, self.values["stamps"])
        self.complaints = reports.Complaints()
        self.attitude = Attitude()
        self.commands = Commands(self.values, self.times, self.attitude, period)
        self.target: tuple[float, float] | None = None
        self.world: Any = None
        self.onboard = self.make_onboard(make_onboard_settings(self.values, self.scenario))
        about = {"shield": self.values["shield"], "source": name}
        self._log = DecisionLog(self.values["log"], self.scenario, self.values["frame"], about)
        self._cycle = Cycle(period, grace=self.values["grace"], late_after=self.values["late_after"])
        self._robots = Robots(
            self, self.values, self.times, self.attitude, self.complaints, self._on_complete, period
        )
        self._painter = Painter(self.scenario, self.values["frame"], self.values["marker_period"])
        self._lates: list[Late] = []
        self._reported: tuple[Any, ...] = ()
        self._decided_at = -math.inf
        self._report_at = self._paint_at = -math.inf
        self._command = self.create_publisher(
            COMMAND_TYPES[self.values["command.type"]], self.values["command.topic"], quality.COMMANDS
        )
        self._diagnostics = self.create_publisher(DiagnosticArray, "/diagnostics", quality.DIAGNOSTICS)
        self._markers = self.create_publisher(MarkerArray, "~/markers", quality.MARKERS)
        self._scenario = self.create_publisher(String, "~/scenario", quality.LATCHED)

    @abc.abstractmethod
    def make_onboard(self, settings: Any) -> Any:
        """The decision core of this node."""

    @property
    def answering(self) -> Any:
        """What makes shield and policy into calls: compiled C, or JAX."""
        if self.values["compiled"]:
            from sidestep.bridges.compiled import CompiledAnswering

            return CompiledAnswering
        from sidestep.robot.answering import Answering

        return Answering

    @abc.abstractmethod
    def listen(self) -> None:
        """Subscribe to topics other than poses."""

    def velocity_of(self, decision: Any) -> Any:
        """The velocity (m/s, world axes) to send for a decision: the safe one."""
        return decision.velocity

    def turn_rate_at(self, now: float) -> float:
        """The commanded turn rate (rad/s) at time `now` (s); it has no effect on the shield."""
        return 0.0

    def get_ready(self) -> None:
        """Compile, then subscribe, so that nothing is compiled in callbacks."""
        from sidestep.world import scenario_to_dict

        self.get_logger().info(
            "compiling; no command until that is done: the base has to stand still by itself"
        )
        began = time.perf_counter()
        self._say("decisions", reports.WARN, "compiling, not ready", {})
        self.onboard.warm_up()
        self._rehearse()
        self._scenario.publish(String(data=json.dumps(scenario_to_dict(self.scenario))))
        self._robots.subscribe(self.onboard)
        self.listen()
        patience = self._cycle.patience if self.values["trigger"] == "poses" else self._cycle.period
        self._watchdog = self.create_timer(patience, self._decide, clock=self.times.timer_clock)
        self.times.when_set_back(self._watchdog.reset)
        self.get_logger().info(f"ready after {time.perf_counter() - began:.1f} s")

    def _rehearse(self) -> None:
        """Make and paint a few decisions on synthetic poses, because first calls are slow."""
        for count in range(_REHEARSALS):
            now = float(count + 1)
            self.onboard.see("evader", now, (0.0, 0.0, 0.0))
            for index in range(self.scenario.pursuer_count):
                self.onboard.see("pursuer", now, (1.0 + index, 0.5, 0.0), index)
            for index in range(self.scenario.obstacle_count):
                self.onboard.see("obstacle", now, (-0.5, 0.5 + index), index)
            decision = self.onboard.decide(now)
            self._painter.paint(self.get_clock().now().to_msg(), decision, self.target)
            self._decision_status(decision, self.get_clock().now())
        self.onboard.reset()

    def leave_safe(self) -> None:
        """Send a stop, and wait until it is delivered."""
        self._command.publish(self.commands.write(self.get_clock().now().to_msg(), 0.0, 0.0, 0.0))
        self._command.wait_for_all_acked(Duration(seconds=_STOP_SECONDS))
        self._log.close()

    def _on_complete(self) -> None:
        if self.values["trigger"] == "poses" and self._cycle.is_due(self.times.of_cycle()):
            self._watchdog.reset()
            self._decide(in_step=True)

    def _decide(self, *, in_step: bool = False) -> None:
        began, now = time.perf_counter(), self.times.now()
        if now < self._decided_at:
            self.complaints.add(
                "clock", f"it went back by {self._decided_at - now:.3f} s: everything begins anew"
            )
            # The decision core detects this itself.
            self._robots.forget()
            self._report_at = self._paint_at = -math.inf
        self._decided_at = now
        decision = self.onboard.decide(now)
        x, y = map(float, self.velocity_of(decision))
        turn_rate = 0.0 if decision.level == "stop" else self.turn_rate_at(self.times.now())
        # The stamp is the time of sending, so that recorded stamps show whether a command was late.
        stamp, now = self.get_clock().now(), self.times.of_cycle()
        self._command.publish(self.commands.write(stamp.to_msg(), x, y, turn_rate))
        late = self._cycle.sent(now, time.perf_counter() - began, in_step=in_step)
        self._robots.begin_anew()
        if decision.world is not None:
            self.world = decision.world
        if late is not None:
            self._lates.append(late)
        # The command is sent; the rest is not time-critical.
        self._report(decision, stamp, now)
        self._paint(decision, stamp, now)
        complaint = self._log.add(self._decided_at, decision)
        if complaint:
            self.complaints.add("log", complaint)

    def _report(self, decision: Any, stamp: Any, now: float) -> None:
        news = (decision.level, decision.reactions)
        urgent = news != self._reported or self._lates or self.complaints.fresh
        if not urgent and now - self._report_at < self.values["diagnostics_period"]:
            return
        self._report_at, self._reported = now, news
        self._diagnostics.publish(
            reports.array(stamp.to_msg(), self._decision_status(decision, stamp), self._pose_status(decision))
        )
        self._lates.clear()
        self.complaints.reported()

    def _decision_status(self, decision: Any, stamp: Any) -> Any:
        from sidestep.safety import Status

        severity = reports.SEVERITY[decision.level]
        if severity == reports.OK and (
            decision.reactions or self._lates or int(decision.status) >= Status.INFEASIBLE
        ):
            severity = reports.WARN
        remarks: list[str] = [
            decision.level,
            *decision.reactions,
            *(f"late command: {late}" for late in self._lates),
        ]
        newest = self._robots.newest
        age = math.nan if newest is None else self.times.seconds(stamp.nanoseconds) - newest
        values = {
            **reports.decision_values(decision, Status.NAMES),
            reports.NEWEST_POSE: age,
            "commands": self._cycle.commands,
            reports.LATE_COMMANDS: self._cycle.late,
            "longest time between commands (s)": self._cycle.worst_gap,
            reports.LATE_LIMIT: self._cycle.limit,
        }
        return reports.status(f"{self.get_name()}: decisions", severity, "; ".join(remarks), values)

    def _pose_status(self, decision: Any) -> Any:
        fresh = self.complaints.fresh
        values = {
            **{f"age of {name} (s)": age for name, age in self._robots.ages(self.times.now()).items()},
            **{f"unusable messages: {name}": count for name, count in sorted(self.complaints.counts.items())},
        }
        return reports.status(
            f"{self.get_name()}: messages",
            reports.WARN if fresh else reports.OK,
            "; ".join(f"not used: {complaint}" for complaint in fresh) or "all used",
            values,
        )

    def _say(self, about: str, severity: bytes, message: str, values: dict[str, object]) -> None:
        status = reports.status(f"{self.get_name()}: {about}", severity, message, values)
        self._diagnostics.publish(reports.array(self.get_clock().now().to_msg(), status))

    def _paint(self, decision: Any, stamp: Any, now: float) -> None:
        period = self.values["marker_period"]
        if period == 0.0 or now - self._paint_at < period or not self._markers.get_subscription_count():
            return
        self._paint_at = now
        self._markers.publish(self._painter.paint(stamp.to_msg(), decision, self.target))
