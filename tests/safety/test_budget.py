"""A shield told of errors, delay and weak motors keeps what they take; one that is not told is captured."""

import warnings

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from sidestep.loop.step import outcome_of
from sidestep.pursuit import CaptureGame, make_pursuer
from sidestep.safety import Budget, BudgetWarning, GameShield, JointShield, certify, make_shield
from sidestep.safety.shields import catalogue
from sidestep.world import World, load_scenario

# The evader heads for the target and stays there, while the pursuer comes again and again.
FIELDS = {"obstacle_count": 0, "reach_distance": 1e-9, "initial_separation": 0.0}
PERIODS, OLD, EPISODES = 600, 2, 40


@eqx.filter_jit
def _captured(scenario, shield, keys, position_error, heading_error, tracking_error, delayed):
    """Episodes of 30 s that end in a capture, out of those that begin with `keys`."""
    pursuer = make_pursuer("nash")

    def episode(key):
        start, noise, pursuit = jax.random.split(key, 3)
        world = scenario.reset(start)

        def period(carry, count):
            world, memory, poses, caught = carry
            at, turn = jax.random.split(jax.random.fold_in(noise, count))
            # As far off as the errors allow, in a direction of its own every time.
            angle = jax.random.uniform(at, (), minval=0.0, maxval=2.0 * jnp.pi)
            offset = position_error * jnp.stack([jnp.cos(angle), jnp.sin(angle)])
            pose = poses[jnp.where(delayed, 0, OLD)]
            pose = pose.at[0, 2].add(heading_error * jnp.sign(jax.random.normal(turn)))
            seen = eqx.tree_at(lambda w: (w.evader, w.pursuers), world, (world.evader + offset, pose))
            wish = seen.target - seen.evader
            wish = scenario.evader_speed * wish / jnp.maximum(jnp.linalg.norm(wish), 0.02)
            result, memory = shield(seen, wish, memory)
            speed = jnp.linalg.norm(result.action)
            driven = result.action * jnp.maximum(1.0 - tracking_error / jnp.maximum(speed, 1e-6), 0.0)
            wheels = pursuer(scenario, world, jax.random.fold_in(pursuit, count))
            world, events = scenario.step(world, driven, wheels)
            poses = jnp.concatenate([poses[1:], world.pursuers[None]])
            return (world, memory, poses, caught | (outcome_of(events) == 0)), None

        begin = (world, shield.init(world), jnp.repeat(world.pursuers[None], OLD + 1, 0), jnp.asarray(False))
        return jax.lax.scan(period, begin, jnp.arange(PERIODS))[0][3]

    return jnp.sum(jax.vmap(episode)(keys))


@eqx.filter_jit
def _asked(shield, world, nominal):
    return shield(world, nominal, shield.init(world))


@pytest.mark.parametrize(
    "budget, distance",
    [
        ({"position_error": 0.01}, 0.15),
        ({"heading_error": 0.15}, 0.15),
        ({"delay": 0.1}, 0.15),
        ({"tracking_error": 0.005}, 0.178),
    ],
    ids=lambda value: next(iter(value)) if isinstance(value, dict) else "",
)
def test_what_the_budget_allows_for_captures_only_the_shield_that_was_not_told(budget, distance):
    scenario = load_scenario("paper", capture_distance=distance, **FIELDS)
    told = Budget(**budget)
    assert float(told.excess(scenario)) < 0.0
    keys = jax.random.split(jax.random.key(5), EPISODES)
    wrong = (told.position_error, told.heading_error, told.tracking_error, told.delay > 0.0)
    nothing = GameShield(scenario, Budget())
    assert int(_captured(scenario, GameShield(scenario, told), keys, *wrong)) == 0
    assert int(_captured(scenario, nothing, keys, *wrong)) > 0


def test_other_budgets_do_not_compile_again_and_none_is_the_shield_as_it_was():
    scenario = load_scenario("paper", capture_distance=0.15)
    world = World(
        jnp.zeros(2), jnp.array([[-0.3, 0.02, 0.1]]), jnp.array([[0.4, 0.0, 0.02, 0.0]]), jnp.ones(2)
    )
    asked = eqx.filter_jit(
        eqx.debug.assert_max_traces(lambda s, w: s(w, jnp.ones(2), s.init(w))[0], max_traces=1)
    )
    without = asked(GameShield(scenario, Budget()), world)
    plain, _ = _asked(GameShield(scenario), world, jnp.ones(2))
    np.testing.assert_allclose(without.action, plain.action, atol=1e-6)
    wary = asked(GameShield(scenario, Budget(position_error=0.04, delay=0.1)), world)
    # It retreats sooner, and reports the distances themselves all the same.
    assert float(wary.action[0]) > float(plain.action[0]) + 0.01
    np.testing.assert_allclose(wary.barriers, plain.barriers, atol=1e-6)


