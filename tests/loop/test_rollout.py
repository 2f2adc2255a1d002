"""Hazards of recordings: frames that do not belong together, records past the end, damaged files."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from sidestep.loop import load_episode, load_trajectory, rollout, save_trajectory
from sidestep.world import EvaderModel, EvaderState, load_scenario, scenario_to_dict


@pytest.fixture(scope="module")
def scenario():
    return load_scenario("paper-test")


@pytest.fixture(scope="module")
def trajectory(scenario):
    return rollout(scenario, "goal-seeking", "paper", "turn-then-drive", 0)


def test_recorded_actions_reproduce_the_recorded_worlds(scenario, trajectory):
    assert trajectory.length > 50
    assert trajectory.worlds.evader.shape == (trajectory.length + 1, 2)
    for t in (0, 17, trajectory.length - 1):
        world = jax.tree.map(lambda leaf, t=t: leaf[t], trajectory.worlds)
        moved, events = scenario.step(world, trajectory.action[t], trajectory.wheel_speeds[t])
        assert np.allclose(moved.evader, trajectory.worlds.evader[t + 1], atol=1e-6)
        assert np.allclose(moved.pursuers, trajectory.worlds.pursuers[t + 1], atol=1e-6)
        assert float(events.reward) == pytest.approx(float(trajectory.events.reward[t]))
        assert float(trajectory.intervention[t]) == pytest.approx(
            float(jnp.linalg.norm(trajectory.action[t] - trajectory.nominal[t])), abs=1e-6
        )


def test_recording_stops_at_the_first_event(trajectory):
    ended = np.asarray(trajectory.events.terminated | trajectory.events.truncated)
    assert ended[-1]
    assert not ended[:-1].any()
    assert np.allclose(trajectory.worlds.time, 0.05 * np.arange(trajectory.length + 1), atol=1e-4)


def test_the_test_scene_starts_where_the_paper_says(trajectory):
    assert np.allclose(trajectory.worlds.evader[0], [0.0, 0.0])
    assert np.allclose(trajectory.worlds.pursuers[0], [[1.0, -0.5, 0.0]])
    assert np.allclose(trajectory.worlds.obstacles[0], [[1.5, 0.0, 0.02, 0.0]])


def test_cut_recording_says_so(scenario):
    cut = rollout(scenario, "goal-seeking", "none", "still", 0, steps=2)
    assert cut.length == 2
    assert cut.outcome == "cut"
    with pytest.raises(ValueError, match="steps"):
        rollout(scenario, "goal-seeking", "none", "still", 0, steps=0)


def test_a_given_world_is_where_it_starts(scenario):
    start = scenario.reset(jax.random.key(0))
    shifted = jax.tree.map(lambda leaf: leaf, start)
    record = rollout(scenario, "goal-seeking", "none", "still", 0, shifted, steps=2)
    assert np.array_equal(record.worlds.pursuers[0], start.pursuers)


def test_saved_trajectory_comes_back_whole(trajectory, tmp_path):
    save_trajectory(tmp_path / "scene.npz", trajectory)
    back = load_trajectory(tmp_path / "scene.npz")
    assert jax.tree.structure(back) == jax.tree.structure(trajectory)
    assert all(
        np.array_equal(a, b) for a, b in zip(jax.tree.leaves(back), jax.tree.leaves(trajectory), strict=True)
    )
    assert back.outcome == trajectory.outcome


def test_a_recording_says_in_which_scenario_it_was_made(scenario, trajectory, tmp_path):
    about = {"shield": "paper", "seed": 3}
    save_trajectory(tmp_path / "told.npz", trajectory, scenario, about)
    back = load_episode(tmp_path / "told.npz")
    assert scenario_to_dict(back.scenario) == scenario_to_dict(scenario)
    assert back.about == about
    assert np.array_equal(back.trajectory.worlds.evader, trajectory.worlds.evader)
    save_trajectory(tmp_path / "untold.npz", trajectory)
    assert load_episode(tmp_path / "untold.npz").scenario is None
    with np.load(tmp_path / "told.npz") as archive:
        arrays = dict(archive)
    np.savez(tmp_path / "bad.npz", **{**arrays, "told": np.frombuffer(b"{", np.uint8)})
    with pytest.raises(ValueError, match="no recorded trajectory"):
        load_episode(tmp_path / "bad.npz")


def test_damaged_file_is_refused(tmp_path):
    (tmp_path / "scene.npz").write_bytes(b"no archive")
    with pytest.raises(ValueError, match="no recorded trajectory"):
        load_trajectory(tmp_path / "scene.npz")
    np.savez(tmp_path / "other.npz", a=np.zeros(3))
    (tmp_path / "cut.npz").write_bytes((tmp_path / "other.npz").read_bytes()[:100])
    with pytest.raises(ValueError, match="no recorded trajectory"):
        load_trajectory(tmp_path / "cut.npz")
    with pytest.raises(ValueError, match="no recorded trajectory"):
        load_trajectory(tmp_path / "other.npz")


def test_two_recordings_are_the_same(scenario, trajectory):
    again = rollout(scenario, "goal-seeking", "paper", "turn-then-drive", 0)
    assert np.array_equal(again.worlds.evader, trajectory.worlds.evader)


def test_recording_in_double_precision(scenario):
    with jax.enable_x64(True):
        wide = rollout(load_scenario("paper-test"), "goal-seeking", "game", "turn-then-drive", 0, steps=40)
        assert wide.worlds.evader.dtype == np.float64
        assert np.all(np.isfinite(wide.worlds.evader))


class Obedient(EvaderModel):
    """Moves as told, and counts how often it was."""

    def start(self, scenario, key):
        return jnp.zeros(1)

    def after(self, scenario, robot, command, time):
        return EvaderState(robot.position + command * time, command, robot.state + time)


def test_episode_of_a_robot_of_ones_own_is_read_back_without_its_code(tmp_path):
    own = load_scenario("paper", evader_model=Obedient(), episode_steps=4)
    whole = rollout(own, "goal-seeking", "none", "still", 0)
    save_trajectory(tmp_path / "own.npz", whole, own)
    back = load_episode(tmp_path / "own.npz")
    assert back.scenario.built_in
    assert back.scenario.episode_steps == 4
    np.testing.assert_array_equal(back.trajectory.worlds.evader_state, whole.worlds.evader_state)
    np.testing.assert_allclose(whole.worlds.evader_state[:, 0], 0.05 * np.arange(5), atol=1e-6)
