"""Many worlds in lanes go the way that each goes alone."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from sidestep._arrays import no_fuse
from sidestep.loop.step import control_step, decide
from sidestep.pursuit import as_pursuer
from sidestep.safety import make_shield, start_in_lanes
from sidestep.world import goal_seeking, load_scenario

WORLDS, PERIODS = 24, 40


def numpy_pursuer(scenario, world, key):
    """Knows nothing of lanes, nor of JAX."""
    return np.array([0.1, 0.05], np.float32) * float(world.evader[0] > 0.0)


@pytest.mark.parametrize(
    "shield, name", [("game", "nash"), pytest.param("paper", "numpy", marks=pytest.mark.slow)]
)
def test_worlds_in_lanes_do_what_each_does_alone(shield, name):
    scenario = load_scenario("paper", obstacle_count=2, pursuer_count=1 if name == "nash" else 2)
    guard = make_shield(shield, scenario)
    pursuer = as_pursuer(numpy_pursuer if name == "numpy" else name)
    keys = jax.random.split(jax.random.key(3), WORLDS)
    worlds = jax.vmap(scenario.reset)(keys)

    def chase(world, memory, key):
        def period(carry, _):
            world, memory = carry
            nominal = decide(scenario, goal_seeking, world)
            world, memory, events, result, wheels = control_step(
                scenario, guard, pursuer, world, memory, nominal, key
            )
            return (world, memory), (world, events, result, wheels)

        return jax.lax.scan(period, (world, memory), None, length=PERIODS)[1]

    alone = jax.jit(jax.vmap(chase, out_axes=-1))(worlds, jax.vmap(guard.init)(worlds), keys)
    lanes = jax.tree.map(lambda leaf: jnp.moveaxis(leaf, 0, -1), worlds)
    assert (worlds.evader[0].ndim, lanes.lanes) == (1, 1)
    together = jax.jit(chase)(lanes, start_in_lanes(guard, lanes), keys)
    for world, _, result, _ in (alone, together):
        # What the shield lets through is what is driven, at the speed limit too, however it is rounded.
        np.testing.assert_allclose(world.evader_velocity, result.action, atol=1e-6)
    for one, other in zip(jax.tree.leaves(alone), jax.tree.leaves(together), strict=True):
        one, other = np.asarray(one, float), np.asarray(other, float)
        # Two correct roundings may part at a change of sides; most worlds must agree to rounding all the way.
        agree = np.all(np.isclose(one, other, atol=2e-4, rtol=1e-3), axis=tuple(range(one.ndim - 1)))
        assert np.mean(agree) >= 0.9


def test_what_is_compiled_apart_is_compiled_once():
    traced = []

    def function(x):
        traced.append(x)
        return 2.0 * x

    for _ in range(3):
        no_fuse(function, jnp.ones(5))
    assert len(traced) == 1


def test_compiling_apart_changes_nothing_but_the_program():
    def function(x, pair):
        return {"sum": x + pair[0] * jnp.where(x > 0.0, pair[1], 0.0)}

    x, pair = jnp.linspace(-1.0, 1.0, 9), (2.0, jnp.asarray(3.0))
    plain, separate = jax.jit(function), jax.jit(lambda x, pair: no_fuse(function, x, pair))
    np.testing.assert_array_equal(plain(x, pair)["sum"], separate(x, pair)["sum"])
    slope = jax.grad(lambda x: jnp.sum(no_fuse(function, x, pair)["sum"]))
    np.testing.assert_array_equal(slope(x), jnp.ones_like(x))
    np.testing.assert_array_equal(
        jax.vmap(lambda x: no_fuse(function, x, pair)["sum"])(x), plain(x, pair)["sum"]
    )
    assert " call(" in separate.lower(x, pair).compile().as_text()
