"""Hazard: a log that only its writer can read, that says something else than what happened, or that a crash
takes away."""

import json
import math
import sys
from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from sidestep.loop import Trajectory
from sidestep.safety import Status
from sidestep.world import Events, World, load_scenario

pytest.importorskip("mcap_ros2")

from sidestep.bridges.logs import LogWriter, load_log, read_log, save_log

PERIODS = 400


def episode(scenario, seed=0):
    """An episode of random numbers: nothing in it can be right by accident."""
    rng = np.random.default_rng(seed)
    m, k = scenario.pursuer_count, scenario.obstacle_count

    def drawn(*shape, scale=1.0):
        return jnp.asarray(scale * rng.normal(size=shape), jnp.float32)

    ends = np.zeros(PERIODS, bool)
    ends[-1] = True
    heading = jnp.asarray(rng.uniform(-np.pi, np.pi, (PERIODS + 1, m, 1)), jnp.float32)
    return Trajectory(
        worlds=jax.vmap(World)(
            evader=drawn(PERIODS + 1, 2),
            pursuers=jnp.concatenate([drawn(PERIODS + 1, m, 2), heading], axis=-1),
            obstacles=drawn(PERIODS + 1, k, 4),
            target=drawn(PERIODS + 1, 2),
            time=jnp.arange(PERIODS + 1, dtype=jnp.float32) * scenario.control_period,
            evader_velocity=drawn(PERIODS + 1, 2),
            wheel_speeds=drawn(PERIODS + 1, m, 2),
        ),
        nominal=drawn(PERIODS, 2).at[3].set(jnp.nan),
        action=drawn(PERIODS, 2),
        wheel_speeds=drawn(PERIODS, m, 2),
        status=jnp.asarray(rng.integers(0, 4, PERIODS), jnp.int32),
        barriers=drawn(PERIODS, m + k).at[5, 0].set(-jnp.inf),
        slack=drawn(PERIODS).at[7].set(jnp.inf),
        intervention=abs(drawn(PERIODS)),
        events=Events(
            reward=drawn(PERIODS),
            captured=jnp.zeros(PERIODS, bool),
            collided=jnp.asarray(ends),
            reached=jnp.zeros(PERIODS, bool),
            timed_out=jnp.zeros(PERIODS, bool),
            pursuer_clearance=drawn(PERIODS),
            obstacle_clearance=drawn(PERIODS),
        ),
    )


@pytest.fixture(scope="module")
def saved(tmp_path_factory):
    """A log of an episode with two pursuers and two obstacles."""
    scenario = load_scenario("paper", pursuer_count=2, obstacle_count=2, control_period=0.02)
    trajectory = episode(scenario)
    path = tmp_path_factory.mktemp("logs") / "episode.mcap"
    about = {"shield": "game", "seed": 3}
    save_log(trajectory, scenario, path, about=about, reactions=[(0.11, "stale pursuer 0: predicted")])
    return SimpleNamespace(scenario=scenario, trajectory=trajectory, path=path, about=about)


def test_episode_comes_back_to_the_last_bit(saved):
    log = load_log(saved.path)
    assert log.complete
    assert log.rebuilt == ()
    assert dict(log.about) == saved.about
    for mine, read in zip(jax.tree.leaves(saved.scenario), jax.tree.leaves(log.scenario), strict=True):
        np.testing.assert_array_equal(mine, read)
    assert jax.tree.structure(log.trajectory) == jax.tree.structure(saved.trajectory)
    for mine, read in zip(jax.tree.leaves(saved.trajectory), jax.tree.leaves(log.trajectory), strict=True):
        assert mine.dtype == read.dtype
        np.testing.assert_array_equal(mine, read)
    assert log.trajectory.outcome == "collided"


def test_another_reader_with_its_own_message_types_reads_the_same(saved):
    """rosbags decodes with the definitions it ships, not with those in the file."""
    rosbags = pytest.importorskip("rosbags.rosbag2")
    from rosbags.typesys import Stores, get_typestore

    store = get_typestore(Stores.ROS2_HUMBLE)
    found: dict[str, list] = {}
    with rosbags.Reader(saved.path) as reader:
        for connection, stamp, raw in reader.messages():
            found.setdefault(connection.topic, []).append(
                (stamp, store.deserialize_cdr(raw, connection.msgtype))
            )
    assert set(found) >= {
        "/evader/pose", "/pursuer_0/pose", "/pursuer_1/pose", "/obstacle_0/pose", "/obstacle_1/pose",
        "/target", "/cmd_vel_nominal", "/cmd_vel", "/diagnostics", "/shield", "/events",
    }  # fmt: skip
    poses = found["/pursuer_1/pose"]
    assert len(poses) == PERIODS + 1
    for index in (0, 17, PERIODS):
        stamp, message = poses[index]
        x, y, heading = np.asarray(saved.trajectory.worlds.pursuers[index, 1], float)
        assert stamp == message.header.stamp.sec * 10**9 + message.header.stamp.nanosec
        assert stamp == pytest.approx(1e9 * float(saved.trajectory.worlds.time[index]), abs=1.0)
        assert (message.pose.position.x, message.pose.position.y) == (x, y)
        turn = message.pose.orientation
        assert 2.0 * math.atan2(turn.z, turn.w) == pytest.approx(heading, abs=1e-12)
        assert message.header.frame_id == "map"
    velocities = [message.twist.linear.x for _, message in found["/cmd_vel"]]
    np.testing.assert_array_equal(velocities, np.asarray(saved.trajectory.action[:, 0], float))
    (told,) = found["/diagnostics"][5][1].status
    assert "stale pursuer 0" in told.message
    assert {value.key: value.value for value in told.values}["status"] in Status.NAMES
    _, numbers = found["/shield"][9]
    barriers = {dim.label: value for dim, value in zip(numbers.layout.dim, numbers.data, strict=True)}
    assert barriers["h2"] == float(saved.trajectory.barriers[9, 2])


