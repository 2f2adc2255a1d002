"""Hazards of other people's policies: NumPy code under tracing, random numbers drawn once, hidden state."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from sidestep.loop import as_policy, rollout
from sidestep.loop.policies import HostPolicy
from sidestep.loop.step import decide
from sidestep.world import goal_seeking, load_scenario, observation_size


@pytest.fixture(scope="module")
def scenario():
    return load_scenario("paper", episode_steps=40)


def numpy_goal_seeking(observation):
    assert isinstance(observation, np.ndarray)
    observation[0] = 0.0  # a policy may scribble on what it is given
    return np.array([1.0, 0.0]) if observation.sum() < 1e9 else None


def test_numpy_policy_acts_like_its_jax_twin(scenario):
    ours = rollout(scenario, goal_seeking, "none", "still", 0)
    theirs = rollout(scenario, numpy_goal_seeking, "none", "still", 0)
    assert ours.length == theirs.length
    assert np.allclose(ours.worlds.evader, theirs.worlds.evader)


def test_policy_with_python_branches_runs(scenario):
    def cautious(observation):
        return [0.0, 1.0] if observation[4] > 0.5 else [1.0, 0.0]

    assert isinstance(as_policy(cautious, scenario), HostPolicy)


def test_numpy_random_numbers_are_drawn_anew_each_time(scenario):
    generator = np.random.default_rng(0)
    trajectory = rollout(scenario, lambda observation: generator.uniform(-1, 1, 2), "none", "still", 0)
    assert len(np.unique(np.asarray(trajectory.nominal), axis=0)) > 30


def test_jax_policy_stays_on_the_device(scenario):
    assert as_policy(goal_seeking, scenario) is goal_seeking
    policy = lambda observation: jnp.tanh(observation[:2])  # noqa: E731
    assert as_policy(policy, scenario) is policy


def test_host_policy_keeps_its_decision_interval(scenario):
    class Slow:
        decision_steps = 5

        def __call__(self, observation):
            return np.array([float(observation[0]), 0.5])

    policy = as_policy(Slow(), scenario)
    assert isinstance(policy, HostPolicy)
    assert policy.decision_steps == 5


def test_host_policy_works_in_batches(scenario):
    policy = as_policy(lambda observation: np.asarray(observation)[:2] * 2, scenario)
    observations = jnp.arange(3.0 * observation_size(scenario)).reshape(3, -1)
    assert np.allclose(jax.jit(jax.vmap(policy))(observations), observations[:, :2] * 2)
    assert np.allclose(policy(observations[0]), observations[0, :2] * 2)


def test_what_the_policy_raises_reaches_its_author(scenario):
    def broken(observation):
        raise RuntimeError("weights not loaded")

    with pytest.raises(RuntimeError, match="weights not loaded"):
        as_policy(broken, scenario)


@pytest.mark.parametrize("answer", [None, "left", np.array(["a", "b"]), np.array([1j, 0])])
def test_answers_that_are_no_two_numbers_are_refused(scenario, answer):
    with pytest.raises(ValueError, match="policy must answer"):
        as_policy(lambda observation: answer, scenario)


@pytest.mark.parametrize("answer", [(3,), (1, 2), ()])
def test_answers_of_the_wrong_shape_are_refused(scenario, answer):
    with pytest.raises(ValueError, match=r"shape \(2,\)"):
        as_policy(lambda observation: jnp.zeros(answer) + observation[0], scenario)
    with pytest.raises(ValueError, match=r"shape \(2,\)"):
        as_policy(lambda observation: np.zeros(answer), scenario)


def test_what_cannot_be_called_is_refused(scenario):
    with pytest.raises(TypeError, match="callable"):
        as_policy(42, scenario)


@pytest.mark.parametrize("steps", [0, -3, 1.5, True])
def test_impossible_decision_interval_is_refused(scenario, steps):
    class Odd:
        decision_steps = steps

        def __call__(self, observation):
            return observation[:2]

    with pytest.raises(ValueError, match="decision_steps"):
        as_policy(Odd(), scenario)


@pytest.mark.parametrize("frame", ["target", "world"])
def test_goal_seeking_follows_the_frame(frame):
    scenario = load_scenario("paper", frame=frame)
    world = scenario.reset(jax.random.key(3))
    velocity = decide(scenario, as_policy("goal-seeking", scenario), world)
    towards = (world.target - world.evader) / jnp.linalg.norm(world.target - world.evader)
    assert np.allclose(velocity, 0.1574 * towards, atol=1e-6)
