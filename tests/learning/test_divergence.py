"""Hazard: networks that are no numbers any more, taken for a policy that stands still."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from sidestep._arrays import real
from sidestep.learning.divergence import Diverged, broken_networks, divergence
from sidestep.learning.td3 import Losses
from sidestep.learning.training import Report, run_chunk, start
from sidestep.loop import Tally
from sidestep.pursuit import as_pursuer
from sidestep.safety import as_shield
from sidestep.store.checkpoints import CheckpointError, list_checkpoints, read_checkpoint, write_checkpoint
from sidestep.store.runs import read_metrics, read_summary
from sidestep.world import load_scenario

WILD = 1e30
"""A learning rate that no network survives."""


def spoiled(learner, value=jnp.nan):
    return eqx.tree_at(lambda x: x.actor.body.biases[-1], learner, jnp.full(2, value))


def test_an_actor_that_answers_nan_is_invalid_input_in_training_too_not_a_stop(small):
    scenario, options = small.scenario(), small.options()
    shield, pursuer = as_shield("game", scenario), as_pursuer("turn-then-drive")
    state = start(scenario, shield, options, jax.random.key(0), 64)
    warm, report = run_chunk(scenario, shield, pursuer, options, state, jnp.asarray(8), 10)
    assert np.all(report.finite)
    assert not np.any(report.tally.invalid)
    warm = eqx.tree_at(lambda s: s.learner, warm, spoiled(warm.learner))
    after, report = run_chunk(scenario, shield, pursuer, options, warm, jnp.asarray(8), 10)
    assert not np.any(report.finite)
    # From the second episode on nothing but the spoiled actor was asked.
    ended, invalid = np.asarray(report.ended), np.asarray(report.tally.invalid)
    later = np.cumsum(ended) > ended
    assert np.any(later)
    np.testing.assert_array_equal(invalid[later], np.asarray(report.tally.steps)[later])
    assert np.all(invalid > 0)
    # The robots went on moving with finite numbers.
    assert np.all(np.isfinite(after.episode.world.evader))
    assert divergence(report, after.learner, 3) == (4, "the actor's action is")


def test_training_whose_networks_break_stops_and_keeps_the_last_good_checkpoint(small, tmp_path):
    folder = tmp_path / "run"
    options = small.options(critic_learning_rate=WILD)
    with pytest.raises(
        Diverged, match=r"stopped in episode \d+: .* not finite.*critic_learning_rate = 1e\+30"
    ):
        small.train(options=options, out=folder, checkpoint_seconds=0.0)
    found = list_checkpoints(folder)
    assert found
    example = start(small.scenario(), as_shield("game", small.scenario()), options, jax.random.key(0), 64)
    state, _ = read_checkpoint(folder, example)
    assert broken_networks(state.learner) == []
    for name, leaf in small.leaves_of(state.replay.transitions).items():
        assert np.all(np.isfinite(leaf)), name
    assert len(read_metrics(folder)) == int(state.episodes)
    assert read_summary(folder)["episodes"] == int(state.episodes)
    assert not (folder / "policy.npz").exists()
    # It resumes, and says the same; nothing is lost by that.
    with pytest.raises(Diverged, match="diverge again"):
        small.train(options=options, out=folder, resume=True)
    again, _ = read_checkpoint(folder, example)
    assert small.differences(again, state) == []


def test_checkpoint_with_broken_networks_is_not_trained_on(small, tmp_path):
    folder = tmp_path / "run"
    small.train(out=folder, episodes=3)
    example = start(
        small.scenario(), as_shield("game", small.scenario()), small.options(), jax.random.key(0), 24
    )
    state, _ = read_checkpoint(folder, example)
    for path in list_checkpoints(folder):
        path.unlink()
    state = eqx.tree_at(lambda s: s.learner, state, spoiled(state.learner, jnp.inf))
    write_checkpoint(folder, state, wall_seconds=1.0)
    with pytest.raises(CheckpointError, match="weights of the actor are not finite"):
        small.train(out=folder, episodes=3, resume=True)


def report_of(ended, critic=None, finite=None):
    """What a chunk of decisions reports in which episodes ended, critics lost and actions were like this."""
    count, none = len(ended), jnp.zeros((), jnp.int32)
    tally = Tally.zero(load_scenario("paper").reset(jax.random.key(0)))
    critic = [0.0] * count if critic is None else critic
    finite = [True] * count if finite is None else finite

    def decision(ended, critic, finite):
        losses = Losses(real(critic), real(0.0), real(0.0))
        return Report(jnp.asarray(ended), none, tally, jnp.ones(()), none, losses, jnp.asarray(finite))

    return jax.tree.map(lambda *leaves: jnp.stack(leaves), *map(decision, ended, critic, finite))


def test_divergence_names_the_first_thing_and_the_episode_it_happened_in(small, small_run):
    learner = small_run.state.learner
    ended = [False, True, False, False, True, False]
    assert divergence(report_of(ended), learner, 7) is None
    loss = [0.0, 0.0, 0.0, np.inf, np.nan, np.nan]
    assert divergence(report_of(ended, loss), learner, 7) == (9, "the critics' loss is")
    first = report_of(ended, loss, [True, True, True, False, False, False])
    assert divergence(first, learner, 7) == (9, "the actor's action is")
    # An episode's own last decision belongs to it.
    loss = [0.0, *[np.nan] * 5]
    assert divergence(report_of(ended, loss), learner, 0)[0] == 1
    # Losses that stay finite hide nothing.
    assert divergence(report_of(ended), spoiled(learner), 7) == (10, "the weights of the actor are")
    for name in ("critic", "target_actor", "target_critic", "actor_moments", "critic_moments"):
        broken = eqx.tree_at(
            lambda x, name=name: getattr(x, name),
            learner,
            jax.tree.map(
                lambda leaf: leaf * jnp.nan if eqx.is_inexact_array(leaf) else leaf, getattr(learner, name)
            ),
        )
        assert len(broken_networks(broken)) == 1, name
