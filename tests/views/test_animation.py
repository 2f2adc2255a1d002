"""Hazards of animations: files that do not play, robots in the wrong place, half files, late refusals."""

import sys
from itertools import pairwise

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from PIL import Image, ImageSequence

from sidestep.cli import main
from sidestep.loop import save_trajectory
from sidestep.safety.barriers.barrier import ObstacleBarrier
from sidestep.safety.barriers.pursuit_barrier import PursuitBarrier
from sidestep.views import VideoError, animate
from sidestep.views.motion import Motion, nearest_pursuers
from sidestep.views.outlines import LevelOutlines
from sidestep.views.stage import Stage
from sidestep.views.style import EVADER
from sidestep.views.video_files import write_video_file
from sidestep.world import Scenario, World

PAPER = Scenario()
BLUE = np.array([int(EVADER[i : i + 2], 16) for i in (1, 3, 5)])
SPEED, RIM, PERIOD, REACH, GAP = 0.1574, 0.2, 0.05, 0.2, 0.08


def least_barrier(world, evader):
    """The least of all barriers (m) at a place of the evader, from the barriers themselves."""
    pursuit, obstacle, none = PursuitBarrier(), ObstacleBarrier(), jnp.zeros((), evader.dtype)
    to_pursuers = [
        pursuit.value(PAPER, evader, robot, pursuit.update_memory(PAPER, evader, robot, None))
        for robot in world.pursuers
    ]
    to_obstacles = [obstacle.value(PAPER, evader, robot, none) for robot in world.obstacles]
    return jnp.min(jnp.stack([*to_pursuers, *to_obstacles]))


@pytest.fixture(scope="module")
def lost(chase):
    """A capture after 1.9 s: the evader at (0.1574 t, 0), the pursuer behind it on the same line."""
    return chase(gap=GAP)


@pytest.fixture(scope="module")
def stage(lost):
    return Stage(PAPER, lost, shield="game", width=1280)


def decoded(path):
    """Pictures, how long each is shown (s), and the size that the file tells."""
    if path.suffix != ".mp4":
        with Image.open(path) as file:
            frames = [(frame.info["duration"] / 1000.0, frame.convert("RGB")) for frame in _frames(file)]
            assert file.info["loop"] == 0
            return [np.asarray(frame) for _, frame in frames], [seconds for seconds, _ in frames], file.size
    av = pytest.importorskip("av")
    with av.open(str(path)) as container:
        stream = container.streams.video[0]
        assert (stream.codec_context.name, stream.codec_context.pix_fmt) == ("h264", "yuv420p")
        pictures = [frame.to_ndarray(format="rgb24") for frame in container.decode(stream)]
        each = float(stream.duration * stream.time_base) / len(pictures)
        return pictures, [each] * len(pictures), (stream.width, stream.height)


def _frames(file):
    for frame in ImageSequence.Iterator(file):
        # Only once it is loaded does Pillow know how long a WebP frame is shown.
        frame.load()
        yield frame


@pytest.mark.parametrize("suffix", [".mp4", ".gif", ".webp"])
def test_every_format_plays_again_with_all_pictures_for_as_long_as_they_should(suffix, lost, stage, tmp_path):
    told = []
    path = animate(
        PAPER, lost, tmp_path / "new" / f"x{suffix}", shield="game", rate=8, speed=1.5, width=322, hold=0.5,
        progress=lambda *count: told.append(count),
    )  # fmt: skip
    # 1.9 s at one and a half times the speed and 8 pictures a second, and the end.
    moving = int(np.ceil(lost.length * PERIOD / 1.5 * 8)) + 1
    assert told == [(number, moving) for number in range(1, moving + 1)]
    pictures, seconds, size = decoded(path)
    assert len(pictures) == moving + (4 if suffix == ".mp4" else 0)
    assert size == (322, 182)
    assert pictures[0].shape == (182, 322, 3)
    assert sum(seconds) == pytest.approx(moving / 8 + 0.5, abs=0.011)
    for before, after in pairwise(pictures[:moving]):
        assert np.sum(np.any(np.abs(before.astype(int) - after) > 40, axis=-1)) > 5
    # What plays is what was drawn; MP4 halves the colours' resolution.
    drawn = Stage(PAPER, lost, shield="game", speed=1.5, width=322).picture(1.5 / 8 * 5).astype(int)
    assert np.abs(pictures[5] - drawn).mean() < (6.0 if suffix == ".mp4" else 1.0)
    if suffix == ".mp4":
        content = path.read_bytes()
        assert content.index(b"moov") < content.index(b"mdat")


def pixel(stage, axes, place):
    x, y = axes.transData.transform(place)
    return round(x), round(720 - y)


def is_blue(picture, x, y):
    return np.abs(picture[y, x].astype(int) - BLUE).max() < 12


