"""The decision core under every fault: never an unfiltered command, never an exception, always a word."""

import math

import jax.numpy as jnp
import numpy as np
import pytest

from sidestep.robot import Onboard, OnboardSettings, Reading
from sidestep.safety import Budget, BudgetWarning, JointShield, Status
from sidestep.world import load_scenario

PERIOD = 0.05
SCENARIO = load_scenario("paper", capture_distance=0.15)
# The pursuer stands across, so that straight away from it is the way to flee.
ACROSS = math.pi / 2.0
FAR = {"pursuer": (3.0, 0.0, ACROSS), "obstacle": (0.0, 3.0)}
WISH = np.array([0.1, 0.05])


def run(onboard, periods, begin=0, *, pursuer=FAR["pursuer"], without=(), wish=WISH, decide=True):
    """Feed everything but `without` and decide, once a period; the last decision."""
    decision = None
    for count in range(begin, begin + periods):
        now = PERIOD * count
        for robot, pose in (("evader", (0.0, 0.0, 0.0)), ("pursuer", pursuer), ("obstacle", FAR["obstacle"])):
            if robot not in without:
                onboard.see(robot, now, pose)
        if "nominal" not in without:
            onboard.nominal(now, wish)
        decision = onboard.decide(now) if decide else None
    return decision


def test_all_is_well_and_the_wish_passes_unchanged(onboard):
    decision = run(onboard, 3)
    assert (decision.level, decision.reactions, decision.status) == ("normal", (), Status.OK)
    np.testing.assert_allclose(decision.velocity, WISH, atol=1e-7)
    assert decision.clearance == pytest.approx(2.8, abs=0.02)
    np.testing.assert_allclose(decision.barriers, [2.85, 2.8], atol=0.02)
    assert 0.0 < decision.compute_seconds <= decision.latency
    assert decision.world.pursuers.shape == (1, 3)


def test_before_every_robot_has_been_seen_it_stands_still_and_says_which_it_waits_for(onboard):
    decision = run(onboard, 2, without=("pursuer",))
    assert decision.level == "stop"
    assert decision.status == Status.INVALID
    assert "pursuer 0" in decision.reactions[0]
    assert not np.any(decision.velocity)


@pytest.mark.parametrize("robot", ["evader", "pursuer", "obstacle"])
def test_a_pose_that_stops_coming_degrades_first_and_then_leaves_the_wish_alone(onboard, robot):
    run(onboard, 5)
    soon = run(onboard, 3, 5, without=(robot,))
    assert soon.level == "degraded"
    assert "last seen" in soon.reactions[0]
    late = run(onboard, 4, 8, without=(robot,))
    assert late.level == ("stop" if robot == "evader" else "evade")
    assert "stale" in late.reactions[0]
    # Full speed away from the pursuer, which is at +x.
    expected = (0.0, 0.0) if robot == "evader" else (-0.1574, 0.0)
    np.testing.assert_allclose(late.velocity, expected, atol=0.005)
    assert run(onboard, 2, 12).level == "normal"


def test_a_pursuer_unseen_for_longer_is_kept_farther_away(onboard):
    near = (-0.35, 0.0, 0.0)
    at_once = run(onboard, 4, pursuer=near, wish=np.zeros(2))
    unseen = run(onboard, 3, 4, without=("pursuer",), wish=np.zeros(2))
    assert unseen.velocity[0] > at_once.velocity[0] + 0.01


def test_stopping_may_be_configured_instead_of_fleeing():
    careful = Onboard(SCENARIO, "none", settings=OnboardSettings(on_fault="stop"))
    run(careful, 3)
    decision = run(careful, 6, 3, without=("pursuer",))
    assert decision.level == "stop"
    assert not np.any(decision.velocity)


@pytest.mark.parametrize(
    "stamp, pose, reading",
    [
        (0.2, (math.nan, 0.0, ACROSS), Reading.NOT_FINITE),
        (math.inf, (3.0, 0.0, ACROSS), Reading.NOT_FINITE),
        (0.01, (3.0, 0.0, ACROSS), Reading.OUT_OF_ORDER),
        (0.1, (3.0, 0.0, ACROSS), Reading.OUT_OF_ORDER),
        (0.12, (2.5, 0.0, ACROSS), Reading.JUMP),
        (0.12, (3.0, 0.0, -1.0), Reading.JUMP),
        (99.0, (3.0, 0.0, ACROSS), Reading.FROM_THE_FUTURE),
    ],
)
def test_a_bad_pose_changes_nothing_but_is_told_of(onboard, stamp, pose, reading):
    before = run(onboard, 3).world.pursuers
    assert onboard.see("pursuer", stamp, pose) is reading
    decision = onboard.decide(0.14)
    assert decision.reactions[0] == f"pursuer 0: 1 {reading.value}, dropped"
    np.testing.assert_allclose(decision.world.pursuers, before, atol=1e-6)
    assert onboard.counts[("pursuer 0", reading)] == 1
    assert onboard.decide(0.145).reactions == ()


