"""Hazard: a TD3 that is nearly TD3. Each update is compared with one written by hand in NumPy."""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from sidestep._arrays import real
from sidestep.learning.bounds import on_disc
from sidestep.learning.td3 import TD3, Batch, update

OBSERVATIONS, ACTIONS, ROWS, UPDATES = 3, 2, 12, 7


class Net:
    """A ReLU perceptron with its derivatives and Adam moments, in NumPy."""

    def __init__(self, perceptron):
        self.layers = [np.array(layer) for layer in layers_of(perceptron)]
        self.first = [np.zeros_like(x) for x in self.layers]
        self.second = [np.zeros_like(x) for x in self.layers]
        self.steps = 0

    def __call__(self, x):
        self.inputs = []
        for weight, bias in zip(self.layers[:-2:2], self.layers[1:-2:2], strict=True):
            self.inputs.append(x)
            x = np.maximum(x @ weight + bias, 0.0)
        self.inputs.append(x)
        return x @ self.layers[-2] + self.layers[-1]

    def backward(self, slope):
        """Gradients of the layers, and of the input, for the slope of a loss in the last output."""
        gradients = []
        for index in range(len(self.inputs) - 1, -1, -1):
            x = self.inputs[index]
            gradients = [x.T @ slope, slope.sum(0), *gradients]
            slope = slope @ self.layers[2 * index].T
            if index:
                slope = slope * (x > 0.0)
        return gradients, slope

    def adam(self, gradients, rate):
        self.steps += 1
        for i, g in enumerate(gradients):
            self.first[i] = 0.9 * self.first[i] + 0.1 * g
            self.second[i] = 0.999 * self.second[i] + 0.001 * g**2
            mean = self.first[i] / (1.0 - 0.9**self.steps)
            spread = np.sqrt(self.second[i] / (1.0 - 0.999**self.steps))
            self.layers[i] = self.layers[i] - rate * mean / (spread + 1e-8)

    def follow(self, other, rate):
        self.layers = [
            rate * new + (1.0 - rate) * old for old, new in zip(self.layers, other.layers, strict=True)
        ]


def disc(actions):
    length = np.linalg.norm(actions, axis=-1, keepdims=True)
    return np.where(length > 1.0, actions / np.maximum(length, 1e-9), actions)


def disc_slope(actions, slope):
    length = np.linalg.norm(actions, axis=-1, keepdims=True)
    unit = actions / length
    across = slope - unit * np.sum(unit * slope, axis=-1, keepdims=True)
    return np.where(length > 1.0, across / length, slope)


class Reference:
    """TD3 after the pseudocode of the paper and `TD3.py` of its authors."""

    def __init__(self, learner, algorithm, limit=None, bounded=False, target_scale=1.0):
        self.actor, self.target_actor = Net(learner.actor.body), Net(learner.target_actor.body)
        self.critics = [Net(learner.critic.first), Net(learner.critic.second)]
        self.target_critics = [Net(learner.target_critic.first), Net(learner.target_critic.second)]
        self.numbers = {
            f.name: float(getattr(algorithm, f.name))
            for f in dataclasses.fields(algorithm)
            if f.name != "hidden"
        }
        self.limit, self.bounded, self.target_scale = limit, bounded, target_scale
        self.count = 0

    def __call__(self, batch, noise):
        n = self.numbers
        self.count += 1
        noise = np.clip(n["target_noise"] * noise, -n["target_noise_clip"], n["target_noise_clip"])
        action = np.clip(np.tanh(self.target_actor(batch.next_observation)) + noise, -1.0, 1.0)
        if self.bounded:
            action = disc(action)
        joined = np.hstack([batch.next_observation, self.target_scale * action])
        lowest = np.minimum(*(critic(joined)[:, 0] for critic in self.target_critics))
        wanted = batch.reward + n["discount"] * (1.0 - batch.terminated) * lowest
        if self.limit is not None:
            wanted = np.minimum(wanted, self.limit)
        joined = np.hstack([batch.observation, batch.action])
        loss = 0.0
        for critic in self.critics:
            error = critic(joined)[:, 0] - wanted
            loss += np.mean(error**2)
            gradients, _ = critic.backward(2.0 * error[:, None] / len(error))
            critic.adam(gradients, n["critic_learning_rate"])
        if self.count % n["policy_delay"] == 0:
            action = np.tanh(self.actor(batch.observation))
            bounded = disc(action) if self.bounded else action
            first = self.critics[0]
            first(np.hstack([batch.observation, bounded]))
            _, slope = first.backward(np.full((len(action), 1), -1.0 / len(action)))
            slope = slope[:, OBSERVATIONS:]
            if self.bounded:
                slope = disc_slope(action, slope)
            gradients, _ = self.actor.backward(slope * (1.0 - action**2))
            self.actor.adam(gradients, n["actor_learning_rate"])
            self.target_actor.follow(self.actor, n["target_rate"])
            for target, critic in zip(self.target_critics, self.critics, strict=True):
                target.follow(critic, n["target_rate"])
        return loss

    def networks(self):
        return [self.actor, *self.critics, self.target_actor, *self.target_critics]


