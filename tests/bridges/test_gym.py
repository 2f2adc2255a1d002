"""Gymnasium: does a learner see the episodes that we measure, and is every end told as what it was?"""

import copy
import importlib.util
import os
import pickle

import jax
import jax.numpy as jnp
import numpy as np
import pytest

os.environ.setdefault("SDL_VIDEODRIVER", "dummy")

import gymnasium
from gymnasium.error import ResetNeeded
from gymnasium.utils.env_checker import check_env
from gymnasium.vector import AutoresetMode

from sidestep.bridges.gym import (
    ID,
    PursuedEnv,
    PursuedVectorEnv,
    SafetyGymnasiumWrapper,
    ShieldVectorWrapper,
    ShieldWrapper,
)
from sidestep.bridges.gym import vector as vector_module
from sidestep.bridges.gym.calls import seed_words
from sidestep.bridges.gym.wrappers import checked_shield
from sidestep.safety import Status, make_shield
from sidestep.trials import evaluate
from sidestep.world import (
    EvaderModel,
    EvaderState,
    World,
    goal_seeking,
    load_scenario,
    scenario_to_dict,
    to_action,
    to_velocity,
)
from speed.peer_task import PeerTask

HOLD, LIMIT = 3, 120
# One scenario for all: tasks of one structure share their compiled programs.
SCENARIO = load_scenario("paper", episode_steps=LIMIT)
TASK = {"scenario": SCENARIO, "shield": "none", "pursuer": "random", "decision_steps": HOLD}
AHEAD = np.array([1.0, 0.0], np.float32)
FLAGS = ("captured", "collided", "reached", "timed_out")
SCENE = {
    "evader": (0.0, 0.0),
    "pursuers": [(-1.0, 0.0, 0.0)],
    "obstacles": [(0.0, 2.0, 0.0, 0.0)],
    "target": (1.0, 0.0),
}


def chasing(**changes):
    return PursuedEnv(**{**TASK, "pursuer": "nash", **changes})


def at(**changes):
    return {"world": {**SCENE, **changes}}


def test_gymnasiums_checker_finds_nothing_to_complain_of():
    env = gymnasium.make(f"sidestep.bridges.gym:{ID}", **TASK)
    assert isinstance(env.unwrapped, PursuedEnv)
    check_env(env.unwrapped)
    env.close()


def test_stable_baselines_checker_finds_nothing_to_complain_of():
    if importlib.util.find_spec("stable_baselines3") is None:
        pytest.skip(
            "needs: pip install torch==2.13.0 && pip install stable-baselines3 (or make .venv-bench/.ready)"
        )
    from stable_baselines3.common.env_checker import check_env as check

    check(PursuedEnv(**TASK))


@pytest.mark.parametrize("every_info", [False, True])
def test_stable_baselines_gets_many_worlds_in_its_own_form(every_info):
    if importlib.util.find_spec("stable_baselines3") is None:
        with pytest.raises(ValueError, match=r"pip install torch==2\.13\.0"):
            importlib.import_module("sidestep.bridges.gym.stable_baselines")
        return
    from stable_baselines3 import TD3
    from stable_baselines3.common.vec_env import VecMonitor

    from sidestep.bridges.gym.stable_baselines import PursuedVecEnv

    worlds, seed = 4, 3
    env = PursuedVecEnv(worlds, every_info=every_info, **TASK)
    alone = [PursuedEnv(**TASK) for _ in range(worlds)]
    env.seed(seed)
    observations = env.reset()
    for lane, one in enumerate(alone):
        np.testing.assert_allclose(one.reset(seed=seed + lane)[0], observations[lane], atol=1e-5)
    random, ends = np.random.default_rng(0), 0
    for _ in range(150):
        actions = np.clip(AHEAD + 0.2 * random.normal(size=(worlds, 2)), -1.0, 1.0).astype(np.float32)
        observations, rewards, dones, infos = env.step(actions)
        for lane, one in enumerate(alone):
            expected, reward, terminated, truncated, info = one.step(actions[lane])
            assert rewards[lane] == pytest.approx(reward, rel=1e-4, abs=1e-4)
            assert dones[lane] == (terminated or truncated)
            assert infos[lane]["cost"] == info["cost"]
            if dones[lane]:
                ends += 1
                assert infos[lane]["TimeLimit.truncated"] is truncated
                np.testing.assert_allclose(infos[lane]["terminal_observation"], expected, atol=1e-4)
                expected, _ = one.reset()
            if dones[lane] or every_info:
                assert info.keys() <= infos[lane].keys()
            np.testing.assert_allclose(observations[lane], expected, atol=1e-4)
    assert ends > 5
    model = TD3("MlpPolicy", VecMonitor(env), learning_starts=8, batch_size=8, seed=0)
    model.learn(40)
    assert env.get_attr("num_envs", indices=[0, 2]) == [worlds, worlds]
    assert env.env_is_wrapped(VecMonitor) == [False] * worlds
    env.close()