def test_a_robot_that_was_carried_elsewhere_is_believed_once_its_poses_agree(onboard):
    run(onboard, 3)
    for i in range(5):
        reading = onboard.see("pursuer", 0.11 + 0.005 * i, (1.0, 1.0, ACROSS))
        assert reading is (Reading.JUMP if i < 4 else Reading.RELOCATED)
        assert reading.used == (i == 4)
    decision = onboard.decide(0.15)
    assert decision.reactions == (
        "pursuer 0: 4 jump, dropped",
        "pursuer 0: is somewhere else now, its track begins anew",
    )
    counts = {reading: count for (name, reading), count in onboard.counts.items() if name == "pursuer 0"}
    assert counts == {Reading.ACCEPTED: 3, Reading.JUMP: 4, Reading.RELOCATED: 1}
    np.testing.assert_allclose(decision.world.pursuers[0, :2], [1.0, 1.0], atol=1e-6)


def test_single_outliers_in_a_row_that_contradict_each_other_are_never_believed(onboard):
    run(onboard, 3)
    for i in range(20):
        pose = (1.0 + (i % 2), 1.0, 0.0)
        assert onboard.see("pursuer", 0.11 + 0.004 * i, pose) is Reading.JUMP


def test_robots_that_the_scenario_does_not_have_are_refused(onboard):
    assert onboard.see("pursuer", 0.0, (0, 0, 0), index=1) is Reading.UNKNOWN_ROBOT
    assert onboard.see("rabbit", 0.0, (0, 0, 0)) is Reading.UNKNOWN_ROBOT
    assert onboard.see("pursuer", 0.0, (0, 0, 0), index=-1) is Reading.UNKNOWN_ROBOT
    for index in range(3000):
        onboard.see("pursuer", 0.0, (0, 0, 0), index=7 + index)
    assert len(onboard.counts) < 1100
    assert sum(onboard.counts.values()) == 3003


def test_a_lost_wish_is_a_wish_to_stand_still_unless_something_presses(onboard):
    decision = run(onboard, 2, without=("nominal",))
    assert "no nominal velocity yet" in decision.reactions[0]
    run(onboard, 3, 2)
    decision = run(onboard, 12, 5, without=("nominal",))
    assert decision.level == "degraded"
    assert "nominal velocity lost" in decision.reactions[0]
    assert not np.any(decision.velocity)
    onboard.reset()
    pressed = run(onboard, 3, pursuer=(-0.25, 0.0, 0.0), without=("nominal",))
    assert pressed.velocity[0] > 0.05


@pytest.mark.parametrize("wish", [(math.nan, 0.0), (0.0, math.inf)])
def test_a_wish_that_is_no_number_is_dropped_and_the_last_one_goes_on(onboard, wish):
    run(onboard, 3)
    assert onboard.nominal(0.12, wish) is Reading.NOT_FINITE
    decision = onboard.decide(0.15)
    np.testing.assert_allclose(decision.velocity, WISH, atol=1e-7)
    assert decision.reactions == ("nominal: 1 not finite, dropped",)
    assert onboard.nominal(0.05, WISH) is Reading.OUT_OF_ORDER


def test_a_late_cycle_is_said_and_allowed_for_and_forgotten_again(onboard):
    near = {"pursuer": (-0.33, 0.0, 0.0), "wish": np.zeros(2)}
    in_time = run(onboard, 3, **near)
    late = run(onboard, 1, 5, **near)
    assert late.level == "degraded"
    assert late.reactions == ("late by 100.0 ms: allowed for as delay",)
    assert late.velocity[0] > in_time.velocity[0] + 0.005
    calm = run(onboard, 60, 6, **near)
    assert calm.level == "normal"
    assert calm.velocity[0] < late.velocity[0] - 0.005


def test_random_garbage_never_raises_and_never_lets_a_command_out_of_the_limits(onboard):
    rng = np.random.default_rng(0)
    strange = [math.nan, math.inf, -math.inf, 1e30, -1e30, 0.0, 1e-30]
    for count in range(300):
        for robot in ("evader", "pursuer", "obstacle", "nobody"):
            pose = [rng.choice(strange) if rng.random() < 0.2 else rng.normal() for _ in range(3)]
            stamp = rng.choice(strange) if rng.random() < 0.1 else PERIOD * count - rng.random() * 0.1
            onboard.see(robot, stamp, pose[: 2 if robot == "obstacle" else 3], int(rng.integers(-1, 2)))
        onboard.nominal(PERIOD * count, rng.choice(strange, 2) if rng.random() < 0.3 else rng.normal(size=2))
        decision = onboard.decide(PERIOD * count + (rng.normal() if rng.random() < 0.1 else 0.0))
        assert np.all(np.isfinite(decision.velocity))
        assert np.hypot(*decision.velocity) <= 0.1574 * (1.0 + 1e-6)
        assert decision.level in ("normal", "degraded", "evade", "stop")