@pytest.mark.parametrize("share", [0.3, 0.9])
def test_log_cut_off_by_a_crash_is_read_as_far_as_it_goes(saved, tmp_path, share):
    content = saved.path.read_bytes()
    cut = tmp_path / "cut.mcap"
    cut.write_bytes(content[: int(share * len(content))])
    log = load_log(cut)
    assert not log.complete
    assert any("cut off" in note for note in log.rebuilt)
    count = log.trajectory.length
    assert (share - 0.2) * PERIODS < count < PERIODS
    assert log.trajectory.outcome == "cut"
    np.testing.assert_array_equal(log.trajectory.action, saved.trajectory.action[:count])
    np.testing.assert_array_equal(log.trajectory.worlds.evader, saved.trajectory.worlds.evader[: count + 1])


def test_what_was_written_is_on_disk_before_the_log_is_closed(tmp_path):
    scenario = load_scenario("paper")
    writer = LogWriter(tmp_path / "live.mcap", scenario)
    for index in range(2000):
        writer.pose("evader", 0.02 * index, (0.001 * index, 0.0, 0.1))
    read = read_log(tmp_path / "live.mcap")
    writer.close()
    assert not read.complete
    assert len(read.topics["/evader/pose"]) > 1500
    assert json.loads(read.metadata["scenario"])["evader_speed"] == 0.1574


def live_log(path, scenario):
    """What a robot's node would write: poses at their own times, decisions in between, nothing of a
    simulation."""
    with LogWriter(path, scenario, {"shield": "joint", "source": "node"}) as log:
        log.target(10.0, (1.0, 0.0))
        for index in range(300):
            stamp = 10.0 + 0.01 * index
            log.pose("evader", stamp, (0.001 * index, 0.0, 0.0))
            log.pose("pursuer", stamp + 0.002, (1.0, -0.5 + 0.001 * index, 1.5))
            log.pose("obstacle", stamp + 0.003, (2.0 - 0.0005 * index, 0.0))
            if index % 5 == 4:
                log.decision(
                    stamp + 0.004, nominal=(0.1, 0.0), velocity=(0.05, 0.01), status=Status.CORRECTED,
                    slack=0.01, intervention=0.05, barriers=(0.3, 0.4), level="degraded",
                    reactions=("late cycle",), latency=0.004,
                )  # fmt: skip


def test_log_of_a_robot_becomes_an_episode_and_says_what_was_worked_out(tmp_path):
    scenario = load_scenario("paper")
    live_log(tmp_path / "robot.mcap", scenario)
    log = load_log(tmp_path / "robot.mcap")
    trajectory = log.trajectory
    assert trajectory.length in (59, 60)
    assert log.about["source"] == "node"
    words = " ".join(log.rebuilt)
    for missing in ("events", "velocity of obstacle 0", "evader's velocity"):
        assert missing in words
    np.testing.assert_allclose(trajectory.action, np.tile([[0.05, 0.01]], (trajectory.length, 1)), atol=1e-7)
    # As of the last pose before each decision.
    np.testing.assert_allclose(trajectory.worlds.evader[:3, 0], [0.004, 0.009, 0.014], atol=1e-6)
    np.testing.assert_allclose(trajectory.worlds.evader_velocity[5:20, 0], 0.1, rtol=1e-3)
    np.testing.assert_allclose(trajectory.worlds.obstacles[5:20, 0, 2], -0.05, rtol=1e-3)
    offset = np.asarray(trajectory.worlds.pursuers[1:, 0, :2] - trajectory.worlds.evader[1:])
    clearance = np.hypot(*offset.T) - 0.2
    np.testing.assert_allclose(trajectory.events.pursuer_clearance, clearance, atol=1e-6)
    assert np.all(np.asarray(trajectory.status) == Status.CORRECTED)
    read = read_log(tmp_path / "robot.mcap")
    status = read.topics["/diagnostics"][0][1].status[0]
    assert status.message == "corrected, degraded; late cycle"
    assert status.level == 1


