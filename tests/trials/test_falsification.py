"""Hazards of a search for counterexamples: finding none where there are many, losing or misreporting them."""

import io
import json

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from sidestep.cli import main
from sidestep.learning import Actor, LearnedPolicy
from sidestep.safety import PaperShield, make_shield
from sidestep.store.runs import read_metrics
from sidestep.trials.falsification import (
    CounterexampleError,
    Plan,
    falsify,
    read_counterexample,
    replay,
    write_counterexample,
)
from sidestep.trials.falsification.counterexamples import describe_policy, shield_name
from sidestep.world import load_scenario, observation_size

SMALL = Plan(attacks=("bang-bang",), goal="capture", batch=32, seconds=10.0, most=2)


@pytest.fixture(scope="module")
def scenario():
    return load_scenario("paper", obstacle_count=0)


@pytest.fixture(scope="module")
def found(scenario, tmp_path_factory):
    """A search against the paper's shield that is stopped by Ctrl-C after its second round."""
    seen = []

    def stop(progress):
        seen.append(progress)
        if progress.tally.rounds == 2:
            raise KeyboardInterrupt

    out = tmp_path_factory.mktemp("search") / "out"
    search = falsify(scenario, "goal-seeking", "paper", out=out, plan=SMALL, episodes=96, progress=stop)
    assert [progress.attack for progress in seen] == ["bang-bang"] * 2
    assert seen[-1].counterexamples == len(search.counterexamples)
    return search


def test_captures_of_the_papers_shield_are_found(found):
    summary = found.summary
    assert summary["captured"] >= 2
    assert summary["kept"] == len(found.counterexamples) >= 2
    assert summary["attacks"]["bang-bang"]["pursuer_clearance"] < 0.0
    assert set(summary["by_assumption"]) <= {"forwards", "row", "straight"}
    assert not found.inside
    assert summary["first_seconds"] > 0.0


def test_interrupted_search_keeps_what_it_found(found):
    assert found.interrupted
    assert json.loads((found.folder / "summary.json").read_text()) == found.summary
    assert all(path.stat().st_size < 20_000 for path in found.counterexamples)
    listed = [entry["file"] for entry in found.summary["counterexamples"]]
    on_disk = sorted((found.folder / "counterexamples").iterdir())
    assert sorted(found.folder / name for name in listed) == on_disk


def test_resumed_search_goes_on_as_if_it_had_never_stopped(scenario, found, tmp_path):
    straight = falsify(scenario, "goal-seeking", "paper", out=tmp_path / "s", plan=SMALL, episodes=96)
    before = (found.folder / "metrics.jsonl").read_bytes()
    resumed = falsify(scenario, "goal-seeking", "paper", out=found.folder, episodes=96, resume=True)
    assert (found.folder / "metrics.jsonl").read_bytes().startswith(before)
    assert resumed.summary["episodes"] == straight.summary["episodes"] == 96

    def timeless(folder):
        lines = read_metrics(folder)
        for line in lines:
            line["counterexamples"] = [entry["file"] for entry in line["counterexamples"]]
        return [{k: v for k, v in line.items() if k not in ("seconds", "at")} for line in lines]

    assert timeless(resumed.folder) == timeless(straight.folder)
    for one, other in zip(resumed.counterexamples, straight.counterexamples, strict=True):
        assert one.read_bytes() == other.read_bytes()


def test_no_more_are_kept_than_asked_for_unless_they_go_deeper(found):
    depths = [entry["pursuer_clearance"] for entry in found.summary["counterexamples"]]
    for number in range(SMALL.most, len(depths)):
        assert depths[number] < min(depths[:number]) - 0.9e-4


