"""Hazards of the comparison: columns cut off in a terminal, a loss rounded away, figures mixed up."""

import copy
import io
import json
import shlex

import pytest
from rich.console import Console

from sidestep._program import command
from sidestep.commands.reproduce import Reproduce, command_line, comparison_tables
from sidestep.trials import wilson_interval
from sidestep.trials.reproduction import PAPER
from sidestep.views import comparison_sections, markdown_tables

SHIELDS = ("none", "paper", "game", "joint")


def evaluation(captured, collided, timed_out, reached):
    counts = {"captured": captured, "collided": collided, "timed_out": timed_out, "reached": reached}
    total = sum(counts.values())
    figures = {"episodes": total, "reach_time_median": 123.45 if reached else None}
    for name, count in counts.items():
        low, high = wilson_interval(count, total)
        figures |= {name: count, f"{name}_rate": count / total}
        figures |= {f"{name}_rate_low": low, f"{name}_rate_high": high}
    return figures | INTERFERENCE | CLEARANCES


INTERFERENCE = {"intervention_rate": 0.99996, "infeasible_rate": 0.00001, "mean_correction": 0.31479}
CLEARANCES = {"min_pursuer_clearance": -0.01234, "min_obstacle_clearance": None}
SCENE = {"outcome": "timed_out", "seconds": 5000.05, **INTERFERENCE, **CLEARANCES}
TRAINING = {
    "episodes": 200,
    "safe_episodes": 199,
    "captured": 1,
    "collided": 0,
    "converged_episode": None,
    "converged_stays_from": None,
    "converged_longest": [102, 200],
    "final_return": -123.4,
    **INTERFERENCE,
}


@pytest.fixture
def summary():
    """The widest that the figures of a study become."""
    study = {
        "training": TRAINING,
        "trained": evaluation(1, 0, 999, 99_000),
        "untrained": evaluation(100_000, 0, 0, 0),
        "scene_trained": SCENE,
        "scene_untrained": {**SCENE, "outcome": "reached"},
    }
    return copy.deepcopy({"paper": PAPER, "shields": dict.fromkeys(SHIELDS, study)})


def test_four_shields_fit_a_terminal_of_80_columns_and_nothing_is_cut_off(summary):
    screen = io.StringIO()
    sections = comparison_sections(summary)
    console = Console(file=screen, width=80)
    for table in comparison_tables(sections):
        console.print(table)
    shown = screen.getvalue()
    assert max(map(len, shown.splitlines())) <= 80
    assert "…" not in shown
    lines = iter(shown.splitlines())
    for section in sections:
        for _, cells in section.rows:
            # One line for each row: a cell that wraps would leave its rest on another.
            assert any(
                line.split()[-len(" ".join(cells).split()) :] == " ".join(cells).split() for line in lines
            )


def test_one_loss_in_many_episodes_is_not_rounded_away(summary):
    learned = dict(comparison_sections(summary)[1].rows)
    assert learned["captured"][1] == "0.1 %"
    assert learned["collided"][1] == "0 %"
    assert dict(comparison_sections(summary)[2].rows)["captured"][1] == "100 %"
    assert learned["periods corrected"][1] == "99.9 %"


def test_every_cell_is_under_its_own_shield(summary):
    for episode, shield in enumerate(SHIELDS):
        summary["shields"][shield] = copy.deepcopy(summary["shields"][shield])
        summary["shields"][shield]["training"]["converged_episode"] = 20 + episode
    training, *_, scene, untrained_scene = comparison_sections(json.loads(json.dumps(summary)))
    assert training.columns == ("reported", *SHIELDS)
    assert dict(training.rows)["first converged at"] == ("80", "20", "21", "22", "23")
    assert dict(training.rows)["  stays so from"] == ("-", *["never"] * 4)
    assert dict(training.rows)["  longest stay"] == ("-", *["102-200"] * 4)
    assert dict(scene.rows)["outcome"] == ("reached", *["timed out"] * 4)
    assert dict(untrained_scene.rows)["outcome"] == ("-", *["reached"] * 4)
    assert dict(scene.rows)["closest to collision, m"] == ("-",) * 5


def test_figure_that_is_missing_in_a_summary_is_not_passed_over(summary):
    del summary["shields"]["none"]["training"]["mean_correction"]
    with pytest.raises(KeyError, match="mean_correction"):
        comparison_sections(summary)


def test_summary_from_before_stays_were_kept_is_shown_without_them(summary):
    summary = json.loads(json.dumps(summary))
    for study in summary["shields"].values():
        del study["training"]["converged_stays_from"], study["training"]["converged_longest"]
    training = dict(comparison_sections(summary)[0].rows)
    assert training["  stays so from"] == training["  longest stay"] == ("-",) * 5


def test_markdown_has_a_table_for_each_section(summary):
    sections = comparison_sections(summary)
    text = markdown_tables(sections)
    rows = [line for line in text.splitlines() if line.startswith("|")]
    assert len(rows) == sum(len(section.rows) + 2 for section in sections)
    assert {row.count("|") for row in rows} == {7}


def test_the_command_to_run_it_again_works_when_pasted_and_names_what_was_changed(tmp_path):
    plain = command_line(Reproduce(seed=3))
    assert plain == f"{command('reproduce')} --out runs/reproduce-again --seed 3"
    changed = command_line(
        Reproduce(out=tmp_path / "it's", shields=("none", "joint"), set=("a=[1, 2]",), episodes=5)
    )
    words = shlex.split(changed)[len(shlex.split(command())) :]
    assert words[:3] == ["reproduce", "--out", f"{tmp_path}/it's-again"]
    again = " ".join(shlex.quote(word) for word in words[3:])
    assert again == "--shields none joint --episodes 5 --set 'a=[1, 2]' --seed 0"
