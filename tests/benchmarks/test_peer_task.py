"""The benchmark's peer: does it learn the same task as ours, so that the comparison means something?"""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from sidestep.pursuit import make_pursuer
from sidestep.world import World, load_scenario, observe, scenario_to_dict, to_velocity
from speed.peer_task import PeerTask


@eqx.filter_jit
def our_period(scenario, world, velocity):
    pursuer = make_pursuer("turn-then-drive")
    moved, events = scenario.step(world, velocity, pursuer(scenario, world, jax.random.key(0)))
    return moved, events, observe(scenario, moved)


@pytest.mark.slow
def test_peer_moves_sees_and_scores_as_we_do(x64):
    scenario = load_scenario("paper")
    constants = scenario_to_dict(scenario)
    constants.update(evader_speed=0.1574, pursuer_speed=0.2)
    scenario = load_scenario("paper", **constants)
    task = PeerTask(constants, hold=1, seed=3)
    random = np.random.default_rng(5)
    aim = eqx.filter_jit(to_velocity)
    ends = set()
    for _ in range(25):
        task.reset()
        world = World(
            jnp.array(task.evader), jnp.array([task.pursuer]),
            jnp.array([[*task.obstacle, 0.02, 0.0]]), jnp.array(task.target),
        )  # fmt: skip
        assert bool(scenario.accepts(world))
        np.testing.assert_allclose(task.observe(), observe(scenario, world), atol=1e-6)
        for _ in range(150):
            # Mostly toward the target, so that episodes end in every way.
            action = np.clip(np.array([0.8, 0.0]) + random.normal(0, 0.6, 2), -1, 1)
            world, events, seen = our_period(scenario, world, aim(scenario, world, jnp.asarray(action)))
            observation, reward, terminated, truncated = task.act(action)
            np.testing.assert_allclose(observation, seen, atol=1e-6)
            np.testing.assert_allclose(reward, events.reward, rtol=1e-9)
            assert terminated == bool(events.terminated)
            assert not truncated
            if terminated:
                ends.add(
                    ("captured", "collided", "reached")[
                        np.argmax([events.captured, events.collided, events.reached])
                    ]
                )
                break
    assert ends == {"captured", "collided", "reached"}


def test_peer_ends_at_the_time_limit():
    constants = {**scenario_to_dict(load_scenario("paper", obstacle_count=0)), "episode_steps": 7}
    task = PeerTask(constants, hold=5)
    task.place((0.0, 0.0), (50.0, 0.0, 0.0), None, (1.0, 1.0))
    assert task.act((0.0, 0.0))[2:] == (False, False)
    observation, reward, terminated, truncated = task.act((0.0, 0.0))
    assert (terminated, truncated) == (False, True)
    assert observation.shape == (task.observation_size,)
    np.testing.assert_allclose(reward, -2 * 0.01 * np.sqrt(2.0))
