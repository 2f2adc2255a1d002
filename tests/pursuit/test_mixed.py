"""Hazards of a pursuer that changes: draws that flicker, that all episodes share, that are not as asked."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from sidestep._arrays import real
from sidestep.pursuit import PURSUERS, make_pursuer
from sidestep.pursuit.mixed import Mixed
from sidestep.pursuit.pursuers import Pursuer, Random, TurnThenDrive
from sidestep.world import World, load_scenario

SCENARIO = load_scenario("paper")
KEY = jax.random.key(0)


class Constant(Pursuer):
    """Drives at the same wheel speeds always, so that a test sees what was drawn."""

    wheels: tuple[float, float]
    takes_lanes = True

    def steer(self, scenario, world, key):
        return jnp.stack([jnp.full_like(world.pursuer[0], wheel) for wheel in self.wheels])


def worlds(targets, times, wheels):
    """Worlds in lanes that differ in target and time only."""
    one = World(jnp.zeros(2), jnp.zeros((1, 3)), jnp.zeros((0, 4)), jnp.zeros(2), wheel_speeds=real([wheels]))

    def place(target, time):
        return eqx.tree_at(lambda world: (world.target, world.time), one, (target, time))

    made = jax.vmap(place)(real(targets), real(times))
    return jax.tree.map(lambda leaf: jnp.moveaxis(leaf, 0, -1), made)


def drawn(mixed, targets, times, wheels=(0.0, 0.0)):
    """The wheel speeds (lanes, 2) of a mixture in such worlds."""
    return np.asarray(mixed(SCENARIO, worlds(targets, times, wheels), KEY)).T


def plain(count, **changes):
    """A mixture of `count` constant strategies, number i at a wheel speed of 0.02 (i + 1) m/s."""
    strategies = tuple(Constant(wheels=(0.02 * (i + 1), 0.02 * (i + 1))) for i in range(count))
    return Mixed(strategies, **{"least_effort": 1.0, "least_agility": 1.0, **changes})


def test_every_strategy_gets_its_share_over_episodes():
    targets = np.random.default_rng(0).uniform(-1.5, 1.5, (4000, 2))
    speeds = drawn(plain(4), targets, np.full(4000, 1.0))[:, 0]
    counts = np.bincount(np.round(speeds / 0.02).astype(int), minlength=5)[1:]
    assert np.all(np.abs(counts - 1000) < 4 * np.sqrt(4000 * 0.25 * 0.75))


def test_strategy_lasts_for_a_stretch_and_then_changes():
    times = np.arange(0.0, 160.0, 0.05)
    speeds = drawn(plain(5, hold=8.0), np.tile([[0.3, -0.7]], (len(times), 1)), times)[:, 0]
    changes = times[1:][np.diff(speeds) != 0.0]
    # Neighbouring stretches may draw the same strategy.
    assert 8 <= len(changes) <= 20
    assert np.allclose(np.diff(changes) % 8.0 % 7.95, 0.0, atol=0.051)


def test_draws_are_those_of_the_episode():
    times = np.linspace(0.0, 100.0, 300)
    same = [drawn(make_pursuer("mixed"), np.tile([target], (300, 1)), times) for target in ([1.0, 0.2],) * 2]
    other = drawn(make_pursuer("mixed"), np.tile([[1.0, 0.2000001]], (300, 1)), times)
    assert np.array_equal(*same)
    assert not np.array_equal(same[0], other)


def test_effort_and_agility_are_what_was_asked_for():
    targets = np.random.default_rng(1).uniform(-1.5, 1.5, (4000, 2))
    one = (Constant(wheels=(0.2, 0.2)),)
    efforts = (
        drawn(Mixed(one, full=0.5, least_effort=0.5, least_agility=1.0), targets, np.zeros(4000))[:, 0] / 0.2
    )
    assert efforts.min() >= 0.5 - 1e-6
    assert np.mean(efforts > 1.0 - 1e-6) == pytest.approx(0.5, abs=0.04)
    assert np.mean(efforts < 0.75) == pytest.approx(0.25, abs=0.04)
    # From -V: what is left of the old wheel speeds shows the agility.
    moved = drawn(
        Mixed(one, full=0.5, least_effort=1.0, least_agility=0.2), targets, np.zeros(4000), (-0.2, -0.2)
    )
    agilities = (moved[:, 0] + 0.2) / 0.4
    assert agilities.min() >= 0.2 - 1e-6
    assert np.mean(agilities > 1.0 - 1e-6) == pytest.approx(0.5, abs=0.04)


def test_one_strategy_at_full_effort_is_that_strategy():
    world = SCENARIO.reset(jax.random.key(4))
    mixed = Mixed((TurnThenDrive(),), least_effort=1.0, least_agility=1.0)
    assert np.array_equal(mixed(SCENARIO, world, KEY), TurnThenDrive()(SCENARIO, world, KEY))


def test_erratic_part_draws_each_wheel_uniformly_and_anew_in_every_period():
    mixed = make_pursuer("mixed")
    assert len(mixed.strategies) == len(PURSUERS)
    times = 0.05 * np.arange(4000)
    one = Mixed((mixed.strategies[list(PURSUERS).index("random")],))
    shares = drawn(one, np.tile([[0.3, -0.7]], (4000, 1)), times) / float(SCENARIO.pursuer_speed)
    assert np.all(np.abs(shares) <= 1.0)
    # A uniform variable on [-1, 1] has the variance 1/3; four standard errors.
    assert np.abs(shares.mean(axis=0)).max() < 4 * np.sqrt(1 / 3 / 4000)
    assert np.allclose(shares.var(axis=0), 1 / 3, atol=4 * np.sqrt(4 / 45 / 4000))
    for first, second in ((shares[:, 0], shares[:, 1]), (shares[1:, 0], shares[:-1, 0])):
        assert abs(np.corrcoef(first, second)[0, 1]) < 4 / np.sqrt(4000)


def test_strategy_that_needs_a_key_of_its_own_is_refused():
    with pytest.raises(ValueError, match="takes_lanes"):
        Mixed((Random(),))(SCENARIO, SCENARIO.reset(KEY), KEY)
