"""Hazard: an evader that waits for ever behind an obstacle, or hits it because it no longer waits."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from sidestep.safety import GameShield, Status, filter_in_lanes, make_shield, tolerance
from sidestep.world import World, load_scenario

SECONDS = 30.0
FAR = (40.0, 0.0, 0.0)
AWAY = (0.0, -30.0, 0.0, 0.0)
"""An obstacle that is nowhere near."""


def scene(y=0.0, *obstacles, evader=(2.2, 0.0), target=(1.0, 0.0), pursuer=FAR):
    """The evader at `evader` moved aside by `y`, at most two obstacles between it and the target."""
    obstacles = [*(obstacles or [(1.6, 0.0, 0.0, 0.0)]), AWAY][:2]
    place = (evader[0], evader[1] + y)
    return World(
        *(jnp.asarray(part, float) for part in (place, [pursuer], obstacles, target)),
    )


SCENES = {
    "exactly behind": scene(),
    "behind, a millionth of a metre left": scene(1e-6),
    "behind, a millionth of a metre right": scene(-1e-6),
    "behind, a millimetre left": scene(1e-3),
    "behind, a millimetre right": scene(-1e-3),
    "behind one that drifts away": scene(0.0, (1.6, 0.0, -0.02, 0.0)),
    "behind one that drifts at it": scene(0.0, (1.6, 0.0, 0.02, 0.0)),
    "the paper's test scene": scene(
        0.0, (1.5, 0.0, 0.02, 0.0), evader=(0.0, 0.0), target=(2.5, 0.0), pursuer=(1.0, -0.5, 0.0)
    ),
    "before a gap too narrow": scene(0.0, (1.6, 0.15, 0.0, 0.0), (1.6, -0.15, 0.0, 0.0)),
    "before a narrow gap of two that drift": scene(0.0, (1.6, 0.1, 0.02, 0.0), (1.6, -0.1, 0.02, 0.0)),
    "before a narrow gap, off its middle": scene(0.05, (1.6, 0.15, 0.0, 0.0), (1.6, -0.12, 0.0, 0.0)),
    "behind two in a row": scene(0.0, (1.7, 0.0, 0.0, 0.0), (1.35, 0.0, 0.0, 0.0)),
    "with a pursuer beside it": scene(pursuer=(1.9, 0.75, 0.0)),
}


@pytest.fixture(scope="module")
def scenario():
    return load_scenario("paper", obstacle_count=2)


def chase(shield, worlds):
    """Straight for the target, all pursuers standing still: places (m), least clearance (m), turns,
    whether the target was reached, and the periods that it took."""
    scenario = shield.scenario

    def period(carry, _):
        world, memory, over = carry
        x, y = world.target[0] - world.evader[0], world.target[1] - world.evader[1]
        speed = scenario.evader_speed / jnp.maximum(jnp.hypot(x, y), 1e-9)
        result, after = filter_in_lanes(shield, world, jnp.stack([speed * x, speed * y]), memory)
        moved, events = scenario.step(world, result.action, jnp.zeros((1, 2, len(over))))
        moved, after = jax.tree.map(
            lambda new, old: jnp.where(over, old, new), (moved, after), (world, memory)
        )
        ended = over | events.reached | events.collided | events.captured
        least = jnp.where(over, jnp.inf, events.obstacle_clearance)
        return (moved, after, ended), (moved.evader, least, after.turn, events.reached & ~over, ~over)

    begin = worlds, shield.init(worlds), jnp.zeros(worlds.evader.shape[1:], bool)
    steps = round(SECONDS / 0.05)
    _, (places, least, turns, reached, driving) = jax.lax.scan(period, begin, None, length=steps)
    return places, jnp.min(least, axis=0), turns, jnp.any(reached, axis=0), jnp.sum(driving, axis=0)


@pytest.fixture(scope="module")
def driven(scenario):
    worlds = jax.tree.map(lambda *leaves: jnp.stack(leaves, axis=-1), *SCENES.values())
    told = eqx.filter_jit(chase)(make_shield("game", scenario), worlds)
    return [dict(zip(SCENES, np.moveaxis(np.asarray(part), -1, 0), strict=True)) for part in told]


def test_nobody_waits_behind_an_obstacle_and_nobody_hits_one(driven):
    _, least, _, reached, periods = driven
    assert {name for name in SCENES if not reached[name]} == set()
    assert {name: value for name, value in least.items() if value < 0.0} == {}
    # 7.3 s is the way through the obstacle.
    assert {name: value for name, value in periods.items() if 0.05 * value > 22.0} == {}


def test_sides_of_an_obstacle_are_mirror_images_and_the_middle_is_no_slower(driven):
    places, _, turns, _, periods = driven
    for how_far in ("a millionth of a metre", "a millimetre"):
        left, right = (f"behind, {how_far} {side}" for side in ("left", "right"))
        np.testing.assert_allclose(places[left] * [1.0, -1.0], places[right], atol=1e-5)
        np.testing.assert_array_equal(turns[left], -turns[right])
        assert abs(periods["exactly behind"] - periods[left]) <= 10
    assert set(np.unique(turns["exactly behind"])) == {0.0, 1.0}


def test_exact_middle_is_left_in_double_precision_too(x64):
    scenario = load_scenario("paper", obstacle_count=2)
    worlds = jax.tree.map(lambda leaf: jnp.asarray(leaf, float)[..., None], scene())
    _, least, _, reached, periods = eqx.filter_jit(chase)(make_shield("game", scenario), worlds)
    assert bool(reached[0])
    assert float(least[0]) > 0.0
    assert 0.05 * int(periods[0]) < 13.0


@pytest.fixture(scope="module")
def crowd(scenario):
    """Random worlds in which rows are active, often several; nominal actions up to beyond the speed limit."""
    keys = jax.random.split(jax.random.key(5), 4)
    n = 4000
    worlds = jax.vmap(scenario.reset)(jax.random.split(keys[0], n))
    closer = lambda group: group.at[..., :2].multiply(0.3)  # noqa: E731
    worlds = eqx.tree_at(
        lambda w: (w.evader, w.pursuers, w.obstacles),
        worlds,
        (0.3 * worlds.evader, closer(worlds.pursuers), closer(worlds.obstacles)),
    )
    nominal = 0.15 * jax.random.normal(keys[1], (n, 2), dtype=float)
    return worlds, nominal


@pytest.mark.slow
def test_going_round_violates_no_row_that_can_be_kept(scenario, crowd):
    worlds, nominal = crowd
    game, plain = make_shield("game", scenario), GameShield(scenario)
    sides, begun = jax.vmap(plain.init)(worlds), jax.vmap(game.init)(worlds)
    limit = float(scenario.evader_speed)
    allowed = tolerance(nominal.dtype) * limit
    ask = eqx.filter_jit(lambda shield, memory: jax.vmap(shield)(worlds, nominal, memory))
    expected, _ = ask(plain, sides)
    changed = 0
    for turn in (-1.0, 0.0, 1.0):
        memory = eqx.tree_at(lambda m: m.turn, begun, jnp.full_like(begun.turn, turn))
        result, after = ask(game, memory)
        infeasible = np.asarray(expected.status) == Status.INFEASIBLE
        np.testing.assert_array_equal(np.asarray(result.status) == Status.INFEASIBLE, infeasible)
        assert np.min(np.asarray(result.slack)[~infeasible]) >= -2.0 * allowed
        assert np.max(np.hypot(*np.asarray(result.action).T)) <= limit + allowed
        off = np.hypot(*np.asarray(result.action - nominal).T)
        np.testing.assert_allclose(result.intervention, off, atol=1e-6)
        assert np.all((np.asarray(result.status) > Status.OK) | (off < 1e-6))
        changed += np.sum(np.any(np.asarray(result.action != expected.action), axis=1))
        if turn == 0.0:
            # Nothing is stuck yet, so nothing is different.
            for one, other in zip(jax.tree.leaves(result), jax.tree.leaves(expected), strict=True):
                np.testing.assert_array_equal(one, other)
            stuck = np.asarray(after.turn) != 0.0
            towards = np.asarray(worlds.obstacles)[:, :, 2:] - np.asarray(result.action)[:, None]
            slow = np.min(np.hypot(towards[..., 0], towards[..., 1]), axis=1) < 0.05 * limit
            assert np.all(slow[stuck])
    assert changed > 100


def test_input_that_is_not_finite_ends_the_way_round(scenario):
    game, world = make_shield("game", scenario), SCENES["exactly behind"]
    memory = eqx.tree_at(lambda m: m.turn, game.init(world), jnp.asarray(1.0))
    for broken, nominal in (
        (world, [jnp.nan, 0.0]),
        (eqx.tree_at(lambda w: w.obstacles, world, world.obstacles.at[0, 0].set(jnp.nan)), [-0.1, 0.0]),
    ):
        result, after = eqx.filter_jit(game.__call__)(broken, jnp.asarray(nominal), memory)
        assert result.status == Status.INVALID
        assert np.all(np.isfinite(result.action))
        assert after.turn == 0.0


@pytest.mark.slow
def test_joint_goes_round_too():
    scenario = load_scenario("paper")
    joint = make_shield("joint", scenario)
    world = scene()
    world = eqx.tree_at(lambda w: w.obstacles, world, world.obstacles[:1])

    @eqx.filter_jit
    def period(world, memory):
        way = world.target - world.evader
        result, memory = joint(world, scenario.evader_speed * way / jnp.linalg.norm(way), memory)
        moved, events = scenario.step(world, result.action, jnp.zeros((1, 2)))
        return moved, memory, events

    memory, periods = joint.init(world), 0
    while periods < 300:
        world, memory, events = period(world, memory)
        periods += 1
        assert not bool(events.collided)
        if bool(events.reached):
            break
    assert periods * 0.05 < 13.0
