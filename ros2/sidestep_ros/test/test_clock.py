"""Clocks that are set while nodes run: no standing still until they catch up, with a pursuer driving up."""

import math
from types import SimpleNamespace

import rclpy
from builtin_interfaces.msg import Time
from conftest import Robots, Spinner, wait_until
from rclpy.parameter import Parameter
from rosgraph_msgs.msg import Clock
from sidestep_ros.cycle import Cycle
from sidestep_ros.messages import NANOSECONDS
from sidestep_ros.recorder import values_of
from sidestep_ros.shield_node import ShieldNode

CAPTURE = 0.15
# However busy the machine, poses are no reason to stop here.
PATIENT = ("stale_after:=1.0", "nominal_timeout:=2.0")
OVERRIDES = f"scenario_overrides:=[capture_distance={CAPTURE}]"


class Chase(Robots):
    """An evader that is to stand still, and a pursuer that drives at it; on a clock of its own if `time` (s)
    is given, published as a simulator does."""

    def __init__(self, time=None):
        self.time, self.least, self.going = time, math.inf, False
        self.set_by, self.decided = 0.0, []
        super().__init__()
        self.poses["obstacle"] = [0.0, 5.0, 0.0]
        self.nominal = (0.0, 0.0)
        self._time_publisher = self.create_publisher(Clock, "/clock", 10) if time is not None else None

    def stamp(self, ahead=0.0):
        if self.time is None:
            return super().stamp(ahead)
        # What is measured is a little older than what the clock says.
        seconds, rest = divmod(round((self.time - 0.02 + ahead) * NANOSECONDS), NANOSECONDS)
        return Time(sec=seconds, nanosec=rest)

    def _tick(self):
        if self._time_publisher is not None:
            ahead, self.set_by = self.set_by, 0.0
            self.time += self.period + ahead
            seconds, rest = divmod(round(self.time * NANOSECONDS), NANOSECONDS)
            self._time_publisher.publish(Clock(clock=Time(sec=seconds, nanosec=rest)))
        super()._tick()
        if self.going:
            self._drive()

    def _drive(self):
        x, y, heading = self.poses["pursuer"]
        dx, dy = self.poses["evader"][0] - x, self.poses["evader"][1] - y
        self.least = min(self.least, math.hypot(dx, dy))
        off = math.remainder(math.atan2(dy, dx) - heading, math.tau)
        turn = min(max(off, -self.period), self.period)
        way = 0.2 * (self.period - abs(turn))
        heading += turn
        self.poses["pursuer"] = [x + way * math.cos(heading), y + way * math.sin(heading), heading]

    def _read(self, message):
        super()._read(message)
        status = self.told[-1].get("decisions")
        if status is not None and status.values:
            self.decided.append((values_of(status)["level"], status.message))


def is_normal(robots):
    return bool(robots.decided) and robots.decided[-1][0] == "normal"


def heard(robots, begin, words):
    return wait_until(
        lambda: next((i for i, (_, said) in enumerate(robots.decided[begin:], begin) if words in said), None),
        f"'{words}' in the diagnostics",
    )


def check_that_it_went_on(robots, begin, report, what):
    """It says that the clock went back, and stands still for a moment only."""
    first = heard(robots, begin, "went back")
    # The evader is to stay at rest: if it does, a pursuer at 0.2 m/s is there after some 6 s.
    wait_until(lambda: robots.least < 0.3, "the pursuer")
    count = len(robots.decided)
    wait_until(lambda: len(robots.decided) > count + 40, "two seconds more")
    stops = [index for index, (level, _) in enumerate(robots.decided[first:]) if level == "stop"]
    report(f"{what}: stops at decisions {stops} from then, least distance {1e3 * robots.least:.0f} mm")
    assert stops[0] == 0
    assert len(stops) <= 4
    assert robots.least > CAPTURE


def test_a_simulated_clock_that_begins_anew_as_when_a_bag_loops(middleware, start, report):
    robots = Chase(time=100.0)
    with Spinner(robots):
        node = start(
            "shield_node",
            "shield:=game",
            "diagnostics_period:=0.0",
            "use_sim_time:=true",
            OVERRIDES,
            *PATIENT,
        )
        node.wait_ready()
        wait_until(lambda: is_normal(robots), "a normal decision")
        robots.going, begin = True, len(robots.decided)
        robots.set_by = -97.0
        check_that_it_went_on(robots, begin, report, "simulated clock set back by 97 s")
        begin = len(robots.decided)
        robots.set_by = 1000.0
        heard(robots, begin, "set ahead")
        wait_until(lambda: is_normal(robots), "a normal decision")
        assert robots.least > CAPTURE
        assert node.stop() == 0, node.said


def test_a_clock_that_is_set_back_by_a_time_server_while_a_log_is_written(middleware, report, tmp_path):
    from sidestep.bridges.logs import load_log

    log = tmp_path / "drive.mcap"
    given = {"shield": "game", "diagnostics_period": 0.0, "log": str(log), "stale_after": 1.0}
    overrides = [Parameter(name, value=value) for name, value in given.items()]
    overrides.append(Parameter("scenario_overrides", value=[f"capture_distance={CAPTURE}"]))
    node, robots = ShieldNode(parameter_overrides=overrides), Chase()
    node.get_ready()
    with Spinner(robots), Spinner(node):
        wait_until(lambda: is_normal(robots), "a normal decision")
        robots.going, begin = True, len(robots.decided)
        # Now and stamps alike are minutes earlier, before the node began.
        node.times._epoch += 600 * NANOSECONDS
        check_that_it_went_on(robots, begin, report, "wall clock set back by 10 minutes")
    node._log.close()
    assert rclpy.ok()
    found = load_log(log)
    assert found.complete
    assert found.trajectory.length > 40


def test_poses_are_decided_on_at_once_after_the_clock_of_the_cycle_went_back():
    cycle = Cycle(0.05)
    cycle.sent(100.0, 0.001, in_step=True)
    assert cycle.is_due(3.0)
    assert cycle.sent(3.0, 0.001, in_step=True) is None
    assert not cycle.is_due(3.02)


def test_a_turn_rate_from_before_the_clock_went_back_is_not_held():
    node = SimpleNamespace(_turning=(100.0, 0.5), values={"nominal_timeout": 0.5})
    assert ShieldNode.turn_rate_at(node, 100.1) == 0.5
    assert ShieldNode.turn_rate_at(node, 101.0) == 0.0
    assert ShieldNode.turn_rate_at(node, 92.0) == 0.0