def networks_of(learner):
    bodies = (learner.actor.body, learner.critic.first, learner.critic.second)
    targets = (learner.target_actor.body, learner.target_critic.first, learner.target_critic.second)
    return [*bodies, *targets]


def random_batch(rng, terminated=None):
    def normal(*shape):
        return real(rng.normal(size=shape))

    ended = rng.random(ROWS) < 0.3 if terminated is None else np.full(ROWS, terminated)
    return Batch(
        observation=normal(ROWS, OBSERVATIONS),
        action=real(rng.uniform(-1, 1, (ROWS, ACTIONS))),
        reward=3.0 * normal(ROWS),
        next_observation=normal(ROWS, OBSERVATIONS),
        terminated=real(ended.astype(float)),
    )


def fresh_learner(algorithm, seed=0):
    """Targets differ from their networks and the actor is far from zero, so that mix-ups show."""
    learner = algorithm.init(OBSERVATIONS, ACTIONS, jax.random.key(seed))
    other = algorithm.init(OBSERVATIONS, ACTIONS, jax.random.key(seed + 1))
    return eqx.tree_at(lambda x: (x.target_actor, x.target_critic), learner, (other.actor, other.critic))


def as_numpy(batch):
    return jax.tree.map(np.asarray, batch)


SETTINGS = {
    "actor_learning_rate": 1e-3,
    "critic_learning_rate": 3e-3,
    "discount": 0.9,
    "target_rate": 0.05,
    "target_noise": 0.4,
    "target_noise_clip": 0.5,
    "hidden": (8, 6),
    "last_layer_scale": 3.0,
}


@eqx.filter_jit
def step(algorithm, learner, batch, key, limit=None, bounded=False, target_scale=1.0):
    more = {}
    if bounded:
        more = {"bound": on_disc, "target_bound": lambda actions, key: target_scale * on_disc(actions, key)}
    return update(algorithm, learner, batch, key, value_limit=limit, **more)


def noise_of(key):
    """The one thing that `update` and the reference must share: what the first of its keys draws."""
    return np.asarray(jax.random.normal(jax.random.split(key, 3)[0], (ROWS, ACTIONS), dtype=float))


def layers_of(perceptron):
    return [layer for pair in zip(perceptron.weights, perceptron.biases, strict=True) for layer in pair]


