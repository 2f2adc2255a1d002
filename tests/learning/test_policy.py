"""Hazard: a policy or a curve read back that is not the one that was written."""

import struct
import threading
from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from sidestep._arrays import real
from sidestep.learning import load_policy
from sidestep.learning.curves import Curves
from sidestep.learning.networks import Actor
from sidestep.learning.policy import LearnedPolicy, write_policy
from sidestep.store.checkpoints import CheckpointError
from sidestep.store.runs import RunError, create_run, read_metrics


@pytest.fixture
def policy():
    return LearnedPolicy(Actor(4, 2, (8, 6), jax.random.key(0)), 5)


def test_loaded_policy_acts_as_the_trained_one(precision, tmp_path):
    policy = LearnedPolicy(Actor(4, 2, (8, 6), jax.random.key(0)), 5)
    create_run(tmp_path / "run", {})
    path = write_policy(tmp_path / "run", policy)
    for place in (tmp_path / "run", str(tmp_path / "run"), path):
        loaded = load_policy(place)
        assert loaded.decision_steps == 5
        for row in np.random.default_rng(0).normal(size=(5, 4)):
            action = loaded(row)
            np.testing.assert_array_equal(action, policy(real(row)))
            assert action.shape == (2,)
            assert jnp.all(jnp.abs(action) <= 1.0)
            assert action.dtype == (jnp.float64 if precision else jnp.float32)


def test_policy_works_under_jit_vmap_and_grad(policy):
    rows = real(np.random.default_rng(1).normal(size=(7, 4)))
    batched = jax.jit(jax.vmap(policy))(rows)
    np.testing.assert_allclose(batched, jnp.stack([policy(row) for row in rows]), atol=1e-6)
    assert jnp.all(jnp.isfinite(jax.grad(lambda row: policy(row).sum())(rows[0])))


def test_observation_of_another_scenario_is_refused(policy):
    with pytest.raises(ValueError, match=r"4 entries.*7.*obstacle_count"):
        policy(jnp.zeros(7))


def test_missing_or_torn_policy_says_so(policy, tmp_path):
    with pytest.raises(RunError, match="does not exist; name a run folder"):
        load_policy(tmp_path / "nowhere")
    create_run(tmp_path / "run", {})
    with pytest.raises(RunError, match=r"no policy yet.*--resume"):
        load_policy(tmp_path / "run")
    with pytest.raises(CheckpointError, match="does not exist"):
        load_policy(tmp_path / "mine.npz")
    path = write_policy(tmp_path / "run", policy)
    path.write_bytes(path.read_bytes()[:-300])
    with pytest.raises(CheckpointError, match="damaged"):
        load_policy(tmp_path / "run")


# Curves ---------------------------------------------------------------------------------------------------


def read_events(folder):
    """(step, {tag: value}) of every scalar, and the steps from which earlier ones are to be forgotten."""
    from tensorboardX.proto.event_pb2 import Event, SessionLog

    scalars = {}
    # By name, as TensorBoard does.
    for path in sorted(folder.glob("events.out.tfevents.*")):
        content = path.read_bytes()
        place = 0
        while place < len(content):
            (length,) = struct.unpack_from("<Q", content, place)
            event = Event.FromString(content[place + 12 : place + 12 + length])
            place += 12 + length + 4
            if event.session_log.status == SessionLog.START:
                scalars = {key: value for key, value in scalars.items() if key[0] < event.step}
            for value in event.summary.value:
                scalars[event.step, value.tag] = value.simple_value
    return scalars


def test_curves_interrupted_anywhere_hold_whole_chunks_and_leave_nothing_to_wait_for(tmp_path, monkeypatch):
    """A writer with a thread of its own, interrupted while it handed an event over, never ended."""
    from tensorboardX import summary

    losses = SimpleNamespace(critic=np.ones(2), actor=np.ones(2), value=np.ones(2))
    line = {"episode": 1, "outcome": "reached", "return": 5.0, "steps": 7}
    threads, scalar, left = threading.active_count(), summary.scalar, [4]

    def interrupted(*arguments):
        left[0] -= 1
        if left[0] < 0:
            raise KeyboardInterrupt
        return scalar(*arguments)

    curves = Curves(tmp_path, 1)
    monkeypatch.setattr(summary, "scalar", interrupted)
    with pytest.raises(KeyboardInterrupt):
        curves.write([line], losses)
    assert read_events(tmp_path / "curves") == {}
    left[0] = 100
    curves.write([line], losses)
    names = "episode/return", "episode/steps", "episode/reached", "loss/critic", "loss/actor", "loss/value"
    assert set(read_events(tmp_path / "curves")) == {(1, name) for name in names}
    assert threading.active_count() == threads


def test_curves_of_many_worlds_hold_one_mean_per_chunk(tmp_path):
    losses = SimpleNamespace(critic=np.ones(2), actor=np.ones(2), value=np.ones(2))
    lines = [
        {"episode": 4, "outcome": "reached", "return": 5.0, "steps": 7, "clearance": None},
        {"episode": 5, "outcome": "captured", "return": 2.0, "steps": 8, "clearance": 0.25},
    ]
    curves = Curves(tmp_path, 1, averaged=True)
    curves.write(lines, losses)
    curves.write([], losses)
    episodes = {
        name: value for (step, name), value in read_events(tmp_path / "curves").items() if "episode/" in name
    }
    assert {step for step, _ in read_events(tmp_path / "curves")} == {5}
    assert episodes == {
        "episode/return": 3.5, "episode/steps": 7.5, "episode/reached": 0.5, "episode/clearance": 0.25,
    }  # fmt: skip


@pytest.mark.slow
def test_curves_hold_each_episode_once_even_after_a_resume(small, tmp_path, monkeypatch):
    calls = []

    def interrupt(progress):
        calls.append(progress.episode)
        if progress.episode >= 3:
            raise KeyboardInterrupt

    # A clock that stands still: event files are named by the second, and a fast resume must not clash.
    monkeypatch.setattr("sidestep.learning.curves.time", SimpleNamespace(time=lambda: 1.7e9))
    small.train(out=tmp_path / "run", progress=interrupt)
    small.train(out=tmp_path / "run", resume=True)
    scalars = read_events(tmp_path / "run" / "curves")
    metrics = read_metrics(tmp_path / "run")
    assert len(metrics) == 8
    for line in metrics:
        step = line["episode"]
        for name in (
            "return",
            "steps",
            "env_steps",
            "min_pursuer_clearance",
            "interventions",
            "mean_correction",
        ):
            assert scalars[step, f"episode/{name}"] == pytest.approx(line[name], rel=1e-6)
        assert scalars[step, "episode/reached"] == (line["outcome"] == "reached")
    assert {step for step, _ in scalars} == set(range(1, 9))
    assert {tag for _, tag in scalars} >= {"loss/critic", "loss/actor", "loss/value"}
