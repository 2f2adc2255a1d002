"""Hazards of what is seen: labels on top of each other, sets hidden or cut, colours that nobody sees, a tint
that says safe where nothing is."""

import dataclasses
import itertools

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest
from matplotlib.collections import PathCollection
from matplotlib.colors import to_rgb, to_rgba
from matplotlib.text import Text

from sidestep.loop import load_episode, save_trajectory
from sidestep.safety.certificate import certify
from sidestep.views import (
    certificate_figure,
    reward_figure,
    scenes_figure,
    trajectory_figure,
    twin_figure,
)
from sidestep.views.intervention_figure import _share_colours
from sidestep.views.labels import Label, place_labels
from sidestep.views.replay import _capture_set
from sidestep.views.scene import CAPTURE_SET_LOOK, capture_set_outline, correction_colours
from sidestep.views.style import new_figure
from sidestep.world import Scenario, load_scenario

PAPER = Scenario()


@pytest.fixture(scope="module")
def circling(chase):
    """An episode in which the evader goes round the obstacle four times and reaches the target."""
    trajectory = chase(gap=0.5, steps=400)
    angles = np.linspace(0.0, 8.0 * np.pi, trajectory.length + 1)
    way = 0.45 * np.stack([np.cos(angles), np.sin(angles)], axis=-1)
    poses = np.concatenate([0.8 * way, angles[:, None]], axis=-1)[:, None]
    worlds = eqx.tree_at(
        lambda w: (w.evader, w.pursuers), trajectory.worlds, (jnp.asarray(way), jnp.asarray(poses))
    )
    events = eqx.tree_at(
        lambda e: (e.captured, e.reached),
        trajectory.events,
        (jnp.zeros(trajectory.length, bool), jnp.arange(trajectory.length) == trajectory.length - 1),
    )
    return dataclasses.replace(trajectory, worlds=worlds, events=events)


def texts(figure):
    """Every text that is seen, with its box in pixels."""
    # Texts have their places only once the figure has been laid out.
    figure.draw_without_rendering()
    renderer = figure.canvas.get_renderer()
    found = figure.findobj(lambda artist: isinstance(artist, Text) and artist.get_visible())
    ticks = {tick for axes in figure.axes for tick in _hidden_ticks(axes)}
    return [(t, t.get_window_extent(renderer)) for t in found if t.get_text().strip() and t not in ticks]


def _hidden_ticks(axes):
    """Labels of ticks outside the limits exist, but are never drawn; nor are those of axes that are off."""
    for axis in (axes.xaxis, axes.yaxis):
        low, high = sorted(axis.get_view_interval())
        for tick in axis.get_major_ticks() + axis.get_minor_ticks():
            for label in (tick.label1, tick.label2):
                seen = axes.axison and low - 1e-9 <= tick.get_loc() <= high + 1e-9
                if not seen:
                    yield label


def assert_legible(figure):
    """No text covers another, none is cut by the edge, and all stand out from what is behind them."""
    found = texts(figure)
    for (one, box), (other, beside) in itertools.combinations(found, 2):
        cut = box.padded(-1.0)
        assert not cut.overlaps(beside.padded(-1.0)), (one.get_text(), other.get_text())
    edge = figure.bbox.padded(1.0)
    for one, box in found:
        inside = edge.x0 <= box.x0 and box.x1 <= edge.x1 and edge.y0 <= box.y0 and box.y1 <= edge.y1
        assert inside, one.get_text()
        behind = one.axes.get_facecolor() if one.axes is not None else "white"
        assert contrast(one.get_color(), behind) >= 3.0, (one.get_text(), one.get_color())


def luminance(colour):
    """WCAG 2's relative luminance."""
    linear = [c / 12.92 if c <= 0.03928 else ((c + 0.055) / 1.055) ** 2.4 for c in to_rgb(colour)]
    return float(np.dot(linear, (0.2126, 0.7152, 0.0722)))


def contrast(one, other):
    low, high = sorted((luminance(one), luminance(other)))
    return (high + 0.05) / (low + 0.05)


def test_contrast_is_that_of_the_standard():
    assert contrast("black", "white") == pytest.approx(21.0)
    assert contrast("#777777", "white") == pytest.approx(4.48, abs=0.01)


def test_time_labels_of_a_path_that_circles_do_not_cover_each_other(drawn, circling):
    shields = ("none", "paper", "game", "joint")
    figure = drawn(lambda path: scenes_figure(PAPER, dict.fromkeys(shields, circling), path))
    assert_legible(figure)
    labels = figure.findobj(Label)
    assert sum(label.get_visible() for label in labels) >= 4 * len(shields)


def test_labels_of_a_twin_figure_do_not_cover_each_other(drawn, circling, chase):
    figure = drawn(lambda path: twin_figure(PAPER, circling, chase(), path, shield="joint"))
    assert_legible(figure)


def test_a_label_that_finds_no_room_is_left_out():
    figure = new_figure(3.0, 2.0)
    axes = figure.add_subplot()
    labels = [Label(str(rank), (0.5, 0.5), [(0.0, 15.0), (0.0, -15.0)], rank=rank) for rank in range(9)]
    for label in reversed(labels):
        axes.add_artist(label)
    place_labels(figure)
    assert [label.get_visible() for label in labels] == [True] * 2 + [False] * 7