def test_the_evader_is_where_it_was_in_both_panels_between_control_periods(stage):
    for time in (0.26, 0.53, 1.22):
        picture = stage.picture(time)
        distance = SPEED * time - (RIM * time - REACH - GAP)
        for axes, place in ((stage.world, (SPEED * time, 0.0)), (stage.seen, (distance, 0.0))):
            x, y = pixel(stage, axes, place)
            # Within its dot; beside it there is at most a trail or an arrow.
            assert is_blue(picture, x, y - 4)
            assert is_blue(picture, x, y + 4)
            assert not is_blue(picture, x, y - 14)
            assert not is_blue(picture, x + 40, y - 4)


def test_what_does_not_move_never_jitters(stage):
    pictures = [stage.picture(time).astype(int) for time in (0.1, 0.77, 1.5)]
    for axes in (stage.world, stage.seen):
        box = axes.get_window_extent()
        left, low, high = int(box.x0), int(720 - box.y0), int(720 - box.y1)
        # Scales, words and lines outside the panels.
        for rows, columns in (
            (slice(high, low + 30), slice(left - 60, left - 2)),
            (slice(low + 6, low + 30), slice(left, int(box.x1))),
        ):
            for other in pictures[1:]:
                assert np.array_equal(pictures[0][rows, columns], other[rows, columns])


def test_a_picture_does_not_depend_on_those_before_it(stage, lost):
    late = stage.picture(1.2)
    stage.picture(lost.length * PERIOD, end=True)
    stage.picture(0.0)
    assert np.array_equal(stage.picture(1.2), late)


def test_it_ends_with_the_outcome_in_words(stage, lost):
    end = lost.length * PERIOD
    assert not np.array_equal(stage.picture(end), stage.picture(end, end=True))
    assert stage._heading.get_text() == f"Game shield: captured after {end:.2f} s"
    stage.picture(0.0)
    assert stage._heading.get_text() == "Game shield"


@pytest.mark.parametrize(
    "parts", [{"obstacles": 0}, {"pursuers": 3}, {"steps": 1}, {"reverse": True}], ids=str
)
def test_any_episode_can_be_animated(parts, chase, tmp_path):
    path = animate(PAPER, chase(**parts), tmp_path / "x.gif", rate=1, width=160, levels=())
    pictures, _, _ = decoded(path)
    assert len(pictures) >= 2
    assert 0.02 < np.mean(pictures[-1].mean(axis=-1) < 200) < 0.5


def test_every_target_of_a_recording_from_the_live_page_is_in_view(chase):
    record = chase(steps=2)
    moved = record.worlds.target.at[2].set(jnp.array([-3.0, 2.0]))
    record = eqx.tree_at(lambda record: record.worlds.target, record, moved)
    world = Stage(PAPER, record, width=160).world
    assert world.get_xlim()[0] < -3.05
    assert world.get_ylim()[1] > 2.05


def test_the_way_of_a_turning_pursuer_is_its_arc(chase):
    still = chase(steps=2)
    speed, turn, start = 0.15, 0.9, 3.12  # m/s, rad/s; through the jump of headings at pi
    times = PERIOD * np.arange(3)
    headings = start + turn * times

    def arc(time):
        end = start + turn * time
        return speed / turn * np.stack([np.sin(end) - np.sin(start), np.cos(start) - np.cos(end)], axis=-1)

    poses = np.concatenate([arc(times), ((headings + np.pi) % (2 * np.pi) - np.pi)[:, None]], axis=-1)
    assert poses[1, 2] < 0.0 < poses[0, 2]
    record = eqx.tree_at(lambda record: record.worlds.pursuers, still, poses[:, None])
    between = np.array([0.0, 0.013, 0.05, 0.081, 0.1])
    found = Motion(PAPER, record).poses(between)[:, 0]
    np.testing.assert_allclose(found[:, :2], arc(between), atol=1e-9)
    np.testing.assert_allclose(np.cos(found[:, 2] - start - turn * between), 1.0, atol=1e-12)


def test_the_view_stays_with_a_pursuer_until_another_is_clearly_nearer():
    distances = np.array([[1.0, 1.1], [1.0, 0.95], [1.0, 0.9], [1.0, 0.8], [0.75, 0.8], [0.5, 0.8]])
    poses = np.zeros((6, 2, 3))
    poses[..., 0] = distances
    assert nearest_pursuers(np.zeros((6, 2)), poses).tolist() == [0, 0, 0, 1, 1, 0]


def test_outlines_lie_on_the_barrier_that_they_are_levels_of():
    poses = np.array([[0.0, 0.0, 0.4], [0.35, 0.25, 2.0]])
    obstacles = np.array([[-0.5, 0.1]])
    still = jnp.array([[*obstacles[0], 0.0, 0.0]])
    world = World(jnp.zeros(2), jnp.asarray(poses, dtype=float), still, jnp.zeros(2))
    for level in (0.0, 0.2):
        outline = LevelOutlines(PAPER, pursuit=True).at(poses, obstacles, level)
        outline = outline[np.isfinite(outline[:, 0])]
        assert len(outline) > 150
        heights = jax.vmap(lambda evader: least_barrier(world, evader))(jnp.asarray(outline, dtype=float))
        np.testing.assert_allclose(heights, level, atol=1e-5)