@pytest.mark.parametrize("case", ["plain", "every third, values cut", "disc, other bound on the target"])
def test_update_is_td3_number_for_number(x64, case):
    delay, limit = (3, 0.4) if case.startswith("every") else (2, None)
    bounds = (True, 0.5) if case.startswith("disc") else (False, 1.0)
    algorithm = TD3(**SETTINGS, policy_delay=delay)
    learner = fresh_learner(algorithm)
    reference = Reference(learner, algorithm, limit, *bounds)
    rng = np.random.default_rng(5)
    for index in range(UPDATES):
        batch, key = random_batch(rng), jax.random.key(index)
        learner, losses = step(
            algorithm, learner, batch, key, None if limit is None else real(limit), *bounds
        )
        loss = reference(as_numpy(batch), noise_of(key))
        assert np.isclose(losses.critic, loss, rtol=1e-10)
        for ours, theirs in zip(networks_of(learner), reference.networks(), strict=True):
            for layer, expected in zip(layers_of(ours), theirs.layers, strict=True):
                np.testing.assert_allclose(layer, expected, rtol=1e-9, atol=1e-12)


def test_update_in_single_precision_follows_the_same_path():
    algorithm = TD3(**SETTINGS)
    learner = fresh_learner(algorithm)
    reference = Reference(learner, algorithm)
    rng = np.random.default_rng(6)
    for index in range(UPDATES):
        batch, key = random_batch(rng), jax.random.key(index)
        learner, _ = step(algorithm, learner, batch, key)
        reference(as_numpy(batch), noise_of(key))
    for ours, theirs in zip(networks_of(learner), reference.networks(), strict=True):
        for layer, expected in zip(layers_of(ours), theirs.layers, strict=True):
            # Steps of Adam are as long as the learning rate, 1e-3 and 3e-3 here: a slip shows at that size.
            np.testing.assert_allclose(layer, expected, atol=2e-5)


def changed(before, after):
    same = jax.tree.map(lambda a, b: bool(jnp.all(a == b)), before, after)
    return not all(jax.tree.leaves(same))


def test_actor_and_all_targets_move_on_delayed_updates_only(x64):
    algorithm = TD3(**SETTINGS)
    learner = fresh_learner(algorithm)
    rng = np.random.default_rng(7)
    for index in range(1, 7):
        moved, losses = step(algorithm, learner, random_batch(rng), jax.random.key(index))
        due = index % 2 == 0
        assert changed(learner.critic, moved.critic)
        for part in ("actor", "target_actor", "target_critic", "actor_moments"):
            assert changed(getattr(learner, part), getattr(moved, part)) == due, (index, part)
        assert (float(losses.actor) != 0.0) == due
        assert int(moved.updates) == index
        learner = moved


def test_terminated_transitions_ignore_whatever_lies_beyond(x64):
    algorithm = TD3(**SETTINGS)
    learner, rng = fresh_learner(algorithm), np.random.default_rng(8)
    for terminated in (0.0, 1.0):
        batch = random_batch(rng, terminated)
        elsewhere = eqx.tree_at(lambda b: b.next_observation, batch, batch.next_observation + 1.0)
        key = jax.random.key(0)
        critics = [step(algorithm, learner, b, key)[0].critic for b in (batch, elsewhere)]
        assert changed(*critics) == (terminated == 0.0)


def test_reference_hyper_parameters_are_the_defaults():
    algorithm = TD3()
    for name, value in {
        "actor_learning_rate": 3e-4,
        "critic_learning_rate": 3e-4,
        "discount": 0.99,
        "target_rate": 0.005,
        "target_noise": 0.2,
        "target_noise_clip": 0.5,
        "policy_delay": 2,
    }.items():
        assert np.isclose(float(getattr(algorithm, name)), value), name
    assert algorithm.hidden == (256, 256)


def test_targets_start_equal_and_twins_start_apart(precision):
    learner = TD3(hidden=(8,)).init(OBSERVATIONS, ACTIONS, jax.random.key(0))
    assert not changed(learner.actor, learner.target_actor)
    assert not changed(learner.critic, learner.target_critic)
    assert changed(learner.critic.first, learner.critic.second)
    dtypes = {leaf.dtype for leaf in jax.tree.leaves(learner) if jnp.issubdtype(leaf.dtype, jnp.floating)}
    assert dtypes == {jnp.dtype("float64" if precision else "float32")}