class _Evil:
    """Raises whatever it is asked for."""

    def __array__(self, *_, **__):
        raise RuntimeError("no array")

    def __index__(self):
        raise ZeroDivisionError

    def __float__(self):
        raise KeyError

    __len__ = __iter__ = __hash__ = __eq__ = __lt__ = __float__


RUBBISH = {
    "none": None, "text": "abc", "digits": ("1", "2", "3"), "bytes": b"123", "object": object(),
    "evil": _Evil(), "empty": (), "one": (1.0,), "four": (1.0, 2.0, 3.0, 4.0), "two": (1.0, 2.0),
    "nested": [[1.0, 2.0, 3.0]],
    "ragged": [[1.0], [1.0, 2.0]], "mapping": {"x": 1.0}, "function": len, "complex": (1j, 2j, 3j),
    "flags": (True, False, True), "with none": (1.0, None, 2.0), "nan": (math.nan, 0.0, 0.0),
    "infinite": (0.0, -math.inf, 0.0), "huge": (1e308, -1e308, 1e308), "far": (4.6e6, 5e5, 0.0),
    "huge whole": (10**400, 0, 0), "generator": (x for x in (1.0, 2.0)), "dates": np.zeros(3, "M8[s]"),
    "many": np.zeros((50, 3)), "number": 7.0, "negative": -1, "large": 10**400, "not a number": math.nan,
    "endless": math.inf, "longest": 1e308, "flag": True, "complex number": 1j, "0-d text": np.array("x"),
    "long double": np.full(3, np.finfo(np.longdouble).max), "structured": np.zeros(3, "f8,i4"),
}  # fmt: skip


@pytest.mark.parametrize("rubbish", RUBBISH.values(), ids=RUBBISH)
def test_nothing_that_is_handed_in_raises_or_changes_what_is_known(onboard, rubbish):
    before = run(onboard, 3)
    pose = {"evader": (0.0, 0.0, 0.0), "pursuer": FAR["pursuer"], "obstacle": FAR["obstacle"]}
    handed, known = 0, sum(onboard.counts.values())
    for robot in pose:
        for stamp, what, index in (
            (0.12, rubbish, 0), (rubbish, pose[robot], 0), (0.12, pose[robot], rubbish), (rubbish,) * 3
        ):  # fmt: skip
            handed += 1
            reading = onboard.see(robot, stamp, what, index)
            assert not reading.used
    for robot in (rubbish, "rabbit"):
        handed += 1
        assert onboard.see(robot, rubbish, rubbish, rubbish) is Reading.UNKNOWN_ROBOT
    for stamp, velocity in ((0.12, rubbish), (rubbish, WISH), (rubbish, rubbish)):
        reading = onboard.nominal(stamp, velocity)
        assert not reading.used or velocity is RUBBISH["two"]
    assert sum(onboard.counts.values()) == known + handed + 3 - len(onboard._intake._waiting)
    # A clock that is none is as not given.
    assert onboard.see("pursuer", 0.125, FAR["pursuer"], now=rubbish) in (
        Reading.ACCEPTED, Reading.FROM_THE_FUTURE,
    )  # fmt: skip
    decision = onboard.decide(rubbish)
    assert np.all(np.isfinite(decision.velocity))
    assert all(len(words) < 200 for words in decision.reactions)
    onboard.world(rubbish)
    with pytest.raises(ValueError, match="two finite numbers"):
        onboard.target = (1.0, "far")
    # A clock that was a number has gone ahead, and goes back again: that costs the period that it costs.
    onboard.decide(0.2)
    after = run(onboard, 2, 5)
    assert (after.level, after.reactions) == ("normal", ())
    np.testing.assert_allclose(after.velocity, before.velocity, atol=1e-6)


def test_numbers_of_every_kind_are_taken(onboard):
    for count, kind in enumerate((list, tuple, np.array, np.float32, np.int64, jnp.asarray)):
        now = PERIOD * count
        for robot, pose in (("evader", [0, 0, 0]), ("pursuer", [3, 0, 1]), ("obstacle", [0, 3])):
            given = (
                np.asarray(pose, kind)
                if isinstance(kind, type) and issubclass(kind, np.generic)
                else kind(pose)
            )
            assert onboard.see(robot, np.float32(now), given, np.int8(0)) is Reading.ACCEPTED
        assert onboard.nominal(jnp.asarray(now), np.asarray(WISH, np.float32)) is Reading.ACCEPTED
        decision = onboard.decide(np.float64(now) if count % 2 else jnp.asarray(now))
    assert decision.level == "normal"