def test_seeds_play_the_episodes_of_an_evaluation_one_after_the_other():
    class Policy:
        decision_steps = HOLD

        def __call__(self, observation):
            return goal_seeking(observation)

    seed, episodes = 7, 5
    told = evaluate(SCENARIO, Policy(), "none", "random", episodes=episodes, key=seed, batch=episodes)
    env = PursuedEnv(**TASK)
    for episode in range(episodes):
        env.reset(seed=seed if episode == 0 else None)
        periods, total, over = 0, 0.0, False
        while not over:
            _, reward, terminated, truncated, info = env.step(AHEAD)
            periods, total, over = periods + info["periods"], total + reward, terminated or truncated
        assert periods == told.steps[episode]
        assert total == pytest.approx(told.returns[episode], rel=1e-4, abs=1e-3)
        assert [info[name] for name in FLAGS].index(True) == told.outcome[episode]
        assert (terminated, truncated) == (not info["timed_out"], info["timed_out"])


@pytest.mark.parametrize("mode", list(AutoresetMode))
def test_worlds_side_by_side_live_through_what_each_does_alone(mode):
    worlds, steps, seed = 5, 200, 3
    vector = gymnasium.make_vec(ID, worlds, autoreset_mode=mode, **TASK)
    assert isinstance(vector, PursuedVectorEnv)
    assert vector.metadata["autoreset_mode"] is mode
    alone = [PursuedEnv(**TASK) for _ in range(worlds)]
    observations, _ = vector.reset(seed=seed)
    for lane, env in enumerate(alone):
        np.testing.assert_allclose(env.reset(seed=seed + lane)[0], observations[lane], atol=1e-5)
    random, over, ends = np.random.default_rng(0), np.zeros(worlds, bool), np.zeros(worlds, int)
    for _ in range(steps):
        # Towards the target on the whole, or else all that ever happens is the time limit.
        actions = np.clip(AHEAD + 0.2 * random.normal(size=(worlds, 2)), -1.0, 1.0).astype(np.float32)
        observations, rewards, terminated, truncated, infos = vector.step(actions)
        assert rewards.dtype == np.float64
        for lane, env in enumerate(alone):
            if mode is AutoresetMode.NEXT_STEP and over[lane]:
                expected, _ = env.reset()
                assert (rewards[lane], terminated[lane], truncated[lane]) == (0.0, False, False)
                assert not infos["_cost"][lane]
                np.testing.assert_allclose(observations[lane], expected, atol=1e-5)
                continue
            expected, reward, ended, cut, info = env.step(actions[lane])
            assert (terminated[lane], truncated[lane]) == (ended, cut)
            assert rewards[lane] == pytest.approx(reward, rel=1e-4, abs=1e-4)
            told, shown = infos, observations[lane]
            if mode is AutoresetMode.SAME_STEP and (ended or cut):
                assert infos["_final_obs"][lane]
                assert infos["_final_info"][lane]
                assert not infos["_cost"][lane]
                told, shown = infos["final_info"], infos["final_obs"][lane]
                np.testing.assert_allclose(observations[lane], env.reset()[0], atol=1e-5)
            np.testing.assert_allclose(shown, expected, atol=1e-4)
            for name, value in info.items():
                assert told[f"_{name}"][lane]
                np.testing.assert_allclose(told[name][lane], value, rtol=1e-4, atol=1e-4)
        over = terminated | truncated
        ends += over
        if mode is AutoresetMode.DISABLED and np.any(over):
            with pytest.raises(ResetNeeded, match="reset_mask"):
                vector.step(actions)
            observations, _ = vector.reset(options={"reset_mask": over})
            for lane in np.flatnonzero(over):
                np.testing.assert_allclose(observations[lane], alone[lane].reset()[0], atol=1e-5)
    # Further than the starts that were drawn ahead.
    assert ends.min() > 3