@pytest.mark.parametrize("shield", ["none", "paper", "game", "joint"])
@pytest.mark.parametrize("company", [{}, {"obstacles": 3, "pursuers": 2}, {"obstacles": 0}], ids=str)
def test_no_level_set_is_cut_by_the_frame(drawn, chase, shield, company):
    episode = chase(**company)
    figure = drawn(lambda path: trajectory_figure(PAPER, episode, path, shield=shield))
    axes = figure.axes[0]
    (left, right), (bottom, top) = axes.get_xlim(), axes.get_ylim()
    levels = [line for line in axes.get_lines() if line.get_zorder() in (0.5, 2.5)]
    assert len(levels) == 4
    for line in levels:
        x, y = line.get_data()
        assert left <= np.nanmin(x) <= np.nanmax(x) <= right
        assert bottom <= np.nanmin(y) <= np.nanmax(y) <= top


def capture_sets(axes):
    style = CAPTURE_SET_LOOK["linestyle"]
    return [
        line
        for line in axes.get_lines()
        if line.is_dashed() and line.get_linewidth() == CAPTURE_SET_LOOK["linewidth"] and style
    ]


def test_capture_set_lies_over_the_level_that_has_the_same_place(drawn, chase):
    figure = drawn(lambda path: trajectory_figure(PAPER, chase(), path, shield="game"))
    (line,) = capture_sets(figure.axes[0])
    zero = [one for one in figure.axes[0].get_lines() if one.get_zorder() == 2.5]
    assert all(line.get_zorder() > one.get_zorder() for one in zero)
    assert all(line.get_linewidth() > one.get_linewidth() for one in zero)
    words = [text.get_text() for text in figure.axes[1].get_legend().get_texts()]
    assert "capture set K" in words


def test_where_it_arrived_is_marked_and_in_the_key(drawn, circling):
    figure = drawn(lambda path: trajectory_figure(PAPER, circling, path, shield="game"))
    end = np.asarray(circling.worlds.evader[-1])
    marks = [line for line in figure.axes[0].get_lines() if line.get_marker() == "D"]
    assert [tuple(line.get_xydata()[0]) for line in marks] == [pytest.approx(tuple(end))]
    words = [text.get_text() for text in figure.axes[1].get_legend().get_texts()]
    assert "reached the target" in words


def test_distances_of_a_twin_are_drawn_whole(drawn, circling, chase):
    for twin in (circling, chase(gap=3.0, steps=60)):
        figure = drawn(lambda path, twin=twin: twin_figure(PAPER, circling, twin, path))
        for axes in figure.axes[-2:]:
            low, high = axes.get_ylim()
            for line in axes.get_lines():
                values = np.asarray(line.get_ydata(), float)
                assert low < values.min()
                assert values.max() < high


@pytest.mark.parametrize("colours", [_share_colours(), correction_colours()], ids=["share", "correction"])
def test_palest_colour_of_a_map_is_seen_on_white(colours):
    palest = max((to_rgba(colours(x)) for x in np.linspace(0.0, 1.0, 64)), key=luminance)
    assert np.linalg.norm(np.subtract(to_rgb(palest), 1.0)) > 0.35
    assert contrast(palest, "white") > 1.25


def test_returns_are_shown_as_they_were_beside_their_mean(drawn, run_of):
    outcomes = ["reached"] * 60 + ["captured"] * 5 + ["reached"] * 60
    run = run_of("joint", outcomes)
    figure = drawn(lambda path: reward_figure([run], path))
    assert_legible(figure)
    assert "mean" in figure.axes[0].get_title("left").lower()
    shown = sum(
        len(one.get_offsets()) for one in figure.axes[1].collections if isinstance(one, PathCollection)
    )
    assert shown == len(outcomes)
    diamonds = [line for line in figure.axes[0].get_lines() if line.get_marker() == "D"]
    first, stays = sorted(diamonds, key=lambda line: line.get_xdata()[0])
    # One captured episode of the 20, worth -20, is a mean of 939.5: below 940.
    assert (first.get_xdata()[0], stays.get_xdata()[0]) == (20, 85)
    assert first.get_markerfacecolor() != "white" == stays.get_markerfacecolor()


def test_no_place_is_tinted_as_safe_where_the_pursuer_wins(drawn):
    fields = {"pursuer_speed": 0.22, "pursuer_half_axle": 0.08, "capture_distance": 0.1}
    lost = certify(load_scenario("paper", **fields), check_shield=False)
    kept = certify(load_scenario("paper"), check_shield=False)
    assert lost.pursuer_wins
    figures = [drawn(lambda path, one=one: certificate_figure(one, path)) for one in (lost, kept)]
    tints = [to_rgba(figure.axes[0].get_facecolor()) for figure in figures]
    red, green, _, _ = tints[0]
    assert red > green
    assert tints[1][1] > tints[1][0]
    assert [len([a for a in figure.axes if a.axison]) for figure in figures] == [1, 2]
    for figure in figures:
        assert_legible(figure)


def test_every_view_draws_the_same_capture_set_of_robots_with_a_name(chase, tmp_path):
    scenario = load_scenario("quadrotor-test")
    outline = capture_set_outline(scenario)
    radius, ratio = _capture_set(scenario)
    assert np.abs(outline).max() == pytest.approx(radius / ratio, rel=1e-5)
    assert radius > float(scenario.capture_distance) + 0.1
    save_trajectory(tmp_path / "x.npz", chase(steps=3), scenario, {"shield": "game"})
    read = load_episode(tmp_path / "x.npz").scenario
    np.testing.assert_allclose(capture_set_outline(read), outline, rtol=1e-6)
