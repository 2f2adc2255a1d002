"""The studies of many episodes: do they count right, and go on where they stopped?"""

import json
import sys

import jax.numpy as jnp
import numpy as np
import pytest

import many_episodes as study
from sidestep.world import load_scenario, observation_names


@pytest.fixture
def run(tmp_path, monkeypatch):
    """`run("--blocks", "2")`: the command on a small study; its report."""

    def call(*options):
        out = tmp_path / "captures.json"
        few = ["--pursuers", "turn-then-drive", "--policies", "reckless", "--block", "64"]
        arguments = ["many_episodes", "game", "--out", str(out), *few, "--set", "episode_steps=200", *options]
        monkeypatch.setattr(sys, "argv", arguments)
        study.main()
        return json.loads(out.read_text())

    return call


def test_an_interrupted_study_goes_on_and_comes_to_the_same(run, monkeypatch, capsys):
    whole_block, calls = study.run_block, []

    def interrupted(job):
        calls.append(job)
        if len(calls) == 2:
            raise KeyboardInterrupt
        return whole_block(job)

    monkeypatch.setattr(study, "run_block", interrupted)
    first = run("--blocks", "2")
    assert first["total"]["episodes"] == 64
    assert "goes on after the 1 blocks" in capsys.readouterr().out
    second = run("--blocks", "2")
    assert [job[4] for job in calls] == [0, 1, 1]
    assert second["total"]["episodes"] == 128
    # Each block has its own starts, and is the same whenever it is run.
    blocks = second["blocks"]
    assert blocks[0] == first["blocks"][0]
    assert blocks[0]["smallest_distance"] != blocks[1]["smallest_distance"]
    again = whole_block(calls[0])
    assert {k: v for k, v in again.items() if k != "seconds"} == {
        k: v for k, v in blocks[0].items() if k != "seconds"
    }
    # Nothing but time has ended an episode, and the shield had to work for that.
    total = second["total"]
    assert total["captured"] == total["reached"] == 0
    assert total["env_steps"] == 128 * 200
    assert total["smallest_distance"] > 0.2
    assert total["corrected_steps"] > 0.2 * total["env_steps"]
    assert total["captured_rate_one_sided_95"] == pytest.approx(3.0 / 128, rel=0.05)
    with pytest.raises(SystemExit, match="other settings"):
        run("--seed", "1")


def test_captures_are_counted_and_can_be_found_again():
    blocks = [
        {"pursuer": p, "policy": "stay", "block": b, "episodes": 10, "captured": c, "collided": 0,
         "reached": 0, "timed_out": 10 - c, "env_steps": 5, "smallest_distance": d,
         "smallest_obstacle_distance": None, "corrected_steps": 1, "corrections": 0.5,
         "infeasible_steps": 0, "lost": {}, "seconds": 1.0}
        for p, b, c, d in (("nash", 0, 2, 0.19), ("nash", 1, 0, 0.21), ("still", 0, 0, 0.2))
    ]  # fmt: skip
    report = study.summary(blocks)
    assert report["total"]["captured"] == 2
    assert report["total"]["smallest_distance"] == 0.19
    assert report["total"]["smallest_obstacle_distance"] is None
    assert report["total"]["mean_correction"] == pytest.approx(0.1)
    assert "captured_rate_one_sided_95" not in report["total"]
    assert report["total"]["captured_rate_low"] < 2 / 30 < report["total"]["captured_rate_high"]
    assert [each["episodes"] for each in report["each"]] == [20, 10]


def test_the_policies_never_finish_and_do_what_they_are_called():
    scenario = load_scenario("paper", **study.STUDIES["game"].fields)
    names = observation_names(scenario)
    assert names[1] == "target_near"
    assert [name.split("_")[1] for name in names[2:4]] == ["x", "y"]
    far, near = (jnp.zeros(len(names)).at[1].set(np.exp(-d / 0.25)) for d in (0.03, 0.01))
    np.testing.assert_array_equal(study._policy("stay")(far), [1.0, 0.0])
    np.testing.assert_array_equal(study._policy("stay")(near), [0.0, 0.0])
    seen = far.at[2:4].set(jnp.array([-0.3, 0.4]))
    np.testing.assert_allclose(study._policy("reckless")(seen), [-0.6, 0.8], rtol=1e-6)


def test_the_joint_studies_ask_for_what_they_say():
    joint = study.STUDIES["joint"]
    assert joint.block * joint.blocks["nash"] == 20_000
    assert joint.block * joint.other == 5_000
    three = study.STUDIES["three-obstacles"]
    assert three.block * three.blocks["nash"] == 5_000
    assert three.fields["obstacle_count"] == 3
