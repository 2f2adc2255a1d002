"""Hazard: a kill at some moment that loses or changes something, or a study that would not see it."""

import pytest

import kills


def test_killed_training_ends_as_if_nothing_had_been(capsys):
    assert kills.main(["train", "--kills", "2", "--episodes", "30", "--seed", "1"]) == 0
    assert "train: 2 kills" in capsys.readouterr().out


@pytest.mark.slow
@pytest.mark.parametrize("command", ["train", "reproduce", "campaign"])
def test_killed_command_ends_as_if_nothing_had_been(command):
    assert kills.main([command, "--kills", "20"]) == 0


def test_one_changed_bit_is_seen_and_a_time_is_not(tmp_path):
    for name in ("one", "other"):
        (tmp_path / name).mkdir()
        (tmp_path / name / "metrics.jsonl").write_text("{}\n")
        (tmp_path / name / "summary.json").write_text(f'{{"episodes": 3, "wall_seconds": {len(name)}}}')
    one, other = (kills.contents(tmp_path / name) for name in ("one", "other"))
    assert kills.differing(one, other) == []
    (tmp_path / "other" / "metrics.jsonl").write_text("{ }\n")
    (tmp_path / "other" / "policy.npz.torn").write_text("")
    assert kills.differing(one, kills.contents(tmp_path / "other")) == ["metrics.jsonl", "policy.npz.torn"]
