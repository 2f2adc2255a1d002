"""Hazards of the counterexample figure: blank, huge, or of the wrong part of the episode."""

import jax.numpy as jnp
import matplotlib
import numpy as np
import pytest
from PIL import Image

from sidestep.trials.falsification.attackers import escape_margin
from sidestep.views.counterexample_figure import _margins, counterexample_figure
from sidestep.views.scene import world_at
from sidestep.world import Scenario

PAPER = Scenario()


@pytest.mark.parametrize(
    "parts",
    [{"obstacles": 0}, {"pursuers": 2}, {"reverse": True, "gap": 0.055}, {"steps": 1}],
    ids=str,
)
def test_figure_of_any_episode_shows_something(tmp_path, chase, parts):
    png, pdf = counterexample_figure(PAPER, chase(**parts), tmp_path / "x", shield="game", words="Broken: it")
    assert png.stat().st_size < 300_000
    pixels = np.asarray(Image.open(png).convert("L"))
    assert 0.005 < np.mean(pixels < 200) < 0.6
    assert pdf.read_bytes().startswith(b"%PDF")
    assert matplotlib.get_backend().lower() == "agg"


def test_title_says_what_happened_and_when(chase, drawn):
    lost = chase()
    figure = drawn(
        lambda path: counterexample_figure(PAPER, lost, path, shield="paper", words="Broken: the row")
    )
    title = figure.get_suptitle()
    assert "Paper's shield: captured after" in title
    assert f"{lost.length * 0.05:.2f} s" in title
    assert "Broken: the row" in title
    wheels = figure.axes[-1]
    assert wheels.get_xlim()[1] == pytest.approx(lost.length * 0.05)


def test_margin_drawn_is_the_margin_of_the_game(chase):
    lost = chase(gap=0.2)
    drawn = _margins(PAPER, lost)
    for period in (0, 7, lost.length):
        world = world_at(lost, period)
        wanted = float(escape_margin(PAPER, world))
        assert drawn[period] == pytest.approx(wanted, abs=1e-6)
    assert jnp.all(jnp.diff(jnp.asarray(drawn)) < 0.0)
