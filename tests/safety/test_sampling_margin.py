"""What the rows of `game` keep beyond the distances themselves, and the rows for a pursuer that is known."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from sidestep.pursuit import CaptureGame, make_pursuer, pursue
from sidestep.safety import GameShield, PursuitBarrier, Status
from sidestep.safety.barriers.sampling_margin import TOUCH, sampling_margin, with_margins
from sidestep.world import World, load_scenario


@eqx.filter_jit
def _asked(shield, world, nominal):
    return shield(world, nominal, shield.init(world))


def test_margin_grows_with_the_square_of_the_period_up_to_half_of_what_there_is_to_spare():
    short, longer = (float(sampling_margin(load_scenario("paper", control_period=t))) for t in (0.01, 0.02))
    assert short == pytest.approx(0.2**2 * 0.01**2 / 0.2, rel=1e-5)
    assert longer == pytest.approx(4.0 * short, rel=1e-5)
    paper = load_scenario("paper", control_period=0.2)
    spare = float(CaptureGame.of(paper).largest_capture_distance) - 0.2
    assert float(sampling_margin(paper)) == pytest.approx(spare / 2.0, rel=1e-5)


@pytest.mark.parametrize(
    "fields",
    [{"capture_distance": 0.25}, {"evader_speed": 0.3}, {"evader_speed": 0.2}, {"pursuer_half_axle": 0.3}],
)
def test_margin_is_finite_and_never_makes_a_pursuer_win(fields):
    scenario = load_scenario("paper", **fields)
    margin = float(sampling_margin(scenario))
    assert np.isfinite(margin)
    assert margin >= 0.0
    assert bool(CaptureGame.of(with_margins(scenario)).evader_can_escape) == bool(
        CaptureGame.of(scenario).evader_can_escape
    )


def test_barriers_are_reported_for_the_distances_of_capture_and_collision_themselves():
    scenario = load_scenario("paper")
    world = World(
        jnp.zeros(2), jnp.array([[0.0, -0.3, 0.0]]), jnp.array([[0.0, 0.4, 0.02, 0.0]]), jnp.ones(2)
    )
    result, _ = _asked(GameShield(scenario), world, jnp.zeros(2))
    np.testing.assert_allclose(result.barriers, [0.1, 0.2], atol=1e-6)


def test_an_evader_pressed_against_an_obstacle_for_long_does_not_touch_it_by_rounding():
    scenario = load_scenario("paper", obstacle_velocity=[0.0, 0.0])
    shield, far = GameShield(scenario), jnp.array([[50.0, 0.0, 0.0]])
    begin = World(jnp.array([-1.0, 0.0]), far, jnp.zeros((1, 4)), jnp.array([-0.19, 0.0]))

    def period(carry, _):
        world, memory = carry
        result, memory = shield(world, jnp.array([0.1574, 0.0]), memory)
        world, events = scenario.step(world, result.action, jnp.zeros((1, 2)))
        return (world, memory), events.obstacle_clearance

    run = jax.jit(lambda world: jax.lax.scan(period, (world, shield.init(world)), None, length=2000)[1])
    least = float(np.min(run(begin)))
    assert 0.0 < least <= 2.0 * TOUCH


def _chase(scenario, shield, pursuer, worlds, periods, announced):
    """Least clearance, share of corrected periods and mean correction of evaders that want to sit still."""

    def period(carry, _):
        world, memory = carry
        wheels = pursue(scenario, pursuer, world, jax.random.key(0))
        seen = eqx.tree_at(lambda w: w.wheel_speeds, world, wheels) if announced else world
        result, memory = shield(seen, jnp.zeros(2), memory)
        world, events = scenario.step(world, result.action, wheels)
        return (world, memory), (events.pursuer_clearance, result.intervention, result.status)

    run = jax.vmap(lambda world: jax.lax.scan(period, (world, shield.init(world)), None, length=periods)[1])
    return tuple(np.asarray(leaf) for leaf in jax.jit(run)(worlds))


@pytest.mark.parametrize("name", ["nash", pytest.param("turn-while-driving", marks=pytest.mark.slow)])
def test_a_shield_told_the_coming_wheel_speeds_keeps_clear_and_interferes_less(name):
    scenario, pursuer = load_scenario("paper", obstacle_count=0), make_pursuer(name)
    worlds = jax.vmap(scenario.reset)(jax.random.split(jax.random.key(3), 64))
    told = _chase(scenario, GameShield(scenario, known_velocity=True), pursuer, worlds, 600, True)
    untold = _chase(scenario, GameShield(scenario), pursuer, worlds, 600, False)
    assert told[0].min() > -1e-5
    assert untold[0].min() > 0.0
    assert told[1].mean() < untold[1].mean()
    assert told[2].max() <= Status.INFEASIBLE


def test_known_wheel_speeds_that_are_not_finite_fall_back_on_the_worst_case():
    scenario = load_scenario("paper")
    world = scenario.reset(jax.random.key(0))
    broken = eqx.tree_at(lambda w: w.wheel_speeds, world, jnp.full((1, 2), jnp.nan))
    result, memory = _asked(GameShield(scenario, known_velocity=True), broken, jnp.array([0.1, -0.1]))
    assert result.barriers.shape == (2,)
    assert int(result.status) in (Status.OK, Status.CORRECTED)
    rows = PursuitBarrier().rows(scenario, world, memory)
    assert np.all(rows.normals @ result.action >= rows.offsets - 1e-6)


@pytest.mark.slow
def test_a_known_pursuer_that_is_nowhere_is_invalid_and_the_rest_is_kept():
    scenario = load_scenario("paper", pursuer_count=2, obstacle_count=1)
    world = scenario.reset(jax.random.key(1))
    lost = eqx.tree_at(lambda w: w.pursuers, world, world.pursuers.at[1, 0].set(jnp.nan))
    result, _ = _asked(GameShield(scenario, known_velocity=True), lost, jnp.array([0.1, 0.0]))
    assert int(result.status) == Status.INVALID
    assert np.all(np.isfinite(result.action))
    np.testing.assert_array_equal(np.isinf(result.barriers), [False, True, False])
