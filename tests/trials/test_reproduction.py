"""The study that compares shields: complete, resumable, never over something else."""

import json

import pytest

from sidestep.learning import make_options
from sidestep.store.runs import RunError
from sidestep.trials.reproduction import reproduce, test_scene_of
from sidestep.world import load_scenario

SMALL = {
    "episodes": 2,
    "evaluation_episodes": 8,
    "options": make_options(hidden=(8, 8), batch_size=8, warmup_decisions=4),
    "shields": ("game",),
    "seed": 3,
}


@pytest.fixture(scope="module")
def study(tmp_path_factory):
    out = tmp_path_factory.mktemp("study") / "out"
    scenario = load_scenario("paper", episode_steps=60)
    return out, scenario, reproduce(out, scenario=scenario, **SMALL)


def test_study_leaves_everything_it_reports(study):
    out, _, (game,) = study
    summary = json.loads((out / "summary.json").read_text())
    assert summary["shields"]["game"] == json.loads(json.dumps(game.to_dict()))
    assert game.training["episodes"] == 2
    assert game.trained["episodes"] == game.untrained["episodes"] == 8
    assert game.scene_trained.length <= 60
    for part in ("training", "trained", "untrained", "scene_trained", "scene_untrained"):
        figures = summary["shields"]["game"][part]
        assert 0.0 <= figures["infeasible_rate"] <= figures["intervention_rate"] <= 1.0
        assert 0.0 <= figures["mean_correction"] <= 2 * 0.1574
    assert summary["shields"]["game"]["scene_trained"]["seconds"] == pytest.approx(
        0.05 * game.scene_trained.length, abs=1e-4
    )
    for name in (
        "policy.npz",
        "episodes.npz",
        "evaluation.json",
        "evaluation_untrained.json",
        "test_scene.npz",
    ):
        assert (out / "game" / name).is_file()


def test_resume_keeps_finished_parts_and_repeats_missing_ones(study):
    out, scenario, (first,) = study
    policy = out / "game" / "policy.npz"
    trained_at = policy.stat().st_mtime_ns
    (out / "game" / "evaluation.json").unlink()
    (again,) = reproduce(out, scenario=scenario, resume=True, **SMALL)
    assert policy.stat().st_mtime_ns == trained_at
    assert again.to_dict() == first.to_dict()


def test_study_is_never_written_over_another(study):
    out, scenario, _ = study
    before = (out / "summary.json").read_bytes()
    with pytest.raises(RunError, match="--resume"):
        reproduce(out, scenario=scenario, **SMALL)
    with pytest.raises(RunError, match="other settings"):
        reproduce(out, scenario=scenario, resume=True, **{**SMALL, "seed": 4})
    assert (out / "summary.json").read_bytes() == before


def test_bad_shields_are_refused_before_anything_is_written(tmp_path):
    for shields in ((), ("game", "game"), ("gmae",)):
        with pytest.raises(ValueError, match="shield"):
            reproduce(tmp_path / "out", **{**SMALL, "shields": shields})
    with pytest.raises(ValueError, match="pursuer"):
        reproduce(tmp_path / "out", pursuer="nobody", **SMALL)
    assert not (tmp_path / "out").exists()


def test_company_that_the_test_scene_has_no_place_for_is_refused_before_anything_is_written(tmp_path):
    with pytest.raises(ValueError, match="obstacle_count"):
        reproduce(tmp_path / "out", scenario=load_scenario("paper", obstacle_count=3), **SMALL)
    assert not (tmp_path / "out").exists()


def test_test_scene_keeps_the_studied_constants():
    scene = test_scene_of(load_scenario("paper", evader_speed=0.18, obstacle_gain=2.0))
    assert float(scene.evader_speed) == pytest.approx(0.18)
    assert float(scene.obstacle_gain) == pytest.approx(2.0)
    assert scene.target_start is not None
    assert scene.target_start.tolist() == [2.5, 0.0]