@pytest.mark.parametrize(
    "mode",
    [
        AutoresetMode.NEXT_STEP,
        *(
            pytest.param(mode, marks=pytest.mark.slow)
            for mode in (AutoresetMode.SAME_STEP, AutoresetMode.DISABLED)
        ),
    ],
)
def test_the_number_of_threads_changes_nothing(mode, monkeypatch):
    monkeypatch.setattr(vector_module, "useful_threads", lambda most: most)
    make = lambda threads: PursuedVectorEnv(  # noqa: E731
        12, autoreset_mode=mode, threads=threads, **TASK
    )
    alone, shared = make(1), make(3)
    assert [part.size for part in shared._parts] == [4, 4, 4]
    # Parts of one size, or else each would compile its own program.
    assert len(make(5)._parts) == 4
    random, over = np.random.default_rng(0), np.zeros(12, bool)

    def same(one, other):
        jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-5, atol=1e-5), one, other)

    alone.reset(seed=1)
    given = {"world": jax.tree.map(lambda leaf: leaf[::-1], alone.worlds)}
    for options in (None, given):
        same(alone.reset(seed=4, options=options)[0], shared.reset(seed=4, options=options)[0])
        for _ in range(40):
            if mode is AutoresetMode.DISABLED and np.any(over):
                mask = {"reset_mask": over}
                same(alone.reset(options=mask)[0], shared.reset(options=mask)[0])
            actions = np.clip(AHEAD + 0.2 * random.normal(size=(12, 2)), -1.0, 1.0).astype(np.float32)
            expected, made = alone.step(actions), shared.step(actions)
            same(expected[:4], made[:4])
            assert expected[4].keys() == made[4].keys()
            same({n: v for n, v in expected[4].items() if n != "final_obs"},
                 {n: v for n, v in made[4].items() if n != "final_obs"})  # fmt: skip
            over = expected[2] | expected[3]
        same(alone.worlds, shared.worlds)
        over = np.zeros(12, bool)
    shared.close()


def test_resetting_all_worlds_begins_next_episodes_and_a_seed_begins_anew():
    vector = PursuedVectorEnv(3, **TASK)
    first, _ = vector.reset(seed=[11, 12, 13])
    second, _ = vector.reset()
    mixed, _ = vector.reset(seed=[11, None, None])
    assert not np.allclose(first, second)
    np.testing.assert_allclose(mixed[0], first[0], atol=1e-6)
    for lane in (1, 2):
        env = PursuedEnv(**TASK)
        env.reset(seed=11 + lane)
        env.reset()
        np.testing.assert_allclose(mixed[lane], env.reset()[0], atol=1e-6)
    with pytest.raises(ValueError, match="2 seeds for 3 worlds"):
        vector.reset(seed=[1, 2])
    with pytest.raises(ValueError, match="3 booleans"):
        vector.reset(options={"reset_mask": np.zeros(3, bool)})
    assert np.array_equal(seed_words([7])[:, 0], jax.random.key_data(jax.random.key(7)))
    assert not np.array_equal(seed_words([2**40]), seed_words([0]))


