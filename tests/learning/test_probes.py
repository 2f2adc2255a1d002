"""Hazard: a learner that runs but learns the wrong thing. Tiny worlds whose values are known exactly.

Each probe rules out one cause: no value learned at all, observations ignored, discount or bootstrap
wrong, actions ignored, the actor not following its critic, time limits taken for ends.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from sidestep._arrays import real
from sidestep.learning.td3 import TD3, Batch, update

ROWS, UPDATES, DISCOUNT = 64, 1200, 0.8


@eqx.filter_jit
def learn(batch):
    """A learner after many updates on a batch that holds everything there is to know."""
    algorithm = TD3(
        actor_learning_rate=3e-3,
        critic_learning_rate=3e-3,
        discount=DISCOUNT,
        target_rate=0.1,
        hidden=(24, 24),
    )

    def body(learner, key):
        return update(algorithm, learner, batch, key)

    learner = algorithm.init(1, 1, jax.random.key(0))
    return jax.lax.scan(body, learner, jax.random.split(jax.random.key(1), UPDATES))[0]


def world(observation, reward, *, following=None, terminated=1.0):
    """A batch over all observations, with actions spread evenly; rewards may depend on both."""
    observations = np.resize(observation, ROWS).astype(float)
    actions = np.repeat(np.linspace(-1.0, 1.0, ROWS // 2), 2)
    rewards = reward(observations, actions)
    beyond = observations if following is None else np.resize(following, ROWS)
    ends = np.resize(terminated, ROWS).astype(float)
    return Batch(
        observation=real(observations[:, None]),
        action=real(actions[:, None]),
        reward=real(rewards * np.ones(ROWS)),
        next_observation=real(beyond[:, None]),
        terminated=real(ends),
    )


def values(learner, observation, action):
    """Q1 and Q2 at one observation and action."""
    return np.array(learner.critic(real([[observation]]), real([[action]])))[:, 0]


def action(learner, observation):
    return float(learner.actor(real([[observation]]))[0, 0])


def test_constant_reward_is_its_own_value():
    learner = learn(world([0.0], lambda o, a: 1.0))
    for a in (-1.0, 0.0, 1.0):
        assert values(learner, 0.0, a) == pytest.approx([1.0, 1.0], abs=0.05)


def test_value_depends_on_the_observation():
    learner = learn(world([-1.0, 1.0], lambda o, a: o))
    for observation in (-1.0, 1.0):
        assert values(learner, observation, 0.3) == pytest.approx([observation] * 2, abs=0.05)


def test_reward_one_step_later_is_discounted_once():
    learner = learn(world([0.0, 1.0], lambda o, a: o, following=[1.0, 0.0], terminated=[0.0, 1.0]))
    assert values(learner, 1.0, 0.0) == pytest.approx([1.0, 1.0], abs=0.05)
    assert values(learner, 0.0, 0.0) == pytest.approx([DISCOUNT, DISCOUNT], abs=0.05)


def test_actor_finds_the_best_action():
    learner = learn(world([0.0], lambda o, a: -((a - 0.5) ** 2)))
    assert action(learner, 0.0) == pytest.approx(0.5, abs=0.1)
    assert values(learner, 0.0, 0.5) == pytest.approx([0.0, 0.0], abs=0.05)
    assert values(learner, 0.0, -0.5) == pytest.approx([-1.0, -1.0], abs=0.1)


def test_actor_finds_the_best_action_for_each_observation():
    learner = learn(world([-1.0, 1.0], lambda o, a: -((a - 0.5 * o) ** 2)))
    for observation in (-1.0, 1.0):
        assert action(learner, observation) == pytest.approx(0.5 * observation, abs=0.1)
        best, worst = (
            values(learner, observation, 0.5 * observation),
            values(learner, observation, -0.5 * observation),
        )
        assert best == pytest.approx([0.0, 0.0], abs=0.05)
        assert worst == pytest.approx([-1.0, -1.0], abs=0.1)


def test_time_limits_do_not_end_the_value_but_ends_do():
    forever = learn(world([0.0], lambda o, a: 1.0, terminated=0.0))
    assert values(forever, 0.0, 0.0) == pytest.approx([1.0 / (1.0 - DISCOUNT)] * 2, rel=0.05)
    # The same seen through an end in every fourth step is worth r + discount * 3/4 of itself.
    ended = learn(world([0.0], lambda o, a: 1.0, terminated=[0.0, 0.0, 0.0, 1.0]))
    assert np.mean(values(ended, 0.0, 0.0)) == pytest.approx(1.0 / (1.0 - 0.75 * DISCOUNT), rel=0.15)
    assert jnp.max(values(ended, 0.0, 0.0)) < 0.7 / (1.0 - DISCOUNT)
