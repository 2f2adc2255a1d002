"""Hazard: the study of learners measures something else, or begins anew what it has."""

import json

import pytest

import learners


def study(monkeypatch, out, *names, seeds="1"):
    words = ["--minutes", "0.001", "--seeds", seeds, "--pursuers", "still", "--episodes", "4"]
    words += ["--trial-shield", "game"]
    monkeypatch.setattr("sys.argv", ["learners.py", "--out", str(out), "--learners", *names, *words])
    assert learners.main() == 0
    return json.loads(out.read_text())["rows"]


def test_a_study_goes_on_and_compares(monkeypatch, tmp_path, capsys):
    first = study(monkeypatch, tmp_path / "study.json", "goal-seeking")
    monkeypatch.setattr(learners, "evaluate", None)
    again = study(monkeypatch, tmp_path / "study.json", "goal-seeking")
    assert again == first
    assert [(row["learner"], row["seed"], row["pursuer"]) for row in first] == [("goal-seeking", 0, "still")]
    assert first[0]["time_mean"] > 5.0
    assert f"{first[0]['time_mean']:.1f} s (" in capsys.readouterr().out


@pytest.mark.slow
def test_ours_stops_after_its_minutes(monkeypatch, tmp_path):
    rows = study(monkeypatch, tmp_path / "study.json", "goal-seeking", "many-worlds")
    assert {row["learner"] for row in rows} == {"goal-seeking", "many-worlds"}
    # It has had no time to learn anything.
    assert rows[1]["reached"] <= rows[0]["reached"]
