"""The decision core when clocks jump, stand still or disagree: no waiting for them while a pursuer comes."""

import importlib
import json
import math
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest

from sidestep.robot import OnboardSettings, Reading
from sidestep.world import load_scenario

PERIOD = 0.05
CAPTURE = 0.15
SCENARIO = load_scenario("paper", capture_distance=CAPTURE)
FAR = {"evader": (0.0, 0.0, 0.0), "pursuer": (3.0, 0.0, math.pi / 2.0), "obstacle": (0.0, 3.0)}
JUMP = 30


def cycle(onboard, now, stamp=None, without=(), **more):
    """Poses, a nominal velocity, a decision; each pose `stamp`ed (s), `now` unless given."""
    stamp = now if stamp is None else stamp
    for robot, pose in FAR.items():
        if robot not in without:
            onboard.see(robot, stamp, pose, **more)
    onboard.nominal(stamp, (0.1, 0.05), **more)
    return onboard.decide(now)


def run(onboard, periods, begin=0.0, **more):
    return [cycle(onboard, begin + PERIOD * count, **more) for count in range(periods)][-1]


class Duel:
    """A pursuer that turns towards the evader as fast as it can, and drives at it with what is left."""

    def __init__(self, away, pursuer_speed=0.2, half_axle=0.2):
        self.evader, self.pursuer = np.zeros(2), np.array([away, 0.0, math.pi])
        self._rim, self._axle = pursuer_speed, half_axle
        self.least = away

    def advance(self, duration, velocity):
        pieces = max(1, math.ceil(duration / 0.01))
        step = duration / pieces
        for _ in range(pieces):
            self.evader = self.evader + step * np.asarray(velocity)
            dx, dy = self.evader - self.pursuer[:2]
            off = math.remainder(math.atan2(dy, dx) - self.pursuer[2], math.tau)
            rate = float(np.clip(off / step, -self._rim / self._axle, self._rim / self._axle))
            self.pursuer[2] += rate * step
            way = (self._rim - self._axle * abs(rate)) * step
            self.pursuer[:2] += way * np.array([math.cos(self.pursuer[2]), math.sin(self.pursuer[2])])
            self.least = min(self.least, float(np.linalg.norm(self.evader - self.pursuer[:2])))


def duel(onboard, clock, stamps, **more):
    """Least distance (m), and the levels of the decisions; `clock` and `stamps` make s of period and time."""
    robots, levels = Duel(1.0), []
    for count in range(150):
        now, stamp = clock(count, PERIOD * count), stamps(count, PERIOD * count)
        onboard.see("evader", stamp, (*robots.evader, 0.0), **({"now": now} if more else {}))
        onboard.see("pursuer", stamp, robots.pursuer, **({"now": now} if more else {}))
        onboard.see("obstacle", stamp, (0.0, 5.0), **({"now": now} if more else {}))
        onboard.nominal(stamp, (0.0, 0.0))
        decision = onboard.decide(now)
        robots.advance(PERIOD, decision.velocity)
        levels.append(decision.level)
    return robots.least, levels


def set_by(seconds, period=JUMP):
    return lambda count, now: now + seconds * (count >= period)


def true(count, now):
    return now


