"""PettingZoo: a pursuer that learns, in an environment that its libraries' own tests accept."""

import warnings
from types import SimpleNamespace

import numpy as np
import pettingzoo
import pytest

with warnings.catch_warnings():
    # Its tests make environments of its own in a way that it deprecates.
    warnings.simplefilter("ignore", DeprecationWarning)
    from pettingzoo.test import (
        api_test,
        parallel_api_test,
        parallel_seed_test,
        performance_benchmark,
        seed_test,
    )

from sidestep.bridges.gym import duel
from sidestep.world import load_scenario

SCENARIO = load_scenario("paper", episode_steps=120)
TASK = {"scenario": SCENARIO, "shield": "none", "decision_steps": 3, "reward_scale": 0.01}
STOP, FULL = np.zeros(2, np.float32), np.ones(2, np.float32)
SCENE = {
    "evader": (0.0, 0.0),
    "pursuers": [(-0.7, 0.0, 0.0)],
    "obstacles": [(0.0, 2.0, 0.0, 0.0)],
    "target": (1.0, 0.0),
}

pytestmark = pytest.mark.filterwarnings("ignore:We recommend agents to be named in the format")


def parallel():
    return duel.parallel_env(**TASK)


def in_turn():
    return duel.env(**TASK)


def test_pettingzoos_tests_pass_for_agents_that_act_at_once():
    parallel_api_test(parallel(), num_cycles=100)
    parallel_seed_test(parallel, num_cycles=50)


def test_pettingzoos_tests_pass_for_agents_that_act_in_turn(monkeypatch):
    api_test(in_turn(), num_cycles=100)
    seed_test(in_turn, num_cycles=50)
    # It runs for five seconds of the clock that it is shown.
    clock = iter(range(100))
    monkeypatch.setitem(performance_benchmark.__globals__, "time", SimpleNamespace(time=lambda: next(clock)))
    performance_benchmark(in_turn())


def test_it_is_registered_with_pettingzoo():
    assert isinstance(pettingzoo.make("parallel", duel.ID, **TASK).unwrapped, duel.DuelEnv)


def test_a_pursuer_that_drives_on_catches_an_evader_that_stands_and_gets_what_the_evader_loses():
    env = parallel()
    env.reset(seed=0, options={"world": SCENE})
    rewards = []
    while env.agents:
        observations, gains, ends, cuts, infos = env.step({"evader": STOP, "pursuer": FULL})
        assert all(observations[agent] in env.observation_space(agent) for agent in observations)
        assert sum(gains.values()) == pytest.approx(0.0, abs=1e-9)
        rewards.append(gains["pursuer"])
    assert ends == {"evader": True, "pursuer": True}
    assert cuts == {"evader": False, "pursuer": False}
    assert infos["pursuer"]["captured"]
    assert rewards[-1] == pytest.approx(0.01 * 1000.0, rel=0.01)
    # 0.5 m at 0.2 m/s, in steps of 0.15 s.
    assert len(rewards) == pytest.approx(0.5 / 0.2 / 0.15, abs=1)
    assert env.step({}) == ({}, {}, {}, {}, {})


def test_a_pursuer_sees_the_same_wherever_the_scene_lies():
    env = parallel()
    first, _ = env.reset(seed=0, options={"world": SCENE})
    turn, moved = 0.7, np.array([3.0, -2.0])
    spin = np.array([[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]])

    def there(point):
        return spin @ np.array(point) + moved

    world = {
        "evader": there(SCENE["evader"]),
        "pursuers": [(*there(SCENE["pursuers"][0][:2]), turn)],
        "obstacles": [(*there(SCENE["obstacles"][0][:2]), 0.0, 0.0)],
        "target": there(SCENE["target"]),
    }
    again, _ = env.reset(options={"world": world})
    for agent in first:
        np.testing.assert_allclose(again[agent], first[agent], atol=1e-5)
    # The evader is 0.7 m straight ahead, the target 1.7 m.
    np.testing.assert_allclose(first["pursuer"][:2], (0.7 / 1.7, 0.0), atol=1e-6)
    np.testing.assert_allclose(first["pursuer"][-2:], (1.7 / 2.7, 0.0), atol=1e-6)


@pytest.mark.slow
def test_several_pursuers_share_what_the_evader_loses_and_each_has_its_own_wheels():
    env = duel.parallel_env(
        **{**TASK, "decision_steps": 1, "scenario": load_scenario("paper", pursuer_count=2)}
    )
    env.reset(seed=1)
    before = np.asarray(env.world.pursuers)
    _, gains, *_ = env.step({"evader": STOP, "pursuer_0": FULL, "pursuer_1": STOP})
    assert gains["pursuer_0"] == gains["pursuer_1"] == pytest.approx(-gains["evader"] / 2.0)
    went = np.linalg.norm(np.asarray(env.world.pursuers)[:, :2] - before[:, :2], axis=-1)
    np.testing.assert_allclose(went, (0.2 * 0.05, 0.0), atol=1e-5)
    with pytest.raises(ValueError, match="pursuer_1"):
        env.step({"evader": STOP, "pursuer_0": FULL})


def test_a_strategy_for_the_pursuers_is_refused():
    with pytest.raises(ValueError, match="in DuelEnv the pursuers learn"):
        duel.DuelEnv(pursuer="nash")
