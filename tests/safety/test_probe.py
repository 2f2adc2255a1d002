"""Barriers and shields for custom robots: what is refused, what is doubted, what is kept."""

import dataclasses
import math
import runpy
import warnings
from pathlib import Path

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from sidestep.pursuit import CaptureGame
from sidestep.safety import (
    AdaptedShield,
    Barrier,
    BarrierWarning,
    DistanceValue,
    FrameBarrier,
    GameShield,
    ObstacleBarrier,
    PursuitBarrier,
    RangeBarrier,
    Status,
    as_shield,
    covered,
    grid_barrier,
    make_shield,
    of_control_point,
    probe_barrier,
    shield_of,
    solve_distance,
)
from sidestep.world import PursuerModel, World, load_scenario
from sidestep.world.robots import wheels_from_body

# What users are shown is what is tested.
EXAMPLES = Path(__file__).parents[2] / "examples"
Car = runpy.run_path(str(EXAMPLES / "car_pursuer.py"))["Car"]
Unicycle = runpy.run_path(str(EXAMPLES / "unicycle_evader.py"))["Unicycle"]


def _closed_form(scenario, z):
    side = jnp.where(z[1] < 0.0, -1.0, 1.0)
    return CaptureGame.of(scenario).barrier(z, side)[0]


def test_certified_barrier_and_obstacle_barrier_are_without_fault():
    scenario = load_scenario("paper")
    for barrier in (PursuitBarrier(), ObstacleBarrier()):
        found = probe_barrier(barrier, scenario)
        assert (found.errors, found.doubts) == ((), ())


def test_papers_barrier_is_doubted_for_what_is_known_to_be_wrong_with_it():
    found = probe_barrier(RangeBarrier(), load_scenario("paper"))
    assert found.errors == ()
    assert len(found.doubts) == 2
    # It takes a pursuer that backs onto the evader at V to be driving away at V.
    assert found.shortfall == pytest.approx(0.4, abs=0.01)
    # Straight ahead it asks for V - gamma h of an evader that has less.
    assert 0.05 < found.infeasible < 0.5


class _Steady(Barrier):
    """The paper's barrier towards pursuers, from which broken ones are made."""

    def robots(self, world):
        return world.pursuers

    def value(self, scenario, evader, robot, memory):
        return RangeBarrier().value(scenario, evader, robot, memory)

    def gradient_and_rate(self, scenario, evader, robot, memory):
        return RangeBarrier().gradient_and_rate(scenario, evader, robot, memory)

    def alpha(self, scenario, h):
        return 1.2 * h


class _AlphaAtZero(_Steady):
    def alpha(self, scenario, h):
        return 0.05 + 1.2 * h


class _FallingAlpha(_Steady):
    def alpha(self, scenario, h):
        return h * (0.3 - h)


class _TurnedNormal(_Steady):
    def gradient_and_rate(self, scenario, evader, robot, memory):
        normal, rate = super().gradient_and_rate(scenario, evader, robot, memory)
        return -normal, rate


class _NoHold(_Steady):
    """Speaks of how fast the pursuer closes in, in which the evader's position has no part."""

    def value(self, scenario, evader, robot, memory):
        return 0.01 * jnp.cos(robot[2])

    def gradient_and_rate(self, scenario, evader, robot, memory):
        return jnp.zeros(2), jnp.zeros(())


class _NotFinite(_Steady):
    def value(self, scenario, evader, robot, memory):
        return jnp.sqrt(super().value(scenario, evader, robot, memory))


class _WrongUnits(_Steady):
    def value(self, scenario, evader, robot, memory):
        return 1000.0 * super().value(scenario, evader, robot, memory) + 500.0

    def gradient_and_rate(self, scenario, evader, robot, memory):
        normal, rate = super().gradient_and_rate(scenario, evader, robot, memory)
        return 1000.0 * normal, 1000.0 * rate


class _Reversed(_Steady):
    def value(self, scenario, evader, robot, memory):
        return -super().value(scenario, evader, robot, memory)

    def gradient_and_rate(self, scenario, evader, robot, memory):
        normal, rate = super().gradient_and_rate(scenario, evader, robot, memory)
        return -normal, -rate


class _Vector(_Steady):
    def value(self, scenario, evader, robot, memory):
        return evader - robot[:2]


class _NoRate(_Steady):
    def gradient_and_rate(self, scenario, evader, robot, memory):
        return super().gradient_and_rate(scenario, evader, robot, memory)[0]


class _Typo(_Steady):
    def alpha(self, scenario, h):
        return scenario.pursuer_gian * h


class _OneRobot(_Steady):
    def robots(self, world):
        return world.pursuer