def test_a_capture_costs_and_ends_while_a_time_limit_only_cuts():
    env = chasing()
    env.reset(seed=0, options=at(pursuers=[(0.5, 0.0, np.pi)]))
    info = {"cost": 0.0}
    while info["cost"] == 0.0:
        _, _, terminated, truncated, info = env.step(AHEAD)
    assert (terminated, truncated, info["captured"], info["cost"]) == (True, False, True, 1.0)
    assert info["pursuer_clearance"] <= 0.0
    with pytest.raises(ResetNeeded):
        env.step(AHEAD)
    env.reset(options=at(target=(50.0, 0.0), pursuers=[(-40.0, 0.0, 0.0)]))
    for left in range(LIMIT // HOLD - 1, -1, -1):
        _, reward, terminated, truncated, info = env.step(AHEAD)
        assert truncated == (left == 0)
    assert (terminated, info["timed_out"], info["cost"]) == (False, True, 0.0)
    assert reward == pytest.approx(-0.01 * HOLD * 49.0, rel=0.02)


def test_what_was_executed_is_told_in_the_units_of_what_was_proposed():
    env = chasing(shield="paper")
    env.reset(seed=0, options=at())
    *_, free = env.step(0.5 * AHEAD)
    np.testing.assert_allclose(free["executed"], free["proposed"], atol=1e-5)
    assert (free["status"], free["intervention"]) == (Status.OK, pytest.approx(0.0, abs=1e-6))
    env.reset(options=at(pursuers=[(0.42, 0.0, np.pi)]))
    *_, held = env.step(AHEAD)
    assert held["status"] == Status.CORRECTED
    assert held["executed"][0] < 0.9
    apart = np.linalg.norm(held["executed"] - held["proposed"]) * float(SCENARIO.evader_speed)
    assert held["intervention"] == pytest.approx(apart, rel=0.05)


def test_an_action_that_is_not_a_number_stops_the_robot_and_is_reported():
    env = chasing()
    env.reset(seed=0, options=at())
    observation, reward, _, _, info = env.step(np.array([np.nan, 0.0], np.float32))
    assert info["status"] == Status.INVALID
    # What was proposed, not what was made of it.
    np.testing.assert_array_equal(info["proposed"], [np.nan, 0.0])
    assert np.all(np.isfinite(observation))
    assert np.isfinite(reward)
    np.testing.assert_allclose(env.world.evader, 0.0, atol=1e-6)


@pytest.mark.parametrize(
    "wrong, named",
    [
        ({"decision_steps": 0}, "decision_steps"),
        ({"shield": "nothing"}, "nothing"),
        ({"scenario": "paper", "evader_sped": 0.2}, "evader_speed"),
        ({"evader_speed": 0.2}, "not with a Scenario"),
        ({"reward_scale": float("nan")}, "reward_scale"),
        ({"render_mode": "ansi"}, "render_mode"),
    ],
)
def test_a_wrong_argument_is_named(wrong, named):
    with pytest.raises(ValueError, match=named):
        PursuedEnv(**{**TASK, **wrong})


@pytest.mark.parametrize(
    "world, named",
    [
        ({**SCENE, "evader": (0.0, 0.0, 0.0)}, "'evader'"),
        ({**SCENE, "target": (np.nan, 0.0)}, "'target'"),
        ({name: SCENE[name] for name in ("evader", "target")}, "'pursuers'"),
        ("here", "a World"),
        ({**SCENE, "evader": SCENE["pursuers"][0][:2]}, "captured, 0 m from pursuer 0"),
        ({**SCENE, "evader": SCENE["obstacles"][0][:2]}, "in collision, 0 m from obstacle 0"),
    ],
)
def test_a_start_that_is_no_world_is_named(world, named):
    with pytest.raises(ValueError, match=named):
        chasing().reset(options={"world": world})


def test_options_that_reset_would_not_heed_are_refused():
    with pytest.raises(ValueError, match=r"\['wrold'\]; reset knows 'world'"):
        chasing().reset(options={"wrold": SCENE})
    vector = gymnasium.make_vec(ID, 2, **TASK)
    with pytest.raises(ValueError, match="'world', 'reset_mask'"):
        vector.reset(options={"mask": np.ones(2, bool)})
    worlds = {name: np.stack([part, part]) for name, part in SCENE.items()}
    worlds["evader"] = np.stack([SCENE["evader"], SCENE["pursuers"][0][:2]])
    with pytest.raises(ValueError, match="captured in world 1"):
        vector.reset(options={"world": worlds})
    with pytest.raises(ValueError, match="'NextStep', 'SameStep', 'Disabled'"):
        gymnasium.make_vec(ID, 2, **TASK, autoreset_mode="same")


def test_a_shields_name_does_not_say_which_robots_it_guards():
    with pytest.raises(ValueError, match=r"make_shield\('game', scenario\)"):
        checked_shield("game")


def test_actions_of_a_wrong_shape_are_not_stretched_to_fit():
    env = chasing()
    env.reset(seed=0)
    with pytest.raises(ValueError, match="shape"):
        env.step(np.float32(1.0))


def test_copies_go_on_where_the_original_was_and_go_their_own_ways():
    env = chasing()
    with pytest.raises(ResetNeeded):
        pickle.loads(pickle.dumps(env)).step(AHEAD)
    env.reset(seed=5)
    env.step(AHEAD)
    twins = [copy.deepcopy(env), pickle.loads(pickle.dumps(env))]
    expected = env.step(AHEAD)[0]
    following = env.reset()[0]
    for twin in twins:
        np.testing.assert_array_equal(twin.step(AHEAD)[0], expected)
        np.testing.assert_array_equal(twin.reset()[0], following)


def test_pictures_show_where_everybody_is():
    env = chasing(render_mode="rgb_array")
    env.reset(seed=0, options=at())
    first = env.render()
    for _ in range(5):
        env.step(AHEAD)
    later = env.render()
    assert first.shape == later.shape == (600, 600, 3)
    assert first.dtype == np.uint8
    changed = np.any(first != later, axis=-1)
    # The evader went from the middle to the right, not more than that.
    assert 0.001 < np.mean(changed) < 0.1
    assert changed[:, 300:330].any()
    vector = PursuedVectorEnv(2, **TASK, render_mode="rgb_array")
    vector.reset(seed=0)
    assert [frame.shape for frame in vector.render()] == [(600, 600, 3)] * 2


class Foreign(gymnasium.Env):
    """Somebody's own environment: NumPy and math, the pursuer turns and drives."""

    observation_space = gymnasium.spaces.Box(-np.inf, np.inf, (12,), np.float32)
    action_space = gymnasium.spaces.Box(-1.0, 1.0, (2,), np.float32)

    def __init__(self, scenario):
        self.task = PeerTask(scenario_to_dict(scenario), hold=1)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.task.reset()
        self.task.place((0.0, 0.0), (0.9, 0.1, np.pi), (0.0, 1.5), (2.0, 0.0))
        return self.task.observe(), {}

    def step(self, action):
        observation, reward, terminated, truncated = self.task.act(action)
        gap = np.hypot(*np.subtract(self.task.evader, self.task.pursuer[:2]))
        return observation, reward, terminated, truncated, {"gap": float(gap)}


def world_of(env):
    task = env.unwrapped.task
    return World(
        np.array(task.evader),
        np.array([task.pursuer]),
        np.array([[*task.obstacle, *task.c["obstacle_velocity"]]]),
        np.array(task.target),
    )


def test_the_shield_keeps_somebody_elses_robot_from_being_caught():
    scenario = load_scenario("paper", capture_distance=0.15)

    def drive(env):
        env.reset(seed=0)
        log = []
        for _ in range(220):
            *_, terminated, truncated, info = env.step(AHEAD)
            log.append(info)
            if terminated or truncated:
                break
        return log

    unguarded = drive(Foreign(scenario))
    assert unguarded[-1]["gap"] <= 0.15 + 0.01
    env = ShieldWrapper(
        Foreign(scenario),
        make_shield("game", scenario),
        world_of,
        velocity_of=lambda action, world: to_velocity(scenario, world, np.asarray(action)),
        action_of=lambda velocity, world: to_action(scenario, world, velocity),
    )
    with pytest.raises(ResetNeeded):
        env.step(AHEAD)
    for log in (drive(env), drive(env)):
        assert len(log) > len(unguarded)
        assert min(info["gap"] for info in log) > 0.15
        assert log[0]["status"] == Status.OK
        assert log[0]["executed"] is log[0]["proposed"] is AHEAD
        corrected = [info for info in log if info["status"] == Status.CORRECTED]
        assert corrected
        assert all(info["intervention"] > 0.0 for info in corrected)
        assert all(info["executed"].shape == (2,) for info in corrected)


@pytest.mark.parametrize("mode", [AutoresetMode.NEXT_STEP, AutoresetMode.SAME_STEP])
def test_the_shield_keeps_many_of_them_each_with_a_memory_of_its_own(mode):
    """The second robot starts an episode later than the first: then all is for it as it was for that."""
    scenario = load_scenario("paper", capture_distance=0.15, episode_steps=100)

    def worlds_of(env):
        return jax.tree.map(lambda *leaves: np.stack(leaves), *map(world_of, env.unwrapped.envs))

    inner = gymnasium.vector.SyncVectorEnv([lambda: Foreign(scenario)] * 2, autoreset_mode=mode)
    steer = jax.jit(jax.vmap(lambda world, action: to_velocity(scenario, world, action)))
    back = jax.jit(jax.vmap(lambda world, velocity: to_action(scenario, world, velocity)))
    env = ShieldVectorWrapper(
        inner,
        make_shield("game", scenario),
        worlds_of,
        velocities_of=lambda actions, worlds: steer(worlds, np.asarray(actions)),
        actions_of=lambda velocities, worlds: back(worlds, velocities),
    )
    with pytest.raises(ResetNeeded):
        env.step(np.stack([AHEAD] * 2))
    env.reset(seed=0)
    late = 40
    log, ended = [], []
    for count in range(210):
        if count == late:
            # Carried back to its start; as after any end of an episode there, its memory is gone.
            inner.envs[1].reset()
            env._fresh = np.array([False, True])
        *_, terminated, truncated, info = env.step(np.stack([AHEAD] * 2))
        assert info["executed"].shape == info["proposed"].shape == (2, 2)
        untouched = info["status"] == Status.OK
        np.testing.assert_array_equal(info["executed"][untouched], info["proposed"][untouched])
        log.append((info["status"], info["intervention"], info["_status"]))
        ended.append(terminated | truncated)
    status, intervention, told = (np.array(part) for part in zip(*log, strict=True))
    ended = np.array(ended)
    first, second = np.flatnonzero(ended[:, 0])[0] + 1, np.flatnonzero(ended[late:, 1])[0] + 1
    assert first == second
    assert np.any(status[:first, 0] == Status.CORRECTED)
    # Each episode as the one before it, or beside it.
    pause = 1 if mode is AutoresetMode.NEXT_STEP else 0
    length = min(first, 210 - first - pause)
    again = slice(first + pause, first + pause + length)
    np.testing.assert_array_equal(status[again, 0], status[:length, 0])
    np.testing.assert_allclose(intervention[again, 0], intervention[:length, 0], atol=1e-6)
    np.testing.assert_array_equal(status[late : late + first, 1], status[:first, 0])
    assert np.array_equal(np.flatnonzero(~told[:, 0]), np.flatnonzero(ended[:-1, 0]) + 1 if pause else [])
    assert min(np.min(one["gap"]) for one in [info]) > 0.15


def test_safety_gymnasium_gets_its_cost_third():
    env = SafetyGymnasiumWrapper(gymnasium.make(ID, **TASK))
    env.reset(seed=0)
    observation, _, cost, terminated, truncated, info = env.step(AHEAD)
    assert observation in env.observation_space
    assert (cost, terminated, truncated) == (info["cost"], False, False)
    foreign = SafetyGymnasiumWrapper(Foreign(SCENARIO))
    foreign.reset()
    with pytest.raises(KeyError, match="cost"):
        foreign.step(AHEAD)


class Lag(EvaderModel):
    """Runs up to what it is told; its constant is a plain number, as anyone would write it."""

    seconds: float = 0.05

    def after(self, scenario, robot, command, time):
        left, excess = jnp.exp(-time / self.seconds), robot.velocity - command
        place = robot.position + command * time + excess * self.seconds * (1.0 - left)
        return EvaderState(place, command + excess * left, robot.state)

    def control_point(self, scenario, robot):
        return robot.position + self.seconds * robot.velocity

    def offset(self, scenario):
        return self.seconds * scenario.evader_speed


def test_a_robot_of_ones_own_drives_in_the_environment_as_in_the_scenario():
    own = load_scenario("paper", evader_model=Lag(), capture_distance=0.15)
    env = gymnasium.make(ID, scenario=own, shield="none", pursuer="still", decision_steps=1).unwrapped
    env.reset(seed=0)
    before = env.world
    env.step(np.array([1.0, 0.0], np.float32))
    speed = float(jnp.linalg.norm(env.world.evader_velocity))
    assert speed == pytest.approx(0.1574 * (1.0 - np.exp(-1.0)), rel=1e-4)
    assert float(jnp.linalg.norm(env.world.evader - before.evader)) == pytest.approx(
        0.1574 * 0.05 * np.exp(-1.0), rel=1e-3
    )