@pytest.mark.parametrize("suffix", [".mp4", ".gif", ".webp"])
@pytest.mark.parametrize("before", [None, b"the old one"])
def test_an_interruption_leaves_no_half_file(suffix, before, tmp_path):
    path = tmp_path / f"x{suffix}"
    if before is not None:
        path.write_bytes(before)

    def pictures():
        for shade in (0, 80, 160):
            yield np.full((90, 160, 3), shade, np.uint8)
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        write_video_file(path, pictures(), 10)
    assert [entry.name for entry in tmp_path.iterdir()] == ([] if before is None else [path.name])
    assert before is None or path.read_bytes() == before


@pytest.mark.parametrize(
    "name, options, words",
    [
        ("x.avi", {}, r"must end in one of .mp4, .gif, .webp"),
        ("x", {}, r"must end in one of"),
        ("folder.gif", {}, "is a folder"),
        ("file/x.gif", {}, "could not be written"),
        ("x.gif", {"rate": 60}, "rate = 60"),
        ("x.mp4", {"rate": 0}, "rate = 0"),
        ("x.mp4", {"speed": 0.0}, "speed = 0.0"),
        ("x.mp4", {"speed": np.nan}, "speed = nan"),
        ("x.mp4", {"width": 10}, "width = 10"),
        ("x.mp4", {"hold": -1.0}, "hold = -1.0"),
        ("x.mp4", {"levels": (0.1, 0.0)}, "levels"),
    ],
)
def test_bad_input_is_refused_before_anything_is_drawn(name, options, words, chase, tmp_path, monkeypatch):
    (tmp_path / "folder.gif").mkdir()
    (tmp_path / "file").write_bytes(b"")
    monkeypatch.setattr("sidestep.views.animation.Stage", None)
    with pytest.raises(VideoError, match=words):
        animate(PAPER, chase(steps=1), tmp_path / name, **options)


@pytest.mark.parametrize("module, suffix", [("av", ".mp4"), ("PIL.Image", ".gif")])
def test_without_a_package_the_error_names_the_command_that_installs_it(
    module, suffix, chase, tmp_path, monkeypatch
):
    monkeypatch.setitem(sys.modules, module, None)
    with pytest.raises(VideoError, match=r"pip install .*\[video\]"):
        animate(PAPER, chase(steps=1), tmp_path / f"x{suffix}")


def test_one_palette_keeps_the_colours_of_areas_and_rare_ones(tmp_path):
    hues = np.linspace(0, 255, 160).astype(np.uint8)
    picture = np.stack(np.broadcast_arrays(hues[None, :], hues[:90, None], np.uint8(120)), axis=-1)
    picture[40:50] = BLUE
    picture[70, 80:85] = (0, 255, 0)
    moved = np.roll(picture, 1, axis=1)
    path = write_video_file(tmp_path / "x.gif", [picture, moved], 10, samples=[picture])
    (first, second), _, _ = decoded(path)
    assert np.array_equal(first[40:50], picture[40:50])
    assert np.array_equal(second[40:50], picture[40:50])
    # Rare, but like nothing else.
    assert np.abs(first[70, 80:85].astype(int) - (0, 255, 0)).max() < 30
    assert np.abs(second.astype(int) - moved).mean() < 8.0


def test_odd_sizes_and_no_pictures_are_refused(tmp_path):
    with pytest.raises(VideoError, match="even"):
        write_video_file(tmp_path / "x.mp4", [np.zeros((91, 160, 3), np.uint8)], 10)
    with pytest.raises(VideoError, match="no picture"):
        write_video_file(tmp_path / "x.gif", [], 10)
    assert not list(tmp_path.iterdir())


def test_the_commands_refuse_before_they_work_and_animate_a_recording(chase, tmp_path, capsys, monkeypatch):
    def refused(*arguments):
        assert main([str(argument) for argument in arguments]) == 2
        return capsys.readouterr().err

    monkeypatch.setattr("sidestep.trials.evaluate", None)
    monkeypatch.setattr("sidestep.views.write_episode_report", lambda *_, **told: told["title"])
    recording, video = tmp_path / "episode.npz", tmp_path / "x.gif"
    assert "must end in" in refused("evaluate", "--video", tmp_path / "x.mov")
    assert "worst or the number" in refused(
        "evaluate", "--episodes", 3, "--video-episode", 3, "--video", video
    )
    assert "with --replay" in refused("falsify", "--video", video)
    assert "one episode" in refused("report", tmp_path, "--video", video)
    save_trajectory(recording, chase(steps=4))
    assert "does not say in which scenario" in refused("report", recording, "--video", video)
    save_trajectory(recording, chase(steps=4), PAPER, {"shield": "paper"})
    options = ["--video", str(video), "--video-width", "160", "--video-rate", "5"]
    assert main(["report", str(recording), *options]) == 0
    told = " ".join(capsys.readouterr().out.split())
    assert "Recording episode" in told
    assert "Video of the episode (cut)" in told
    assert len(decoded(video)[0]) == 2
    assert "exists already" in refused("report", recording, *options)
