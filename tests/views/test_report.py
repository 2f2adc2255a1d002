"""Hazards of the report: it needs the network, contradicts the data, or breaks on a half-done run."""

import base64
import json
import re
from dataclasses import replace
from html.parser import HTMLParser

import pytest

from sidestep.loop import save_trajectory
from sidestep.store.files import write_json
from sidestep.store.runs import RunError, append_metrics, create_run
from sidestep.trials import wilson_interval
from sidestep.views import load_run, style, write_report


class Links(HTMLParser):
    """Everything a browser would load, and the text it would show."""

    def __init__(self):
        super().__init__()
        self.loads, self.tags, self.text = [], [], []

    def handle_starttag(self, tag, attrs):
        self.tags.append(tag)
        values = dict(attrs)
        self.loads += [values[name] for name in ("src", "href", "srcset", "data", "poster") if name in values]
        if tag == "img":
            assert values.get("alt")

    def handle_data(self, data):
        self.text.append(data)


def read(path):
    page = Links()
    page.feed(path.read_text(encoding="utf-8"))
    page.words = re.sub(r"\s+", " ", " ".join(page.text))
    return page


def evaluation(captured=12):
    counts = {
        "captured": captured,
        "collided": 1,
        "timed_out": 0,
        "reached": 99 - captured,
        "safe": 99 - captured,
    }
    report = {"episodes": 100, "reach_time_median": None, "min_obstacle_clearance": None}
    for name, count in counts.items():
        low, high = wilson_interval(count, 100)
        report |= {
            name: count,
            f"{name}_rate": count / 100,
            f"{name}_rate_low": low,
            f"{name}_rate_high": high,
        }
    rates = ("intervention_rate", "infeasible_rate", "mean_correction", "min_pursuer_clearance")
    return report | dict.fromkeys(rates, 0.01)


@pytest.fixture
def quick(monkeypatch):
    """For tests of the words only: figures are made and not rendered, which takes most of the time."""
    dot = base64.b64decode(
        "iVBORw0KGgoAAAANSUhEUgAAAAEAAAABCAYAAAAfFcSJAAAADUlEQVR42mNk+M9QDwADhgGAWjR9awAAAABJRU5ErkJggg=="
    )

    def save(figure, path):
        png, pdf = style.figure_files(path)
        png.parent.mkdir(parents=True, exist_ok=True)
        png.write_bytes(dot)
        return png, pdf

    monkeypatch.setattr(style, "save", save)


@pytest.fixture(scope="module")
def whole(tmp_path_factory, chase, run_of, survey_of):
    """A report with everything in it."""
    paper = replace(
        run_of("paper", ["captured"] * 4 + ["reached"] * 30),
        evaluation=evaluation() | {"capture_causes": {"reversing": 3, "head-on": 8, "other": 0}},
        untrained_evaluation=evaluation(30),
        scene=chase(),
        untrained_scene=chase(),
        capture=chase(reverse=True),
        survey=survey_of(),
    )
    game = replace(
        run_of("game"), evaluation=evaluation(0), scene=chase(steps=60), survey=survey_of((0.001, 0.5), 20)
    )
    path = tmp_path_factory.mktemp("report") / "report.html"
    return write_report([game, paper], path, command="sidestep reproduce --seed 0 & <now>")


def test_report_loads_nothing_from_anywhere(whole):
    page = read(whole)
    assert page.loads
    assert all(load.startswith("data:image/png;base64,") for load in page.loads)
    assert not {"link", "iframe", "object", "embed", "base"} & set(page.tags)
    source = re.sub(r"data:image/png;base64,[A-Za-z0-9+/=]+", "", whole.read_text())
    assert "http" not in source
    assert "url(" not in source
    assert "@import" not in source
    assert not re.search(r"\bimport\b|\bfetch\b|XMLHttp|WebSocket|sendBeacon", source)


def test_pictures_in_the_report_are_whole(whole):
    page = read(whole)
    assert len(page.loads) == 9
    for load in page.loads:
        picture = base64.b64decode(load.split(",")[1], validate=True)
        assert picture.startswith(b"\x89PNG")
        assert picture.endswith(b"IEND\xaeB`\x82")


def test_report_says_what_the_data_say(whole):
    words = read(whole).words
    assert "30 / 34" in words
    assert "8 because the pursuer came straight on" in words
    assert "3 because the pursuer drove backwards" in words
    assert "0.0355" in words
    assert "0.20078 m" in words
    assert "The pursuer reverses" in words
    assert words.index("Paper's shield") < words.index("Game shield")
    # Two shields' surveys: 3 and 2 episodes, 100 periods each, of which 50 beyond the map.
    assert "(paper's shield: 3, game shield: 2)" in words
    assert "Game shield: 2 episodes, 100 periods, of which 50.0 % further off than drawn" in words