def test_obstacles_are_kept_farther_by_what_position_and_unseen_own_motion_may_hide():
    scenario = load_scenario("paper")
    world = World(
        jnp.zeros(2), jnp.array([[50.0, 0.0, 0.0]]), jnp.array([[0.25, 0.0, 0.0, 0.0]]), jnp.ones(2)
    )
    ahead = jnp.array([0.1574, 0.0])
    for budget, kept in (
        (Budget(position_error=0.02), 0.02),
        (Budget(delay=0.1), 0.0),
        (Budget(delay=0.1, own_motion_predicted=False), 0.01574),
    ):
        result, _ = _asked(GameShield(scenario, budget), world, ahead)
        # Its gain is 1/s: the speed towards an obstacle is the distance that is left.
        assert float(result.action[0]) == pytest.approx(0.05 - kept, abs=1e-4)


def test_a_budget_beyond_what_the_game_leaves_is_said_once_and_kept_as_well_as_can_be():
    scenario = load_scenario("paper", **FIELDS)
    budget = Budget(position_error=0.005)
    with pytest.warns(BudgetWarning, match="exceeds what the game allows by 4.2.* mm") as told:
        shield = make_shield("game", scenario, budget)
    assert len(told) == 1
    keys = jax.random.split(jax.random.key(6), EPISODES)
    wrong = (jnp.asarray(0.001), jnp.asarray(0.003), jnp.asarray(0.0), jnp.asarray(False))
    assert int(_captured(scenario, shield, keys, *wrong)) == 0


@pytest.mark.slow
def test_a_budget_within_the_game_is_silent_and_the_certificate_agrees_about_its_size():
    scenario = load_scenario("paper", capture_distance=0.17, control_period=0.01, obstacle_count=0)
    parts = {"position_error": 0.001, "heading_error": 0.002, "delay": 0.01, "tracking_error": 0.002}
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert isinstance(make_shield("joint", scenario, Budget(**parts)), JointShield)
    certificate = certify(scenario, **parts, check_shield=False)
    assert certificate.guaranteed
    counted = sum(certificate.budget[name] for name in ("position", "heading", "delay"))
    # The certificate also counts what an inexact velocity does to the own motion that is predicted.
    assert counted == pytest.approx(
        float(Budget(**parts).towards_pursuers(scenario)) + 0.002 * 0.01, abs=1e-6
    )
    slower = CaptureGame(0.1574 - 0.002, 0.2, 0.2, 0.17)
    lost = 0.20079 - float(slower.largest_capture_distance)
    assert certificate.budget["tracking"] == pytest.approx(lost, rel=0.1)


@pytest.mark.parametrize(
    "wrong, words",
    [
        ({"position_error": -0.1}, "position_error"),
        ({"delay": float("nan")}, "delay"),
        ({"heading_error": 2.0}, "heading_error"),
        ({"tracking_error": 0.2}, "no less than the evader's speed"),
    ],
)
def test_a_budget_that_cannot_be_is_refused_with_its_part(wrong, words):
    with pytest.raises(ValueError, match=words):
        make_shield("joint", load_scenario("paper"), Budget(**wrong))


def test_any_registered_shield_that_keeps_the_pursuit_barrier_is_given_the_budget(monkeypatch):
    monkeypatch.setitem(catalogue.SHIELDS, "another", GameShield)
    monkeypatch.setattr(catalogue, "PURSUIT_SHIELDS", (*catalogue.PURSUIT_SHIELDS, "another"))
    scenario, budget = load_scenario("paper", capture_distance=0.15), Budget(position_error=0.001)
    for name in catalogue.PURSUIT_SHIELDS:
        assert eqx.tree_equal(make_shield(name, scenario, budget).budget, budget), name


def test_shields_that_keep_no_budget_say_so():
    scenario = load_scenario("paper")
    with pytest.raises(ValueError, match="keeps no budget"):
        make_shield("paper", scenario, Budget())
    with pytest.raises(ValueError, match="keep no budget"):
        GameShield(scenario, Budget(), known_velocity=True)