def test_a_heading_of_many_turns_is_a_heading(onboard):
    turns = 2.0 * math.pi * 1e5
    run(onboard, 3)
    assert onboard.see("pursuer", 0.12, (3.0, 0.0, ACROSS + turns)) is Reading.ACCEPTED


def test_a_policy_holds_still_once_it_has_arrived():
    there = Onboard(SCENARIO, "none", "goal-seeking")
    there.target = (0.03, 0.0)
    assert not np.any(run(there, 2, without=("nominal",)).velocity)


@pytest.fixture(scope="module")
def joint_core():
    # One model of the pursuer: what is compiled is smaller.
    shield = JointShield(SCENARIO, budget=Budget(), models=("nash",))
    core = Onboard(SCENARIO, shield, "goal-seeking")
    core.target = (2.0, 1.0)
    return core


def test_the_plan_of_another_world_is_not_followed_after_a_jump_and_the_policy_is_asked_anew(
    joint_core, monkeypatch
):
    core, asked, whole = joint_core, [], joint_core._whole

    class Listening:
        start = whole.start

        def __call__(self, *given):
            asked.append(given[2])
            return whole(*given)

    core.reset()
    # As for a policy that decides every fourth period.
    monkeypatch.setattr(core, "_decision_steps", 4)
    monkeypatch.setattr(core, "_whole", Listening())
    near = {"pursuer": (0.3, 0.0, math.pi), "without": ("nominal",)}
    begun = [run(core, 1, 200 + count, **near) for count in range(10)]
    assert int(core._memory.calls) == 10
    assert core.decide(2.0).level == "stop"
    assert core._memory is None
    again = [run(core, 1, 41 + count, **near) for count in range(10)]
    for before, after in zip(begun, again, strict=True):
        np.testing.assert_allclose(after.velocity, before.velocity, atol=2e-3)
    assert asked == 2 * [count % 4 == 0 for count in range(10)]


def test_a_core_that_keeps_falling_behind_goes_without_looking_ahead_until_it_keeps_pace(joint_core):
    core = joint_core
    core.reset()
    with pytest.raises(ValueError, match="has a policy and takes no nominal"):
        core.nominal(0.0, WISH)
    run(core, 3, without=("nominal",))
    for count in (5, 7, 9):
        decision = run(core, 1, count, without=("nominal",))
    assert decision.reactions[-1] == "fell behind: rows only, no look-ahead"
    # Toward the target all the same.
    np.testing.assert_allclose(decision.velocity, 0.1574 * np.array([2.0, 1.0]) / 5.0**0.5, atol=1e-4)
    assert run(core, 25, 10, without=("nominal",)).reactions == ()
    near = run(core, 40, 35, pursuer=(-0.3, 0.0, 0.0), without=("nominal",))
    assert near.plan.shape == (33, 2)
    assert np.all(np.hypot(*np.diff(near.plan, axis=0).T) <= 0.1574 * 8.0 / 32 * 1.01)


def test_the_look_ahead_knows_the_motors_and_how_fast_the_robot_is():
    settings = OnboardSettings(motor_lag=0.02, motor_acceleration=2.0)
    core = Onboard(SCENARIO, "joint", settings=settings)
    assert float(core._shield.acceleration) == 2.0
    for nimble in (OnboardSettings(), OnboardSettings(motor_acceleration=1000.0)):
        assert Onboard(SCENARIO, "joint", settings=nimble)._shield.acceleration is None
    rows = Onboard(SCENARIO, "game", settings=settings)
    before, after = run(rows, 1).world.evader_velocity, run(rows, 30, 1).world.evader_velocity
    np.testing.assert_allclose(before, 0.0)
    np.testing.assert_allclose(after, WISH, atol=1e-3)


def test_settings_and_targets_that_cannot_be_are_refused_with_all_that_is_wrong():
    with pytest.raises(ValueError, match=r"position_noise.*on_fault.*late_limit"):
        OnboardSettings(position_noise=-1.0, late_limit=0, on_fault="panic")
    with pytest.raises(ValueError, match="heading_error"):
        Onboard(SCENARIO, "game", settings=OnboardSettings(budget=Budget(heading_error=9.0)))
    with pytest.warns(BudgetWarning, match="exceeds"):
        Onboard(load_scenario("paper"), "game", settings=OnboardSettings(budget=Budget(delay=0.1)))
    with pytest.raises(ValueError, match="target"):
        Onboard(SCENARIO, "none").target = (0.0, math.nan)