@pytest.mark.parametrize(
    "barrier, words",
    [
        (_AlphaAtZero(), r"alpha\(0\) = 0\.05 m/s: it must be 0"),
        (_FallingAlpha(), "does not increase with h"),
        (_TurnedNormal(), "the normal is not the gradient"),
        (_NoHold(), r"relative degree above 1"),
        (_NotFinite(), r"h, .*not finite, for instance with the evader at"),
        (_WrongUnits(), "h is above 0 at 100% of the places in contact"),
        (_Reversed(), "is its sign turned round"),
        (_Vector(), r"value\(scenario, evader, robot, memory\) must give one number.*\(2,\)"),
        (_NoRate(), r"must give \(normal \(2,\), rate \(\)\)"),
        (_Typo(), r"alpha\(scenario, h\) raised AttributeError"),
        (_OneRobot(), r"one row of numbers for each robot"),
    ],
    ids=lambda value: type(value).__name__,
)
def test_what_is_no_barrier_is_refused_in_plain_words(barrier, words):
    with pytest.raises(ValueError, match=words):
        shield_of(barrier, load_scenario("paper"))


def test_value_alone_gives_the_certified_row():
    """n and rate by differentiation, against those derived by hand."""
    scenario = load_scenario("paper")
    own, certified = FrameBarrier(_closed_form), PursuitBarrier()
    rng = np.random.default_rng(0)
    evaders = jnp.asarray(rng.uniform(-1.0, 1.0, (256, 2)), float)
    poses = jnp.asarray(rng.uniform(-1.0, 1.0, (256, 3)) * np.array([1.0, 1.0, np.pi]), float)

    def row(barrier, evader, pose):
        memory = barrier.update_memory(scenario, evader, pose, None)
        return barrier.value(scenario, evader, pose, memory), barrier.gradient_and_rate(
            scenario, evader, pose, memory
        )

    (h, (normal, rate)), (expected, (expected_normal, expected_rate)) = (
        eqx.filter_jit(jax.vmap(lambda evader, pose, b=barrier: row(b, evader, pose)))(evaders, poses)
        for barrier in (own, certified)
    )
    np.testing.assert_allclose(h, expected, atol=1e-5)
    np.testing.assert_allclose(normal, expected_normal, atol=1e-3)
    np.testing.assert_allclose(rate, expected_rate, atol=1e-3)


def test_own_barrier_is_kept_before_obstacles_and_doubts_are_told():
    scenario = load_scenario("paper")
    with pytest.warns(BarrierWarning) as told:
        shield = as_shield(RangeBarrier(), scenario)
    rows, rate = sorted(str(warning.message) for warning in told)
    assert "the evader cannot keep the row" in rows
    assert "faster than the rate says" in rate
    worlds = jax.vmap(scenario.reset)(jax.random.split(jax.random.key(2), 8))
    wish = jnp.asarray([0.15, 0.0], float)

    def answer(shield):
        return jax.vmap(lambda world: shield(world, wish, shield.init(world))[0].action)(worlds)

    # With the paper's barrier it is the paper's shield.
    np.testing.assert_allclose(answer(shield), answer(make_shield("paper", scenario)), atol=1e-6)


class _Spinner(PursuerModel):
    """Can do anything that nothing is known of."""

    def limit(self, scenario, speed, turn_rate):
        most = scenario.pursuer_speed
        return jnp.clip(speed, -most, most), jnp.clip(turn_rate, -most, most)

    def corners(self, scenario):
        return scenario.pursuer_speed * jnp.asarray([(1.0, 1.0), (1.0, -1.0), (-1.0, 1.0), (-1.0, -1.0)])


@pytest.mark.parametrize("name", ["game", "joint"])
def test_certified_shields_refuse_a_pursuer_that_they_know_nothing_of(name):
    scenario = load_scenario("paper", pursuer_model=_Spinner())
    with pytest.raises(ValueError, match=r"_Spinner names no differential drive.*shield_of"):
        make_shield(name, scenario)
    assert isinstance(make_shield("none", scenario), AdaptedShield)


def test_adapted_shield_guards_the_point_that_moves_as_told():
    scenario = load_scenario("paper", evader_model=Unicycle(), pursuer_model=Car(), capture_distance=0.12)
    shield = make_shield("game", scenario)
    plain = covered(of_control_point(scenario))
    assert plain.built_in
    assert float(plain.capture_distance) == pytest.approx(0.14)
    assert float(plain.pursuer_speed) == pytest.approx(0.35)
    inner = make_shield("game", plain)
    world = World(
        jnp.asarray([0.25, 0.02]), jnp.zeros((1, 3)), jnp.asarray([[2.0, 2.0, 0.0, 0.0]]), jnp.full(2, 3.0),
        wheel_speeds=wheels_from_body(jnp.asarray(0.2), jnp.asarray(0.1), scenario.pursuer_half_axle)[None],
        evader_state=jnp.asarray([math.pi / 2.0]),
    )  # fmt: skip
    point = dataclasses.replace(
        world,
        evader=jnp.asarray([0.25, 0.04]),
        evader_state=None,
        wheel_speeds=wheels_from_body(jnp.asarray(0.2), jnp.asarray(0.1), plain.pursuer_half_axle)[None],
    )
    wish = jnp.asarray([-0.15, 0.0])
    result, _ = shield(world, wish, shield.init(world))
    expected, _ = inner(point, wish, inner.init(point))
    np.testing.assert_allclose(result.action, expected.action, atol=1e-6)
    np.testing.assert_allclose(result.barriers, expected.barriers, atol=1e-6)
    assert int(result.status) != Status.OK


