"""One small training, the same static sizes in all tests of this folder so that it compiles only once."""

import functools
from collections.abc import Iterator
from types import SimpleNamespace

import jax
import numpy as np
import pytest

CHUNK = 10
SCENARIO = {"episode_steps": 40, "arena_side": 2.0, "evader_speed": 0.3, "reach_distance": 0.1}
OPTIONS = {
    "hidden": [16, 16],
    "batch_size": 16,
    "warmup_decisions": 10,
    "decision_steps": 5,
    "replay_capacity": 64,
    # Pinned, so that another default changes no test but the one of the defaults.
    "updates_per_decision": 1,
    "discount": 0.99,
    "hindsight": 0.8,
    "mirror": 0.5,
    "exploration_noise": 0.1,
    "reward_scale": 0.01,
    "correction_penalty": 0.0,
    "time_cost": 0.0,
    "replay_action": "proposed",
    "filter_gradients": False,
    "bound_values": True,
    "last_layer_scale": 0.01,
}


@functools.cache
def _scenario(wide: bool, overrides: tuple):
    from sidestep.world import load_scenario

    return load_scenario("paper", **{**SCENARIO, **dict(overrides)})


def small_scenario(**overrides):
    """A scenario of short episodes that end in every way there is."""
    return _scenario(jax.config.jax_enable_x64, tuple(overrides.items()))


def small_options(**overrides):
    """Options of a tiny learner whose replay wraps around after 64 decisions."""
    from sidestep.learning import make_options

    return make_options(**{**OPTIONS, **overrides})


def small_train(scenario=None, options=None, **more):
    """`train` with the small settings unless told otherwise."""
    from sidestep.learning import train

    settings = {"shield": "game", "pursuer": "turn-then-drive", "episodes": 8, "chunk": CHUNK, **more}
    return train(scenario or small_scenario(), options=options or small_options(), **settings)


def leaves_of(tree):
    """Names and plain arrays of a pytree, random keys as their raw words."""

    def plain(leaf):
        key = jax.numpy.issubdtype(leaf.dtype, jax.dtypes.prng_key)
        return np.asarray(jax.random.key_data(leaf) if key else leaf)

    named, _ = jax.tree_util.tree_flatten_with_path(tree)
    return {jax.tree_util.keystr(path): plain(leaf) for path, leaf in named}


def differences(first, second):
    """Names of the leaves that are not the same bit for bit."""
    one, other = leaves_of(first), leaves_of(second)
    assert one.keys() == other.keys()
    return [
        name
        for name in one
        if one[name].dtype != other[name].dtype or one[name].tobytes() != other[name].tobytes()
    ]


@pytest.fixture(scope="session")
def small() -> SimpleNamespace:
    """The helpers above, by short names."""
    return SimpleNamespace(
        scenario=small_scenario,
        options=small_options,
        train=small_train,
        leaves_of=leaves_of,
        differences=differences,
    )


@pytest.fixture(scope="session")
def small_run(small) -> Iterator:
    """A small training of eight episodes, kept in memory."""
    return small.train()