def test_decision_of_the_core_is_logged_as_it_is(tmp_path):
    scenario = load_scenario("paper")
    world = World(jnp.ones(2), jnp.ones((1, 3)), jnp.ones((1, 4)), jnp.zeros(2))
    decision = SimpleNamespace(
        world=world, nominal=np.full(2, np.nan), velocity=np.zeros(2), status=Status.INVALID, slack=np.nan,
        intervention=0.0, barriers=np.array([0.25, -0.5]), level="stop", reactions=("no pose of the evader",),
        clearance=0.125, latency=0.5,
    )  # fmt: skip
    with LogWriter(tmp_path / "core.mcap", scenario) as log:
        log.onboard(1.0, decision)
        log.onboard(2.0, SimpleNamespace(**{**vars(decision), "world": None}))
    read = read_log(tmp_path / "core.mcap")
    assert len(read.topics["/evader/pose"]) == 1
    assert len(read.topics["/cmd_vel"]) == 2
    numbers = read.topics["/shield"][1][1]
    told = {dim.label: value for dim, value in zip(numbers.layout.dim, numbers.data, strict=True)}
    assert told["h1"] == -0.5
    assert told["latency"] == 0.5
    assert read.topics["/diagnostics"][0][1].status[0].level == 2


@pytest.mark.parametrize("stamp", [-0.1, 2.0**31, float("nan"), float("inf")])
def test_time_that_a_log_cannot_hold_is_refused_by_its_value(tmp_path, stamp):
    with LogWriter(tmp_path / "x.mcap", load_scenario("paper")) as log:
        with pytest.raises(ValueError, match=f"stamp = {stamp!r}".replace("+", r"\+")):
            log.target(stamp, (0.0, 0.0))
        log.target(0.0, (0.0, 0.0))


def test_files_that_are_no_logs_are_refused_by_name(tmp_path):
    with pytest.raises(ValueError, match=r"no log .*nothing\.mcap"):
        load_log(tmp_path / "nothing.mcap")
    (tmp_path / "text.mcap").write_text("not at all")
    with pytest.raises(ValueError, match="no MCAP file"):
        load_log(tmp_path / "text.mcap")
    with LogWriter(tmp_path / "still.mcap", load_scenario("paper")) as log:
        log.pose("evader", 0.0, (0.0, 0.0))
    with pytest.raises(ValueError, match="/cmd_vel"):
        load_log(tmp_path / "still.mcap")
    with pytest.raises(ValueError, match="exists already"):
        LogWriter(tmp_path / "still.mcap", load_scenario("paper"))


def test_missing_package_is_named_with_the_command_that_installs_it(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "mcap_ros2.writer", None)
    with pytest.raises(ValueError, match=r"'mcap_ros2'.*pip install .*\[logs\]"):
        LogWriter(tmp_path / "x.mcap", load_scenario("paper"))


def test_report_of_a_log_stands_alone_and_tells_what_the_log_lacks(tmp_path, capsys):
    from sidestep.cli import main

    live_log(tmp_path / "robot.mcap", load_scenario("paper"))
    assert main(["report", str(tmp_path / "robot.mcap")]) == 0
    page = (tmp_path / "robot.html").read_text()
    assert "data:image/png;base64," in page
    assert "What the log does not hold" in page
    assert "http" not in page.replace("http-equiv", "")
    assert "Not in the log: events" in capsys.readouterr().out


def test_evaluate_logs_the_episode_that_was_asked_for(tmp_path, capsys, monkeypatch):
    import sidestep.trials
    from sidestep.cli import main
    from sidestep.commands import evaluate
    from sidestep.loop import episode_key, rollout

    # What is measured is tested elsewhere, and would take longest here.
    closest = {"min_pursuer_clearance": np.array([0.2, 0.3, 0.4]), "min_obstacle_clearance": [9.0, 0.1, 9.0]}
    measured = SimpleNamespace(to_dict=dict, evaluation=SimpleNamespace(to_dict=dict, **closest))
    monkeypatch.setattr(sidestep.trials, "take_yardsticks", lambda *_, **__: measured)
    monkeypatch.setattr(evaluate, "evaluation_table", lambda _: "")
    monkeypatch.setattr(evaluate, "time_table", lambda *_: "")
    path = tmp_path / "one.mcap"
    command = ["evaluate", "goal-seeking", "--shield", "none", "--pursuer", "still"]
    command += ["--episodes", "3", "--batch", "3", "--set"]
    command += ["episode_steps=40", "--log", str(path), "--log-episode", "2"]
    video = ["--video", str(tmp_path / "one.gif"), "--video-episode", "worst", "--video-width", "160"]
    assert main([*command, *video, "--video-rate", "1", "--video-levels"]) == 0
    assert "Video of episode 1 (timed out)" in " ".join(capsys.readouterr().out.split())
    assert (tmp_path / "one.gif").read_bytes().startswith(b"GIF89a")
    scenario = load_scenario("paper", episode_steps=40)
    expected = rollout(scenario, "goal-seeking", "none", "still", episode_key(0, 2))
    read = load_log(path).trajectory
    np.testing.assert_array_equal(read.worlds.evader, expected.worlds.evader)
    assert read.outcome == expected.outcome
    assert main(command) == 2
    assert "exists already" in capsys.readouterr().err
    assert main([*command[:-4], "--log", str(tmp_path / "x.mcap"), "--log-episode", "3"]) == 2
    assert "0 to 2" in capsys.readouterr().err
