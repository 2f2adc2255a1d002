"""Hazards of campaign files: a job asked for twice or taken for another, an error found after a night."""

import dataclasses
from pathlib import Path

import pytest

from sidestep.trials.campaign import CampaignError, load_campaign
from sidestep.trials.campaign.jobs import identity

ROOT = Path(__file__).parents[2]
SMALL = '[scenarios.small]\nobstacle_count = 0\n[grid]\nscenario = "small"\n'


@pytest.fixture
def load(tmp_path):
    def load(text):
        (tmp_path / "grid.toml").write_text(text)
        return load_campaign(tmp_path / "grid.toml")

    return load


def test_example_of_the_documentation_is_a_campaign():
    campaign = load_campaign(ROOT / "examples" / "campaign.toml")
    assert len(campaign.jobs) == 5 * 2 * 3 * 2
    assert len({job.id for job in campaign.jobs}) == len(campaign.jobs)
    assert campaign.compare.by == ("shield",)


def test_study_of_ten_seeds_is_a_campaign():
    campaign = load_campaign(ROOT / "examples" / "study.toml")
    assert len(campaign.jobs) == 10 * 4
    assert {job.settings["episodes"] for job in campaign.jobs} == {200}


def test_every_combination_is_one_job_and_seeds_are_the_last_to_change_program(load):
    campaign = load(SMALL + 'seed = [3, 1]\nshield = ["none", "game"]\n[settings]\nepisodes = 7\n')
    labels = [(job.labels["shield"], job.labels["seed"]) for job in campaign.jobs]
    assert labels == [("none", 3), ("none", 1), ("game", 3), ("game", 1)]
    for job in campaign.jobs:
        assert (job.settings["shield"], job.settings["seed"]) == (job.labels["shield"], job.labels["seed"])
        assert (job.settings["episodes"], job.settings["pursuer"]) == (7, "nash")
        assert job.settings["scenario"]["obstacle_count"] == 0


def test_identity_follows_what_decides_the_result_and_nothing_else(load):
    (job,) = load(SMALL).jobs
    (renamed,) = load(SMALL.replace("small", "tiny")).jobs
    assert renamed.id == job.id
    assert identity(dict(reversed(job.settings.items()))) == job.id
    for text in (
        SMALL + "seed = 1",
        SMALL + 'pursuer = "still"',
        SMALL + 'shield = "game"',
        SMALL + "[settings]\nepisodes = 99",
        SMALL.replace("[grid]", "control_period = 0.04\n[grid]"),
    ):
        (other,) = load(text).jobs
        assert other.id != job.id, text


def test_identity_stays_what_it_was():
    # Results that people have would all be run again.
    assert identity({"kind": "evaluate", "seed": 0}) == "45bdbe0f2f5051d795aa"


def test_learners_are_an_axis_of_trainings(load):
    campaign = load(
        'kind = "train"\n' + SMALL + 'learner = ["default", "patient"]\nseed = { first = 4, count = 2 }\n'
        "[learners.patient]\ndiscount = 0.995\n[settings]\nepisodes = 3\n"
    )
    assert [(job.labels["learner"], job.labels["seed"]) for job in campaign.jobs] == [
        ("default", 4), ("default", 5), ("patient", 4), ("patient", 5),
    ]  # fmt: skip
    discounts = [job.settings["learner"]["discount"] for job in campaign.jobs]
    assert discounts[2:] == [0.995, 0.995]
    assert discounts[0] != 0.995


@pytest.mark.parametrize(
    "text, named",
    [
        ("a = ", "cannot be read"),
        ("[grid]\nseed = 1\nseed = 2", "cannot be read"),
        ('[gird]\nshield = "none"', "'gird' is unknown; did you mean 'grid'?"),
        ('[grid]\nsheild = "none"', "'grid.sheild' is unknown; did you mean 'shield'?"),
        ('[grid]\nlearner = "default"', "'grid.learner' is unknown"),
        ('kind = "dance"', "'kind' = 'dance'"),
        ('[grid]\nshield = "shiny"', "'grid.shield' names 'shiny'"),
        ('[grid]\npursuer = "nobody"', "'grid.pursuer' names 'nobody'"),
        ('[grid]\nscenario = "nowhere"', "'grid.scenario' names 'nowhere'"),
        ('[grid]\npolicy = "runs/none"', "'grid.policy' names 'runs/none'"),
        ("[grid]\nshield = []", "'grid.shield' is empty"),
        ("[grid]\nshield = [1]", "'grid.shield' holds 1"),
        ('[grid]\nshield = ["none", "none"]', "holds 'none' twice"),
        ("[grid]\nseed = [1, 2, 1]", "holds 1 twice"),
        ("[grid]\nseed = -1", "'grid.seed' = -1"),
        ("[grid]\nseed = true", "'grid.seed' = True"),
        ("[grid]\nseed = 4294967296", "less than"),
        ("[grid]\nseed = { first = 1 }", "needs a count"),
        ("[grid]\nseed = { count = 99999999999 }", "at most"),
        ("[settings]\nepisodes = 0", "'settings.episodes' = 0"),
        ("[settings]\nepsiodes = 1", "did you mean 'episodes'?"),
        ("[scenarios.mine]\nevader_speed = 1.0", "grid.scenario does not name it"),
        ('[grid]\nscenario = "mine"\n[scenarios.mine]\nevader_sped = 1.0', "did you mean 'evader_speed'?"),
        ('kind = "train"\n[grid]\nlearner = "quick"', "no table [learners.quick]"),
        ('kind = "train"\n[grid]\nlearner = "a"\n[learners.a]\ndiscount = 2', "discount"),
        ('[compare]\nby = ["shield"]\nfigures = ["reached_rat"]', "did you mean 'reached_rate'?"),
        ('[compare]\nby = ["seed"]\nfigures = ["x"]', "'compare.by' holds 'seed'"),
        ('[compare]\nby = ["shield"]', "'compare.figures' is needed"),
        ('[compare]\nby = "shield"\nfigures = ["x"]', "list of names"),
        (
            '[compare]\nby = ["shield"]\nfigures = ["reached"]\nlower_is_better = ["y"]',
            "compare.figures does not",
        ),
    ],
)
def test_bad_file_is_refused_with_its_name_the_key_and_what_is_allowed(load, tmp_path, text, named):
    with pytest.raises(CampaignError) as refused:
        load(text)
    assert named in str(refused.value)
    assert str(tmp_path / "grid.toml") in str(refused.value)


def test_missing_file_is_named(tmp_path):
    with pytest.raises(CampaignError, match="no campaign file"):
        load_campaign(tmp_path / "none.toml")


def test_one_scenario_under_two_names_is_refused(load):
    text = (
        '[grid]\nscenario = ["a", "b"]\n[scenarios.a]\nobstacle_count = 0\n[scenarios.b]\nobstacle_count = 0'
    )
    with pytest.raises(CampaignError, match="the same job twice"):
        load(text)


def test_files_are_looked_for_beside_the_campaign(load, tmp_path):
    (tmp_path / "yard.toml").write_text("obstacle_count = 0\narena_side = 7.0")
    (job,) = load('[grid]\nscenario = "yard.toml"').jobs
    assert job.labels["scenario"] == "yard.toml"
    assert job.settings["scenario"]["arena_side"] == 7.0


def test_jobs_cannot_be_changed_after_their_identity_is_told(load):
    (job,) = load(SMALL).jobs
    with pytest.raises(dataclasses.FrozenInstanceError):
        job.id = "another"
