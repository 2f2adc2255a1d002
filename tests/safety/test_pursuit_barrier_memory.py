"""Which side of the pursuer's axis to follow: kept while that is safe, and never changed for the worse."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from sidestep.pursuit import CaptureGame, make_pursuer
from sidestep.safety import PursuitBarrier, make_shield
from sidestep.world import World, load_scenario
from sidestep.world.capture_geometry import to_pursuer_frame

BARRIER = PursuitBarrier()
SMALL = {"evader_speed": 0.18, "pursuer_speed": 0.22, "pursuer_half_axle": 0.08, "capture_distance": 0.09}
every_set = pytest.mark.parametrize(
    "parameters", [{}, {"capture_distance": 0.15}, SMALL], ids=["paper", "roomy", "small wheelbase"]
)


def _overlap(scenario):
    """m cos S, m = b rho - l tan S: how far across the axis a side's row stays feasible at h = 0 (m)."""
    game = CaptureGame.of(scenario)
    ratio = scenario.evader_speed / scenario.pursuer_speed
    margin = game.half_axle * ratio - game.capture_distance * jnp.tan(game.usable_angle)
    return float(margin * jnp.cos(game.usable_angle))


def _near_the_axis(scenario, count=20_000, seed=0):
    """Points ahead and behind, within a few overlaps of the axis and from the tip of the capture set on."""
    rng = np.random.default_rng(seed)
    tip = float(scenario.capture_distance / jnp.cos(scenario.usable_angle))
    ahead = tip * (1.0 + 10.0 ** rng.uniform(-6.0, 0.3, count)) * rng.choice([-1.0, 1.0], count)
    spread = 10.0 ** rng.uniform(-3.0, 1.5, count) * _overlap(scenario)
    return jnp.asarray(np.stack([ahead, spread * rng.choice([-1.0, 1.0], count)], axis=-1))


@eqx.filter_jit
def _recall(scenario, points, sides):
    """Side kept or taken; value of the side before, of the side now and of the evader's own; offset now."""

    @jax.vmap
    def one(z, side):
        pose = jnp.zeros(3)
        now = BARRIER.update_memory(scenario, z, pose, side)
        own = BARRIER.update_memory(scenario, z, pose, None)
        values = [BARRIER.value(scenario, z, pose, s) for s in (side, now, own)]
        return now, own, *values, BARRIER.row(scenario, z, pose, now)[2]

    return one(points, sides)


@every_set
@pytest.mark.parametrize("gain", [0.0, 1.2, 20.0])
def test_a_kept_side_is_safe_and_a_change_never_lowers_the_value(x64, parameters, gain):
    scenario = load_scenario("paper", pursuer_gain=gain, **parameters)
    points = _near_the_axis(scenario)
    before = np.random.default_rng(1).choice([-1.0, 1.0], len(points))
    answers = _recall(scenario, points, jnp.asarray(before))
    now, own, value_before, value, own_value, offset = (np.asarray(answer) for answer in answers)
    free, changed, across = own_value >= 0.0, now != before, now != own
    assert free.mean() > 0.5
    assert changed.mean() > 0.05
    assert (across & free).mean() > 0.01
    # Only ever changed for the evader's own side, which gains 2 |y| sin S in front.
    assert np.all(now[changed] == own[changed])
    ahead, aside = np.abs(np.asarray(points)).T
    usable = float(scenario.usable_angle)
    in_front = aside * np.cos(usable) < ahead * np.sin(usable)
    gained = np.where(in_front, 2.0 * aside * np.sin(usable), 0.0)
    np.testing.assert_allclose((value - value_before)[changed], gained[changed], atol=1e-12)
    assert np.all(value[free] >= 0.0)
    assert np.all(offset[free] <= scenario.evader_speed + 1e-12)


@every_set
def test_an_evader_that_zigzags_over_the_axis_keeps_its_side(x64, parameters):
    """Within half the overlap no crossing changes the side, and the first step beyond it changes it once."""
    scenario = load_scenario("paper", pursuer_gain=0.0, **parameters)
    width = 0.5 * _overlap(scenario)
    tip = float((scenario.capture_distance + 1e-9) / jnp.cos(scenario.usable_angle))
    zigzag = 0.98 * width * (-1.0) ** np.arange(200)
    track = np.concatenate([zigzag, [-1.1 * width], zigzag])
    # On the line through the tip: as far ahead as the side followed needs it to be outside the capture set.
    ahead = tip + np.abs(track) * np.tan(float(scenario.usable_angle))
    points = jnp.asarray(np.stack([ahead, track], axis=-1))

    @jax.jit
    def follow(points):
        def step(side, z):
            side = BARRIER.update_memory(scenario, z, jnp.zeros(3), side)
            return side, side

        return jax.lax.scan(step, jnp.ones(()), points)[1]

    sides = np.asarray(follow(points))
    assert np.all(sides[:200] == 1.0)
    assert np.all(sides[200:] == -1.0)


@eqx.filter_jit
def _run_along_the_axis(scenario, shield, pursuer, world, forgetful):
    """Side followed and clearance of each period while the evader zigzags along the pursuer's axis."""

    def step(carry, key):
        world, memory = carry
        left = to_pursuer_frame(world.evader, world.pursuer)[1]
        bearing = world.pursuer[2] - jnp.where(left < 0.0, -0.7, 0.7)
        wish = scenario.evader_speed * jnp.stack([jnp.cos(bearing), jnp.sin(bearing)])
        memory = jnp.where(forgetful, shield.init(world), memory)
        result, memory = shield(world, wish, memory)
        moved, events = scenario.step(world, result.action, pursuer(scenario, world, key))
        return (moved, memory), (memory[0], events.pursuer_clearance)

    keys = jax.random.split(jax.random.key(0), 1200)
    return jax.lax.scan(step, (world, shield.init(world)), keys)[1]


def test_no_chattering_in_front_of_a_pursuer():
    scenario = load_scenario("paper", obstacle_count=0)
    shield, chaser = make_shield("game", scenario), make_pursuer("nash")
    world = World(jnp.array([0.8, 1e-4]), jnp.zeros((1, 3)), jnp.zeros((0, 4)), jnp.array([9.0, 0.0]))
    changes, clearances = [], []
    for forgetful in (False, True):
        sides, clearance = _run_along_the_axis(scenario, shield, chaser, world, jnp.asarray(forgetful))
        changes.append(int(np.sum(np.diff(np.asarray(sides)) != 0.0)))
        clearances.append(float(jnp.min(clearance)))
    assert changes[0] <= 2
    # Without memory the same run changes sides at nearly every crossing until the pursuer is there.
    assert changes[1] > 100
    assert min(clearances) > 0.0