def test_counterexample_plays_again_to_the_last_bit(found):
    for path in found.counterexamples:
        counterexample = read_counterexample(path)
        played = replay(counterexample)
        assert played.same
        assert played.exact
        assert played.trajectory.outcome == "captured"
        assert played.trajectory.length == counterexample.about["steps"] == len(counterexample.wheels)
        again = float(np.min(played.trajectory.events.pursuer_clearance))
        assert again == counterexample.about["pursuer_clearance"]


def test_another_shield_is_not_taken_for_the_same(found):
    counterexample = read_counterexample(found.counterexamples[0])
    played = replay(counterexample, shield="none")
    assert not played.exact


def test_edited_counterexample_is_refused(found, tmp_path):
    with np.load(found.counterexamples[0]) as archive:
        arrays = {name: archive[name] for name in archive.files}
    names = json.loads(bytes(arrays["names"]))
    place = f"leaf{names.index(next(name for name in names if 'about' in name))}"
    text = bytes(arrays[place]).replace(b'"captured"', b'"collided"')
    assert text != bytes(arrays[place])
    np.savez(tmp_path / "edited.npz", **{**arrays, place: np.frombuffer(text, np.uint8)})
    with pytest.raises(CounterexampleError, match="cannot be edited"):
        read_counterexample(tmp_path / "edited.npz")


@pytest.mark.parametrize("cut", [10, 1000])
def test_damaged_counterexample_is_refused(found, tmp_path, cut):
    (tmp_path / "cut.npz").write_bytes(found.counterexamples[0].read_bytes()[:-cut])
    with pytest.raises(CounterexampleError, match="damaged"):
        read_counterexample(tmp_path / "cut.npz")


def test_other_files_are_no_counterexamples(found, tmp_path):
    buffer = io.BytesIO()
    np.savez(buffer, a=np.zeros(3))
    (tmp_path / "other.npz").write_bytes(buffer.getvalue())
    for name in ("other.npz", "missing.npz"):
        with pytest.raises(CounterexampleError, match=name):
            read_counterexample(tmp_path / name)
    stale = read_counterexample(found.counterexamples[0])
    for change, words in (({"format": 99}, "another version"), ({"format": 1}, "lacks")):
        about = {**stale.about, **change}
        if words == "lacks":
            del about["outcome"]
        write_counterexample(tmp_path / "stale.npz", type(stale)(about, stale.world, stale.wheels, stale.end))
        with pytest.raises(CounterexampleError, match=words):
            read_counterexample(tmp_path / "stale.npz")


def test_policy_with_other_weights_is_refused(scenario, found):
    counterexample = read_counterexample(found.counterexamples[0])
    actor = Actor(observation_size(scenario), 2, (4,), jax.random.key(0))
    policy = LearnedPolicy(actor, 1)
    about = {**counterexample.about, "policy": describe_policy(policy, "runs/mine")}
    learned = type(counterexample)(about, counterexample.world, counterexample.wheels, counterexample.end)
    other = eqx.tree_at(lambda p: p.actor.body.biases[0], policy, jnp.ones(4))
    with pytest.raises(CounterexampleError, match="no longer the one"):
        replay(learned, policy=other)
    with pytest.raises(CounterexampleError, match=r"runs/mine.*--policy"):
        replay(learned)
    nameless = type(counterexample)(
        {**about, "policy": describe_policy(lambda observation: observation[:2])},
        counterexample.world,
        counterexample.wheels,
        counterexample.end,
    )
    with pytest.raises(CounterexampleError, match="give the policy"):
        replay(nameless)


def test_only_a_shield_as_made_goes_by_its_name(scenario):
    assert shield_name("game", scenario) == "game"
    assert shield_name(make_shield("paper", scenario), scenario) == "paper"
    stronger = eqx.tree_at(lambda s: s.pursuer_gain, scenario, jnp.asarray(9.0))
    assert shield_name(PaperShield(stronger), scenario) == "custom"


def test_existing_folder_is_never_overwritten(scenario, found):
    with pytest.raises(ValueError, match="--resume"):
        falsify(scenario, "goal-seeking", "paper", out=found.folder, plan=SMALL, episodes=1)


