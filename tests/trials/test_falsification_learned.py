"""Hazards of a pursuer that learns: learning from what never happened, forgetting when it is stopped."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from sidestep.learning import TD3
from sidestep.loop.step import RUNNING
from sidestep.safety import make_shield
from sidestep.store.checkpoints import read_named
from sidestep.trials.falsification import Plan, falsify
from sidestep.trials.falsification.chases import Target
from sidestep.trials.falsification.learned import (
    OBSERVATIONS,
    PursuerTraining,
    attacker_observation,
    train,
    untrained,
)
from sidestep.trials.falsification.starts import draw_starts
from sidestep.world import World, goal_seeking, load_scenario

PAPER = load_scenario("paper")
EMPTY = load_scenario("paper", obstacle_count=0)
UNSHIELDED = Target(EMPTY, goal_seeking, make_shield("none", EMPTY))


@pytest.mark.slow
def test_learning_pursuer_learns_from_every_period_that_counts():
    algorithm = TD3(hidden=(8, 8))
    training = PursuerTraining(
        algorithm, chases=4, decisions=6, decision_steps=2, updates=2, batch_size=8, capacity=50
    )
    state = untrained(training, jax.random.key(0))
    starts = draw_starts(EMPTY, jax.random.split(jax.random.key(1), 4), np.array([True, True, False, False]))
    trained, chases, wheels = train(UNSHIELDED, training, state, starts, "capture", jax.random.key(2))
    steps = np.asarray(chases.tally.steps)
    assert wheels.shape == (4, 12, 1, 2)
    assert int(trained.ring.written) == np.sum(-(-steps // 2))
    assert int(trained.learner.updates) > 0
    filled = int(min(trained.ring.written, 50))
    rows = jax.tree.map(lambda leaf: np.asarray(leaf)[:filled], trained.ring.rows)
    assert all(np.all(np.isfinite(leaf)) for leaf in jax.tree.leaves(rows))
    # Only a loss pays the bonus, and it ends the episode.
    assert np.sum(rows.reward > 5.0) == np.sum(np.asarray(chases.outcome) == 0)
    assert np.sum(rows.terminated) == np.sum(np.asarray(chases.outcome) != RUNNING)
    assert np.all(np.asarray(wheels)[np.arange(12) >= steps[:, None]] == 0.0)


def test_pursuer_sees_the_same_in_a_turned_world():
    start = PAPER.reset(jax.random.key(4))
    turn = jnp.array([[0.0, -1.0], [1.0, 0.0]])
    turned = World(
        evader=turn @ start.evader,
        pursuers=jnp.concatenate([start.pursuers[:, :2] @ turn.T, start.pursuers[:, 2:] + jnp.pi / 2], -1),
        obstacles=jnp.concatenate([start.obstacles[:, :2] @ turn.T, start.obstacles[:, 2:] @ turn.T], -1),
        target=turn @ start.target,
    )
    seen = attacker_observation(PAPER, start)
    assert seen.shape == (OBSERVATIONS,)
    assert np.allclose(seen, attacker_observation(PAPER, turned), atol=1e-5)
    assert np.max(np.abs(seen)) <= 1.0 + 1e-6


@pytest.mark.slow
def test_resumed_learner_has_learned_the_same(tmp_path):
    plan = Plan(attacks=("learned",), goal="capture", batch=8, seconds=0.4)

    def search(name, episodes, resume=False):
        folder = tmp_path / name
        falsify(EMPTY, "goal-seeking", "none", out=folder, plan=plan, episodes=episodes, resume=resume)
        return read_named(folder / "checkpoints" / "learned.npz")

    first, _ = search("stopped", 1)
    resumed, about = search("stopped", 2, resume=True)
    straight, _ = search("straight", 2)
    assert about["round"] == 1
    assert first.keys() == resumed.keys() == straight.keys()
    assert int(resumed[".ring.written"]) > int(first[".ring.written"]) > 0
    for name, array in straight.items():
        assert np.array_equal(array, resumed[name]), name
    # Only what has been filled is stored.
    assert len(resumed[".ring.rows.reward"]) == int(resumed[".ring.written"])
