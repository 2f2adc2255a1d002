"""Hazards of bad numbers and names: a traceback, a message about something else, a silent zero."""

import re
import subprocess
import sys

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from sidestep import evaluate, load_scenario, make_shield, train
from sidestep._bounds import Bound, allowed
from sidestep.cli import _RUN, main
from sidestep.commands.evaluate import evaluation_table
from sidestep.commands.train import training_table
from sidestep.commands.video import Video
from sidestep.learning import make_options
from sidestep.loop import rollout
from sidestep.pursuit import Pursuer

SMALL = load_scenario("paper", obstacle_count=0, episode_steps=20)
SEEDS = (-1, 2**32, 99999999999999999999)
WORDS = r"must be a whole number from 0 to 2\^32 - 1"


@pytest.mark.parametrize("seed", SEEDS)
@pytest.mark.parametrize(
    "command", ["evaluate", "train --out r", "reproduce --out r", "falsify --out r", "twin", "fly", "play"]
)
def test_seed_out_of_range_is_refused_by_every_command(command, seed, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    shield = [] if command.startswith("reproduce") else ["--shield", "game"]
    assert main([*command.split(), *shield, "--seed", str(seed)]) == 2
    assert f"seed = {seed}: it must be a whole number from 0 to 2^32 - 1" in capsys.readouterr().err
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("seed", SEEDS)
def test_seed_out_of_range_is_refused_by_the_library(seed):
    with pytest.raises(ValueError, match=WORDS):
        evaluate(SMALL, "goal-seeking", "none", "still", 1, seed)
    with pytest.raises(ValueError, match=WORDS):
        rollout(SMALL, "goal-seeking", "none", "still", seed)
    with pytest.raises(ValueError, match=WORDS):
        train(SMALL, shield="none", seed=seed)


@pytest.mark.parametrize("seed", SEEDS)
def test_seed_out_of_range_is_refused_by_the_environments(seed):
    gym = pytest.importorskip("sidestep.bridges.gym")
    from sidestep.bridges.gym.duel import DuelEnv

    for make in (gym.PursuedEnv, DuelEnv):
        with pytest.raises(ValueError, match=WORDS):
            make("paper", shield="none", obstacle_count=0).reset(seed=seed)


@pytest.mark.parametrize("episodes", ["0", "-3"])
def test_no_episodes_is_what_the_refusal_speaks_of(episodes, capsys):
    assert main(["evaluate", "--episodes", episodes]) == 2
    assert f"episodes = {episodes}: it must be a whole number from 1 to" in capsys.readouterr().err


WORDS_OF = {
    "train": "train --out t", "evaluate": "evaluate", "reproduce": "reproduce --out r", "certify": "certify",
    "falsify": "falsify --out f", "play": "play", "report": "report run", "campaign": "campaign grid.toml",
    "export": "export run --out e.onnx", "twin": "twin --out t", "fly": "fly --out f",
}  # fmt: skip


def numeric_options():
    """Every numeric option of every command, with what none of them allows."""
    for command in _RUN:
        for owner in (command, *([Video] if "film" in allowed(command) else [])):
            for name, rule in allowed(owner).items():
                if isinstance(rule, Bound):
                    many = rule.shape[0] or 1 if rule.shape else 1
                    for value in ("-1", str(10**30)) if rule.whole else ("nan", "inf", "-1e300", "1e300"):
                        yield pytest.param(
                            command.__name__.lower(),
                            name,
                            [value] * many,
                            id=f"{command.__name__}-{name}-{value}",
                        )


@pytest.mark.parametrize("command, name, value", [*numeric_options()])
def test_number_that_cannot_be_is_refused_before_any_work(
    command, name, value, tmp_path, monkeypatch, capsys
):
    """A traceback, a video of a million pictures after the episode, a search that never ends."""
    monkeypatch.chdir(tmp_path)
    words = value if len(value) > 1 else [f"--{name.replace('_', '-')}={value[0]}"]
    option = [] if len(value) == 1 else [f"--{name.replace('_', '-')}"]
    assert main([*WORDS_OF[command].split(), *option, *words]) == 2
    told = capsys.readouterr().err
    assert re.fullmatch(rf"sidestep: {name} = \S.*: it must be .*\d.*\n", told), told
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("name", ["evaluate", "play", "twin", "report", "export --out e.onnx"])
def test_run_that_is_not_there_has_nothing_to_do_with_resuming(name, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    command, *options = name.split()
    assert main([command, str(tmp_path / "none"), *options]) == 2
    said = capsys.readouterr().err
    assert "none" in said
    assert "--resume" not in said


def test_built_in_policy_has_nothing_to_export(tmp_path, capsys):
    assert main(["export", "goal-seeking", "--out", str(tmp_path / "e.onnx")]) == 2
    assert "goal-seeking is built in" in capsys.readouterr().err


GUARDED = """
from sidestep.bridges.campaigns.cluster import check_main_guard

def run():
    check_main_guard()

{}
    run()
"""


@pytest.mark.parametrize(
    "line, words", [("if True:", ""), ("for _ in [0]:", ""), ('if __name__ == "__main__":', None)]
)
def test_script_that_workers_would_run_again_is_refused(line, words, tmp_path):
    pytest.importorskip("distributed")
    script = tmp_path / "script.py"
    script.write_text(GUARDED.format(line))
    done = subprocess.run([sys.executable, script], capture_output=True, text=True)
    if words is None:
        assert done.returncode == 0, done.stderr
    else:
        assert f"workers on this machine import {script}" in done.stderr.splitlines()[-1]


@pytest.mark.parametrize("shield", ["none", "paper", "game", "joint"])
@pytest.mark.parametrize("speed", [1e15, 1e20, 1e38, 3e38])
def test_huge_nominal_action_has_a_finite_correction(shield, speed):
    world = SMALL.reset(jax.random.key(0))
    made = make_shield(shield, SMALL)
    result, _ = made(world, jnp.array([speed, -speed], jnp.float32), made.init(world))
    assert np.isfinite(float(result.intervention))
    assert float(result.intervention) > 1e14
    assert np.all(np.isfinite(np.asarray(result.action)))


class Lost(Pursuer):
    """A pursuer that loses its way after half a second, as a network may."""

    def steer(self, scenario, world, key):
        return jnp.where(world.time < 0.5, scenario.pursuer_speed, jnp.nan) * jnp.ones(2)


def lost(scenario, world, key):
    return np.where(world.time < 0.5, 0.1, np.nan) * np.ones(2)


@pytest.mark.parametrize("pursuer", [Lost(), lost], ids=["strategy", "callable"])
def test_pursuer_without_finite_wheel_speeds_is_counted(pursuer):
    period = float(SMALL.control_period)
    good = round(0.5 / period)
    evaluation = evaluate(SMALL, "goal-seeking", "none", pursuer, 3, 0, batch=4)
    expected = np.maximum(evaluation.steps - good, 0)
    np.testing.assert_array_equal(evaluation.pursuer_invalid, expected)
    figures = evaluation.to_dict()
    assert figures["pursuer_invalid"] == expected.sum() > 0
    assert figures["pursuer_invalid_episodes"] == np.count_nonzero(expected)
    assert "not finite" in evaluation_table(evaluation).caption
    trajectory = rollout(SMALL, "goal-seeking", "none", pursuer, 0)
    assert trajectory.pursuer_invalid == trajectory.length - good
    still = trajectory.worlds.pursuers[good:]
    np.testing.assert_array_equal(still, np.broadcast_to(still[0], still.shape))


def test_training_counts_the_pursuer_that_stands_still():
    small = {"hidden": (8, 8), "batch_size": 8, "warmup_decisions": 10, "replay_capacity": 64}
    training = train(SMALL, shield="none", pursuer=Lost(), episodes=3, options=make_options(**small), chunk=5)
    good = round(0.5 / float(SMALL.control_period))
    counts = [max(line["steps"] - good, 0) for line in training.metrics]
    assert [line["pursuer_invalid"] for line in training.metrics] == counts
    assert training.summary["pursuer_invalid"] == sum(counts) > 0
    assert "not finite" in training_table(training.summary).caption


def test_finite_pursuer_is_not_mentioned():
    evaluation = evaluate(SMALL, "goal-seeking", "none", "nash", 2, 0, batch=4)
    assert evaluation.to_dict()["pursuer_invalid"] == 0
    assert "not finite" not in evaluation_table(evaluation).caption


def test_learner_that_steers_with_nan_is_seen_in_the_info():
    pytest.importorskip("pettingzoo")
    from sidestep.bridges.gym import PursuedEnv
    from sidestep.bridges.gym.duel import DuelEnv

    duel = DuelEnv("paper", shield="none", obstacle_count=0, decision_steps=3)
    duel.reset(seed=0)
    actions = {"evader": np.zeros(2, np.float32), "pursuer": np.array([0.1, np.nan], np.float32)}
    assert duel.step(actions)[-1]["evader"]["pursuer_invalid"] == 3
    single = PursuedEnv("paper", shield="none", pursuer=Lost(), obstacle_count=0, decision_steps=10)
    single.reset(seed=0)
    counts = [single.step(np.zeros(2, np.float32))[-1]["pursuer_invalid"] for _ in range(3)]
    good = round(0.5 / float(single.scenario.control_period))
    assert sum(counts) == 30 - good