@pytest.mark.parametrize("with_clock", [False, True])
@pytest.mark.parametrize(
    "clock, stamps, stops",
    [
        (set_by(-8.0), set_by(-8.0), [JUMP]),
        (set_by(-8.0), set_by(-8.0, JUMP + 1), [JUMP]),
        (set_by(-8.0), set_by(-8.0, JUMP + 4), [JUMP, JUMP + 1, JUMP + 2, JUMP + 3]),
        (set_by(-8.0, JUMP + 1), set_by(-8.0), [JUMP + 1]),
        (set_by(-0.15), set_by(-0.15), [JUMP]),
        (set_by(8.0), set_by(8.0), [JUMP]),
        (set_by(8.0), set_by(8.0, JUMP + 1), [JUMP]),
        (set_by(0.15), set_by(0.15, JUMP + 1), []),
        (set_by(0.6), set_by(0.6), []),
        (true, lambda count, now: now + 8.0 * (count == JUMP), []),
        (true, lambda count, now: now + 0.7 * (count == JUMP), []),
        (true, lambda count, now: now - 8.0 * (count == JUMP), []),
        (lambda count, now: now - 8.0 * (count // 15), lambda count, now: now - 8.0 * (count // 15), None),
        (lambda count, now: now + 8.0 * (count // 15), lambda count, now: now + 8.0 * (count // 15), None),
    ],
    ids=[
        "back", "back, poses one period later", "back, poses four periods later", "poses back first",
        "back by less than stale", "ahead", "ahead, poses one period later", "ahead by less than stale",
        "ahead by more than stale", "one stamp far ahead", "one stamp ahead", "one stamp old",
        "back again and again", "ahead again and again",
    ],
)  # fmt: skip
def test_a_clock_that_jumps_while_a_pursuer_drives_up_costs_a_period_and_no_capture(
    onboard, clock, stamps, stops, with_clock
):
    least, levels = duel(onboard, clock, stamps, **({"now": True} if with_clock else {}))
    found = [count for count, level in enumerate(levels) if level == "stop"]
    if with_clock and stops == [JUMP] and clock(JUMP, 0.0) == stamps(JUMP, 0.0) == 8.0:
        stops = []  # Poses that come with the clock are believed at once.
    expected = [count for count in range(1, 150) if count % 15 == 0]
    assert found == stops or (stops is None and set(found) <= set(expected))
    assert least > 0.18
    assert levels[-1] == "normal"


def test_clocks_that_disagree_mean_a_stop_for_as_long_as_they_do(onboard):
    """Poses of another host that stays on the old time, or has another from the start."""
    for ahead in (8.0, 0.5):
        onboard.reset()
        run(onboard, 5, 20.0)
        for count in range(20):
            decision = cycle(onboard, 20.25 - ahead + PERIOD * count, stamp=20.25 + PERIOD * count)
            assert decision.level == "stop"
            assert not np.any(decision.velocity)
        back = cycle(onboard, 21.25 - ahead)
        assert (back.level, back.reactions) == ("normal", ())
    onboard.reset()
    for count in range(5):
        decision = cycle(onboard, PERIOD * count, stamp=1e4 + PERIOD * count)
        assert decision.level == "stop"
        assert decision.world is None
    # The first was believed, since no clock was known.
    assert onboard.counts[("pursuer 0", Reading.FROM_THE_FUTURE)] >= 5


def test_what_is_forgotten_when_the_clock_goes_back_is_said_and_counted(onboard):
    run(onboard, 5, 100.0)
    back = cycle(onboard, 92.0)
    assert back.level == "stop"
    assert back.reactions[-1] == (
        "the clock went back by 8.2 s: poses, motions, nominal velocity and plan are forgotten; "
        "stopped for this period"
    )
    assert onboard.counts[("clock", Reading.OUT_OF_ORDER)] == 1
    assert onboard.counts[("pursuer 0", Reading.ACCEPTED)] == 5
    assert onboard.world(92.0) is None
    assert cycle(onboard, 92.05).level == "normal"


def test_a_robot_unseen_before_the_clock_went_back_does_not_seem_to_have_been_seen_just_now(onboard):
    run(onboard, 5)
    run(onboard, 40, 0.25, without=("pursuer",))
    back = cycle(onboard, 0.26, without=("pursuer",))
    assert back.level == "stop"
    for count in range(3):
        decision = cycle(onboard, 0.31 + PERIOD * count, without=("pursuer",))
        assert decision.level == "stop"
        assert "pursuer 0 not seen yet" in decision.reactions[-1]


def test_a_late_pose_of_the_old_clock_is_not_believed_after_it_went_back(onboard):
    run(onboard, 5, 100.0)
    cycle(onboard, 92.0)
    assert onboard.see("pursuer", 100.18, (2.0, 1.0, 0.0)) is Reading.FROM_THE_FUTURE
    decision = cycle(onboard, 92.05)
    assert decision.level == "normal"
    np.testing.assert_allclose(decision.world.pursuers[0], FAR["pursuer"], atol=1e-6)
    # And an old one after it went ahead is older than what is known.
    for robot, pose in FAR.items():
        onboard.see(robot, 192.0, pose, now=192.0)
    onboard.decide(192.0)
    assert onboard.see("pursuer", 92.1, (2.0, 1.0, 0.0)) is Reading.OUT_OF_ORDER


def test_one_stamp_from_ahead_does_not_blind_it_for_the_poses_that_follow(onboard):
    run(onboard, 5)
    assert onboard.see("pursuer", 0.9, (2.9, 0.0, math.pi / 2.0)) is Reading.WAITING
    assert onboard.nominal(0.9, (0.0, 0.1)) is Reading.WAITING
    decision = cycle(onboard, 0.25)
    assert decision.level == "normal"
    assert decision.reactions == (
        "nominal: 1 from the future, dropped",
        "pursuer 0: 1 from the future, dropped",
    )
    np.testing.assert_allclose(decision.world.pursuers[0], FAR["pursuer"], atol=1e-3)
    np.testing.assert_allclose(decision.velocity, (0.1, 0.05), atol=1e-6)


def test_poses_that_came_while_a_decision_was_late_are_used_by_it(onboard):
    run(onboard, 3)
    assert onboard.see("pursuer", 0.5, FAR["pursuer"]) is Reading.WAITING
    decision = cycle(onboard, 0.52)
    assert decision.reactions == ("late by 370.0 ms: allowed for as delay",)
    assert onboard.counts[("pursuer 0", Reading.ACCEPTED)] == 5


@pytest.mark.parametrize("now", [math.nan, -math.inf, None, "soon", (1.0, 2.0), object()])
def test_a_clock_that_cannot_be_read_stops_it_for_that_period_and_costs_nothing_else(onboard, now):
    run(onboard, 5)
    stopped = onboard.decide(now)
    assert stopped.level == "stop"
    assert "the clock cannot be used" in stopped.reactions[-1]
    assert sum(count for (name, _), count in onboard.counts.items() if name == "clock") == 1
    following = cycle(onboard, 0.25)
    assert (following.level, following.reactions) == ("normal", ())
    assert onboard.counts[("pursuer 0", Reading.ACCEPTED)] == 6


def test_a_clock_that_stands_still_stops_it_and_nothing_is_forgotten(onboard):
    run(onboard, 5)
    stopped = onboard.decide(0.2)
    assert stopped.level == "stop"
    assert "stands still" in stopped.reactions[-1]
    assert cycle(onboard, 0.25).reactions == ()


def test_speeds_found_across_a_jump_ahead_are_not_believed(onboard):
    """Both robots have moved a period's way while the clock went on by 3 s, or much farther in a pause."""
    onboard.reset()
    pursuer = np.array([2.0, 0.0, math.pi])
    for count in range(20):
        pursuer[0] -= PERIOD * 0.2
        onboard.see("evader", PERIOD * count, FAR["evader"])
        onboard.see("obstacle", PERIOD * count, FAR["obstacle"])
        onboard.see("pursuer", PERIOD * count, pursuer)
        decision = onboard.decide(PERIOD * count)
    np.testing.assert_allclose(decision.world.wheel_speeds, [[0.2, 0.2]], atol=0.03)
    now = 3.0 + PERIOD * 20
    for robot, pose in {**FAR, "pursuer": pursuer}.items():
        assert onboard.see(robot, now, pose, now=now) is Reading.RESUMED
    decision = onboard.decide(now)
    np.testing.assert_allclose(decision.world.wheel_speeds, 0.0, atol=1e-9)
    assert sum("motion from before is forgotten" in words for words in decision.reactions) == 3
    assert any("a pause, or a clock set ahead" in words for words in decision.reactions)
    assert onboard.counts[("clock", Reading.JUMP)] == 1
    # A pause is no delay to be paid for: the rows let it go where it should.
    onboard.nominal(now + PERIOD, (0.0, 0.1))
    for robot, pose in {**FAR, "pursuer": pursuer}.items():
        onboard.see(robot, now + PERIOD, pose)
    following = onboard.decide(now + PERIOD)
    assert (following.level, following.reactions) == ("normal", ())
    np.testing.assert_allclose(following.velocity, (0.0, 0.1), atol=1e-6)


class _Real:
    """The world in real time beside a process that decides; whoever goes silent for 0.3 s is stopped."""

    def __init__(self, folder, board):
        self.robots = Duel(1.0, 0.06, 0.2)
        self.board, self.ahead = board, 0.0
        self.decisions, self._heard, self._velocity = [], 0.0, (0.0, 0.0)
        script = str(Path(__file__).with_name("onboard_loop.py"))
        self.process = subprocess.Popen(
            [sys.executable, script, str(folder / "board"), str(folder / "said")], stdout=subprocess.DEVNULL
        )
        self._said = folder / "said"
        self._read = 0
        self._now = time.monotonic()

    def go_on(self, until, seconds=600.0):
        """Let the world move on until something is so."""
        end = time.monotonic() + seconds
        while not until():
            assert time.monotonic() < end, self.decisions[-5:]
            assert self.process.poll() is None
            now = time.monotonic()
            silent = now - self._heard > 0.3
            if self.decisions:
                self.robots.advance(now - self._now, (0.0, 0.0) if silent else self._velocity)
            self._now = now
            self.board.write(now + self.ahead, self.ahead, *self.robots.evader, *self.robots.pursuer)
            self._listen(now)
            time.sleep(0.01)

    def _listen(self, now):
        if not self._said.exists():
            return
        with self._said.open() as file:
            file.seek(self._read)
            while (line := file.readline()).endswith("\n"):
                self._read = file.tell()
                self.decisions.append(json.loads(line))
                self._heard, self._velocity = now, self.decisions[-1]["velocity"]


@pytest.mark.skipif(not hasattr(signal, "SIGSTOP"), reason="needs SIGSTOP")
def test_a_process_that_is_held_up_for_seconds_and_a_clock_set_back_cost_a_period_each(tmp_path, monkeypatch):
    monkeypatch.syspath_prepend(str(Path(__file__).parent))
    board = importlib.import_module("onboard_loop").Board(tmp_path / "board", create=True)
    real = _Real(tmp_path, board)
    try:
        real.go_on(lambda: len(real.decisions) > 20)
        real.process.send_signal(signal.SIGSTOP)
        held = time.monotonic() + 5.0
        real.go_on(lambda: time.monotonic() > held)
        woken = len(real.decisions)
        real.process.send_signal(signal.SIGCONT)
        real.go_on(lambda: len(real.decisions) > woken + 20)
        set_back = len(real.decisions)
        real.ahead = -8.0
        real.go_on(lambda: len(real.decisions) > set_back + 60)
    finally:
        real.process.kill()
        real.process.wait()
    paused = [d for d in real.decisions[woken - 1 :] if any("a pause" in words for words in d["reactions"])]
    assert len(paused) >= 1
    assert "plan are forgotten" in " ".join(paused[0]["reactions"])
    back = [count for count, d in enumerate(real.decisions) if "went back" in " ".join(d["reactions"])]
    assert len(back) == 1
    assert real.decisions[back[0]]["level"] == "stop"
    awake = real.decisions.index(paused[0])
    # From the period after, with poses of now, it never stands still again.
    for count, decision in enumerate(real.decisions[awake + 1 :], awake + 1):
        if count not in (back[0], back[0] - 1) and decision["age"] <= 0.15:
            assert decision["level"] != "stop", (count - awake, count - back[0], decision)
    assert real.robots.least > CAPTURE


def test_settings_say_when_a_motion_is_forgotten():
    assert OnboardSettings().forgotten_after(0.05) == 1.0
    assert OnboardSettings(stale_after=3.0).forgotten_after(0.05) == 3.0
    assert OnboardSettings().forgotten_after(0.5) == 2.0
