"""The ablation studies: do they compare what they say, and go on where they stopped?"""

import json
import sys
from pathlib import Path

import pytest

import ablation as study


def stored(name):
    data = json.loads((Path(study.__file__).parent / "results" / study.STUDIES[name].file).read_text())
    return data["runs"] if isinstance(data, dict) else data


@pytest.mark.parametrize("name", ["additions", "replay-action"])
def test_every_variant_is_a_training_that_can_be_asked_for(name):
    from sidestep.learning import make_options, options_to_dict

    made = []
    for options, fields in study.STUDIES[name].variants.values():
        settings = options_to_dict(make_options(**options)), fields
        assert str(settings) not in made, "two variants are the same training"
        made.append(str(settings))


@pytest.mark.parametrize("name", ["additions", "replay-action"])
def test_finished_study_is_tabulated_without_training_again(name, tmp_path, monkeypatch):
    runs = stored(name)
    out, table = tmp_path / "study.json", tmp_path / "table.md"
    out.write_text(json.dumps(runs))
    seeds = str(len({run["seed"] for run in runs}))
    asked = ["ablation", "--study", name, "--seeds", seeds, "--out", str(out), "--table", str(table)]
    monkeypatch.setattr(sys, "argv", asked)
    monkeypatch.setattr(study, "one_training", None)
    study.main()
    assert json.loads(out.read_text()) == runs
    rows = [line for line in table.read_text().splitlines() if line.startswith("| ")]
    for variant in study.STUDIES[name].variants:
        mine = sorted((run for run in runs if run["variant"] == variant), key=lambda run: run["seed"])
        assert len(mine) == int(seeds)
        closed = ", ".join(str(run["converged_episode"] or "never") for run in mine)
        assert any(row.startswith(f"| {variant} | {closed} |") for row in rows), variant


@pytest.mark.parametrize("other", [["--episodes", "7"], ["--shield", "paper"], ["--hidden", "8"]])
def test_trainings_with_other_settings_are_not_mixed(other, tmp_path, monkeypatch, capsys):
    out = tmp_path / "study.json"
    out.write_text(json.dumps(stored("replay-action")))
    monkeypatch.setattr(sys, "argv", ["ablation", "--study", "replay-action", "--out", str(out), *other])
    with pytest.raises(SystemExit):
        study.main()
    assert "other settings" in capsys.readouterr().err