def test_only_a_search_can_be_resumed(scenario, tmp_path):
    with pytest.raises(ValueError, match="does not exist; leave out --resume"):
        falsify(scenario, "goal-seeking", "paper", out=tmp_path / "none", episodes=1, resume=True)
    (tmp_path / "config.json").write_text("{}")
    with pytest.raises(ValueError, match="no search"):
        falsify(scenario, "goal-seeking", "paper", out=tmp_path, episodes=1, resume=True)


@pytest.mark.parametrize(
    "changes, words",
    [
        ({"goal": "fame"}, "goal = 'fame'"),
        ({"goal": "collision"}, "no obstacle"),
        ({"attacks": ("pursuers", "tickle")}, "tickle"),
        ({"attacks": ()}, "attacks"),
        ({"attacks": ("edge", "edge")}, "only once"),
        ({"batch": 0}, "batch = 0"),
        ({"most": 0}, "most = 0"),
        ({"seed": -1}, "seed = -1"),
        ({"seconds": float("nan")}, "seconds"),
    ],
)
def test_senseless_search_is_refused_before_anything_is_written(scenario, tmp_path, changes, words):
    with pytest.raises(ValueError, match=words):
        falsify(scenario, "goal-seeking", "paper", out=tmp_path / "out", plan=Plan(**changes), episodes=1)
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize("budget, words", [({"minutes": 0.0}, "minutes"), ({"episodes": 0}, "episodes")])
def test_senseless_budget_is_refused(scenario, tmp_path, budget, words):
    with pytest.raises(ValueError, match=words):
        falsify(scenario, "goal-seeking", "paper", out=tmp_path / "out", plan=SMALL, **budget)


def test_replay_from_the_command_line_shows_what_happened(found, tmp_path, capsys):
    path = found.counterexamples[0]
    out, figures = tmp_path / "shown", tmp_path / "figures.json"
    video = ["--video", str(tmp_path / "x.webp"), "--video-rate", "1", "--video-width", "160"]
    assert main(["falsify", "--replay", str(path), "--out", str(out), "--json", str(figures), *video]) == 0
    assert (tmp_path / "x.webp").read_bytes()[8:12] == b"WEBP"
    told = capsys.readouterr().out
    assert "to the last bit" in told
    assert "Assumption broken" in told
    assert (out / f"{path.stem}.png").stat().st_size > 10_000
    facts = json.loads(figures.read_text())
    assert facts["same"]
    assert facts["exact"]
    assert facts["outcome"] == "captured"
    (tmp_path / "bad.npz").write_bytes(path.read_bytes()[:-100])
    assert main(["falsify", "--replay", str(tmp_path / "bad.npz")]) == 2
    assert "damaged" in capsys.readouterr().err


def test_search_from_the_command_line_reports_what_it_found(tmp_path, capsys):
    out, figures = tmp_path / "out", tmp_path / "figures.json"
    small = ["--batch", "32", "--seconds", "10", "--episodes", "32", "--most", "1"]
    asked = ["falsify", "--shield", "paper", "--attacks", "bang-bang", "--goal", "capture"]
    asked += ["--set", "obstacle_count=0", "--out", str(out), "--json", str(figures), *small]
    assert main(asked) == 0
    told = capsys.readouterr().out
    assert "bang-bang" in told
    assert "sidestep falsify --replay" in told
    summary = json.loads(figures.read_text())
    assert summary["episodes"] == 32
    assert summary["captured"] >= summary["kept"] >= 1
    for entry in summary["counterexamples"]:
        name = entry["file"].removeprefix("counterexamples/").removesuffix(".npz")
        assert (out / "figures" / f"{name}.png").stat().st_size > 10_000
    assert main([*asked, "--goal", "fame"]) == 2
    assert main(asked) == 2
    assert "--resume" in capsys.readouterr().err