def test_shields_stand_in_one_order_and_only_those_shown_are_explained(whole, quick, tmp_path, run_of):
    assert "joint shield adds" not in read(whole).words
    runs = [run_of(shield) for shield in ("joint", "game", "none", "paper")]
    words = read(write_report(runs, tmp_path / "r.html")).words
    assert words.index("No shield") < words.index("Paper's shield")
    assert words.index("Paper's shield") < words.index("Game shield") < words.index("Joint shield")
    assert "What the joint shield adds" in words
    assert "20.0 %" in words.partition("periods corrected")[2][:60]
    assert "0.0100" in words.partition("mean correction, m/s")[2][:60]
    # Four shields' single episodes are not drawn, so the caption must not speak of them.
    assert "Faint" not in words
    assert "Faint" in read(whole).words


def test_report_escapes_what_it_shows(quick, tmp_path, run_of, survey_of):
    run = run_of("</script><script>alert(1)//")
    config = {**run.config, "pursuer": "<script>alert(1)</script>"}
    run = replace(run, config=config, survey=survey_of())
    text = write_report([run], tmp_path / "r.html", command="a && <b>").read_text()
    assert "<script>" not in text
    assert "&lt;script&gt;" in text
    assert "a &amp;&amp; &lt;b&gt;" in text
    # The player's data and the player, and nothing that the data ended or began.
    assert text.count("</script>") == text.count("<script") == 2
    data = text.partition('id="replay-data">')[2].partition("</script>")[0]
    assert json.loads(data)[0]["shield"] == run.shield


def test_figures_are_left_beside_the_report_in_both_formats(whole):
    names = {path.name for path in (whole.parent / "figures").iterdir()}
    for figure in (
        "reward",
        "reward-column",
        "times",
        "clearances",
        "interventions",
        "safety",
        "outcomes",
        "capture",
        "test-scene-paper",
        "test-scene-game",
    ):
        assert {f"{figure}.png", f"{figure}.pdf"} <= names


def test_report_of_a_run_folder(tmp_path, chase, run_of):
    run = run_of("game", ["reached"] * 5)
    folder = create_run(tmp_path / "run", {**run.config, "episodes": 200, "version": "0.1.0", "learner": {}})
    append_metrics(folder, run.metrics)
    unfinished = load_run(folder)
    assert unfinished.summary["episodes"] == 5
    assert unfinished.evaluation is None
    write_json(folder / "evaluation.json", evaluation(0))
    save_trajectory(folder / "test_scene.npz", chase(steps=40))
    path = write_report([folder], folder / "report.html")
    words = read(path).words
    assert "5 / 5" in words
    # Such as a run from before there were surveys.
    assert "hold no record of where a shield stepped in" in words
    assert "in each episode of the training (game shield: 5)" in words
    assert "The worst episodes" not in words
    assert json.loads((folder / "config.json").read_text())["shield"] == "game"


def test_runs_of_other_scenarios_are_not_compared_in_silence(whole, quick, tmp_path, run_of):
    one, other = run_of("game"), run_of("joint")
    faster = {**other.config["scenario"], "pursuer_speed": 0.25}
    runs = [one, replace(other, config={**other.config, "scenario": faster})]
    assert "pursuer speed 0.2 or 0.25" in read(write_report(runs, tmp_path / "r.html")).words
    assert "like with like" not in read(whole).words


@pytest.mark.slow
def test_eight_runs_of_two_shields_are_pooled_and_the_file_stays_small(tmp_path, run_of, survey_of):
    runs = [
        replace(run_of(shield, seed=seed), survey=survey_of(), evaluation=evaluation(10 * seed))
        for shield in ("joint", "game")
        for seed in range(4)
    ]
    path = write_report(runs, tmp_path / "r.html")
    words = read(path).words
    assert "120 / 120" in words
    assert "4 of 4 seeds, first at 20, 20, 20, 20; 4 stayed" in words
    # 0, 10, 20 and 30 captured of 100 each.
    low, high = wilson_interval(60, 400)
    assert f"captured 15.0 % {100 * low:.1f} % to {100 * high:.1f} %" in words
    assert "(game shield: 12, joint shield: 12)" in words
    assert "Joint shield: 12 episodes, 400 periods" in words
    replays = json.loads(path.read_text().partition('id="replay-data">')[2].partition("</script>")[0])
    assert [one["group"] for one in replays[:4]] == [f"Game shield, seed {seed}" for seed in range(4)]
    assert len(replays) == 8
    assert path.stat().st_size < 1_500_000


def test_run_without_an_episode_gives_a_report(tmp_path, run_of):
    assert "0 / 0" in read(write_report([run_of(outcomes=[])], tmp_path / "r.html")).words


def test_folder_without_a_run_is_named(tmp_path):
    with pytest.raises(RunError, match="holds no run"):
        write_report([tmp_path], tmp_path / "r.html")
    with pytest.raises(ValueError, match="at least one run"):
        write_report([], tmp_path / "r.html")