class _Rail(PursuerModel):
    """Cannot turn at all: the game has a closed form, the distance to the tangents of the capture set."""

    def limit(self, scenario, speed, turn_rate):
        return jnp.clip(speed, -scenario.pursuer_speed, scenario.pursuer_speed), jnp.zeros_like(turn_rate)

    def corners(self, scenario):
        return scenario.pursuer_speed * jnp.asarray([(1.0, 0.0), (-1.0, 0.0)])


def test_grid_solves_the_game_of_a_pursuer_on_a_rail():
    scenario = load_scenario("paper", pursuer_model=_Rail(), capture_distance=0.1)
    value = solve_distance(scenario, reach=0.8, cells=40)
    assert value.settled
    rng = np.random.default_rng(0)
    places = jnp.asarray(rng.uniform(-0.5, 0.5, (200, 2)), float)
    # W = h + l, whatever l is.
    exact = jax.vmap(lambda z: _closed_form(scenario, z))(places) + scenario.capture_distance
    found = jax.vmap(value)(places)
    assert float(jnp.mean(jnp.abs(found - exact))) < 0.001
    assert float(jnp.max(found - exact)) < min(0.002, value.error)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", BarrierWarning)
        assert probe_barrier(grid_barrier(scenario, value), scenario).errors == ()


def test_grid_barrier_is_refused_where_the_pursuer_wins():
    scenario = load_scenario("paper", pursuer_model=Car())
    flat = DistanceValue(jnp.full((41, 41), 0.15), 1.0, 0.002)
    with pytest.raises(ValueError, match=r"within 0\.15 m.*0\.202 m together: there is nothing to keep"):
        grid_barrier(scenario, flat)


@pytest.mark.parametrize(
    "options, words", [({"cells": 41}, "even number"), ({"reach": 0.3}, "two capture distances")]
)
def test_grid_that_cannot_be_solved_on(options, words):
    with pytest.raises(ValueError, match=words):
        solve_distance(load_scenario("paper"), **options)


def test_a_barrier_with_the_old_names_still_works_and_says_so():
    """The names of before are those that custom barriers override; they go with the next release."""
    with warnings.catch_warnings(record=True) as told:
        warnings.simplefilter("always")

        class Old(_Steady):
            def approach(self, scenario, evader, robot, memory):
                normal, rate = super().approach(scenario, evader, robot, memory)
                return normal, rate + 0.01

            def allowance(self, scenario, h):
                return 2.0 * h

            def recall(self, scenario, evader, robot, memory):
                return jnp.ones(())

    assert str(told[1].message) == "Old.allowance is alpha now; the old name goes with the next release"
    assert [one.filename for one in told] == [__file__] * 3
    scenario = load_scenario("paper")
    world = scenario.reset(jax.random.key(0))
    memory = Old().update_memories(scenario, world)
    with pytest.warns(DeprecationWarning, match="approach is gradient_and_rate now"):
        rows = Old().rows(scenario, world, memory)
    plain = RangeBarrier().rows(scenario, world, memory)
    np.testing.assert_allclose(rows.offsets, plain.offsets + 0.01 + (1.2 - 2.0) * plain.values, rtol=1e-5)
    assert np.array_equal(memory, [1.0])
    with pytest.warns(DeprecationWarning, match="remember is update_memories now") as told:
        assert np.array_equal(Old().remember(scenario, world), memory)
    assert told[0].filename == __file__
    with pytest.warns(DeprecationWarning, match="recall is update_memory now"):
        side = PursuitBarrier().recall(scenario, world.evader, world.pursuer, None)
    assert side == PursuitBarrier().update_memory(scenario, world.evader, world.pursuer, None)
    with pytest.warns(DeprecationWarning, match="recall is update_memory now"):
        assert RangeBarrier().recall(scenario, world.evader, world.pursuer, None) == 0.0


def test_old_names_of_the_game_shield_still_work_and_say_so():
    scenario = load_scenario("paper")
    with pytest.warns(DeprecationWarning, match="wish_picks_side is nominal_picks_side now") as told:
        shield = GameShield(scenario, wish_picks_side=True)
    assert told[0].filename == __file__
    assert shield.nominal_picks_side
    world = scenario.reset(jax.random.key(0))
    given = world, jnp.array([0.1, 0.0]), shield.init(world)
    with pytest.warns(DeprecationWarning, match="heed is filter_unchecked now"):
        old = shield.heed(*given)
    np.testing.assert_array_equal(old[0], shield.filter_unchecked(*given)[0])
