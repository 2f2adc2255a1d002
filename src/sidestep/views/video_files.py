"""Write pictures as a video file (.mp4, .gif or .webp), whole or not at all."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from fractions import Fraction
from itertools import chain, islice, repeat
from pathlib import Path
from typing import Any, final

import numpy as np
from jaxtyping import UInt8

from sidestep._bounds import Bound, taken
from sidestep._packages import install_extra, needed
from sidestep.store.files import OutputError, whole_file
from sidestep.store.outputs import try_outputs

Pictures = Iterable[UInt8[np.ndarray, "height width 3"]]

SUFFIXES = (".mp4", ".gif", ".webp")
HOLD = Bound(least=0.0, most=1e6, unit="s")
_H264 = {"crf": "21", "preset": "veryfast", "tune": "animation"}
"""Quality 21: 18 is visually lossless, 28 has visible artefacts. Slower presets do not help."""
_COLOURS = 127
"""The last of the palette's 128 entries, which means an unchanged pixel."""
_EXACT = 32
"""Number of palette entries for the most frequent colours."""


class VideoError(ValueError):
    """A video that cannot be written; the message says what to change or install."""


def check_video(path: str | Path, *, overwrite: bool = True) -> Path:
    """Returns the path if a video can be written there; for a check before any work is done.

    **Raises** `VideoError` for another suffix than .mp4, .gif and .webp, for a folder or a path that cannot
    be written, for an existing file unless `overwrite`, and when the required package is not installed.
    """
    path = Path(path)
    if path.suffix.lower() not in SUFFIXES:
        raise VideoError(f"{path} must end in one of {', '.join(SUFFIXES)}: it says what to write")
    try:
        try_outputs(files=[path] if overwrite else [], new=[] if overwrite else [path])
    except OutputError as error:
        raise VideoError(str(error)) from error
    if path.suffix.lower() == ".mp4":
        load_av()
    else:
        _load_pillow(path.suffix.lower())
    return path


def load_av(extra: str = "video") -> Any:
    """The module `av` (PyAV), which writes MP4 files.

    **Raises** `VideoError` when it is not installed; it names the extra that installs it.
    """
    return needed("av", extra, "writing an MP4 video needs", VideoError)


def _load_pillow(suffix: str) -> Any:
    image, features = (
        needed(f"PIL.{name}", "video", f"writing a {suffix} animation needs", VideoError)
        for name in ("Image", "features")
    )
    if suffix == ".webp" and not features.check("webp"):
        raise VideoError(f"this Pillow was built without WebP: {install_extra('video')}, or write .gif")
    return image


def write_video_file(
    path: str | Path,
    pictures: Pictures,
    rate: int,
    *,
    hold: float = 0.0,
    samples: Pictures | None = None,
) -> Path:
    """Write pictures as a video in the format of the suffix of `path`. Missing folders are created.

    MP4 is H.264 with 4:2:0 colours and its index in front, as browsers and players need. GIF and WebP have
    one palette for all pictures, without dithering, and repeat forever; this keeps drawings sharp, but not
    photographs.

    **Arguments:** `pictures` in RGB, an iterable; MP4 needs the memory of one picture, GIF and WebP one byte
    per pixel and picture; `rate` pictures per second; `hold` time (s) for which the last one stays; `samples`
    pictures from which to choose the palette (default: the first one).

    **Raises** as `check_video`, and `VideoError` for an odd size of an MP4 or no picture at all. After an
    error no partial file is left.
    """
    path = check_video(path)
    taken("rate", rate, Bound(least=1, whole=True), VideoError)
    taken("hold", hold, HOLD, VideoError)
    stream = iter(pictures)
    first = next(stream, None)
    if first is None:
        raise VideoError("no picture, no video")
    with whole_file(path) as beside:
        if path.suffix.lower() == ".mp4":
            _write_mp4(beside, chain([first], stream), first.shape[:2], rate, hold)
        else:
            palette = _Palette([first] if samples is None else samples)
            write = _write_gif if path.suffix.lower() == ".gif" else _write_webp
            write(beside, chain([first], stream), palette, rate, hold)
    return path


def _write_mp4(path: Path, pictures: Pictures, size: tuple[int, ...], rate: int, hold: float) -> None:
    av = load_av()
    height, width = size
    if height % 2 or width % 2:
        raise VideoError(f"{width} x {height} pixels: an MP4 needs even numbers")
    # Without a declared colour space, players assume BT.709 for large pictures and another for small ones.
    space = av.video.reformatter.Colorspace.ITU709
    with av.open(str(path), "w", format="mp4", options={"movflags": "+faststart"}) as container:
        stream = container.add_stream("libx264", rate=Fraction(rate), options=_H264)
        stream.width, stream.height, stream.pix_fmt = width, height, "yuv420p"
        context = stream.codec_context
        context.color_range, context.colorspace, context.color_primaries, context.color_trc = 1, 1, 1, 1
        last = None
        for picture in pictures:
            last = np.ascontiguousarray(picture)
            container.mux(stream.encode(_as_frame(av, last, space)))
        for picture in repeat(last, round(hold * rate)):
            container.mux(stream.encode(_as_frame(av, picture, space)))
        container.mux(stream.encode())


def _as_frame(av: Any, picture: Any, space: Any) -> Any:
    frame = av.VideoFrame.from_ndarray(picture, format="rgb24")
    return frame.reformat(format="yuv420p", dst_colorspace=space, dst_color_range=1)


def _write_gif(path: Path, pictures: Pictures, palette: _Palette, rate: int, hold: float) -> None:
    durations = _Durations(rate, hold, unit=10)
    shown = _indexed(pictures, palette, durations)
    # When interrupted, Pillow would leave open a file that it opened itself.
    with open(path, "wb") as file:
        next(shown).save(
            file, format="GIF", save_all=True, append_images=shown, duration=durations, loop=0, optimize=True,
            palette=palette.colours.tobytes(), transparency=_COLOURS, disposal=1,
        )  # fmt: skip


def _write_webp(path: Path, pictures: Pictures, palette: _Palette, rate: int, hold: float) -> None:
    durations = _Durations(rate, hold, unit=1)
    shown = _indexed(pictures, palette, durations)
    with open(path, "wb") as file:
        # No key frames, because it is played from the beginning.
        next(shown).save(
            file, format="WEBP", save_all=True, append_images=shown, duration=durations, loop=0,
            lossless=True, quality=60, method=2, kmin=0, kmax=0,
        )  # fmt: skip


class _Durations(list[int]):
    """Duration (ms) of each picture in whole units of the format, rounded without drift."""

    def __init__(self, rate: int, hold: float, unit: int):
        super().__init__()
        self._length, self._hold, self._unit = 1000.0 / rate / unit, 1000.0 * hold / unit, unit

    def next(self, last: bool) -> None:
        """Add a picture; the last one includes the hold."""
        begin, end = len(self) * self._length, (len(self) + 1) * self._length
        self.append(self._unit * (round(end + (self._hold if last else 0.0)) - round(begin)))


def _indexed(pictures: Pictures, palette: _Palette, durations: _Durations) -> Iterator[Any]:
    """The pictures with the palette; adds each one's duration first."""
    stream = iter(pictures)
    now = next(stream, None)
    while now is not None:
        following = next(stream, None)
        durations.next(last=following is None)
        yield palette.image(now)
        now = following


@final
class _Palette:
    """127 colours for pictures like the samples, and one for unchanged pixels.

    It contains the most frequent colours, which are those of areas, exactly, and a selection of all others,
    because small objects such as the target have rare colours. Each pixel gets the nearest colour, which is
    cached; Pillow's assignment turns white into nearly white.
    """

    def __init__(self, samples: Pictures):
        self._pillow = _load_pillow(".gif")
        packed = np.concatenate([_packed(picture) for picture in samples])
        found, counts = np.unique(packed, return_counts=True)
        found = found[np.argsort(-counts, kind="stable")]
        exact = _EXACT if len(found) > _COLOURS else _COLOURS
        kept, others = found[:exact], found[exact:]
        if len(others):
            rest = self._pillow.fromarray(_unpacked(others)[None])
            groups = rest.quantize(_COLOURS - len(kept), self._pillow.Quantize.MAXCOVERAGE)
            grouped = np.asarray(groups.getpalette(), np.uint8).reshape(-1, 3)
            kept = np.unique(np.concatenate([kept, _packed(grouped)]))
        taken = set(kept.tolist())
        spare = islice((colour for colour in range(1 << 24) if colour not in taken), _COLOURS + 1 - len(kept))
        self.colours = _unpacked(np.concatenate([kept, np.fromiter(spare, kept.dtype)]))
        self._nearest = np.full(1 << 24, _COLOURS, np.uint8)

    def image(self, picture: UInt8[np.ndarray, "height width 3"]) -> Any:
        """The picture as a Pillow image with this palette."""
        packed = _packed(picture)
        index = self._nearest[packed]
        new = np.unique(packed[index == _COLOURS])
        if len(new):
            palette = self.colours[:_COLOURS].astype(np.float32)
            colours = _unpacked(new).astype(np.float32)
            # |a - b|^2 without the term that is equal for all b.
            apart = np.sum(palette**2, axis=-1) - 2.0 * colours @ palette.T
            self._nearest[new] = np.argmin(apart, axis=-1)
            index = self._nearest[packed]
        image = self._pillow.fromarray(index.reshape(picture.shape[:2]))
        image.putpalette(self.colours.tobytes())
        return image


def _packed(colours: np.ndarray) -> np.ndarray:
    red, green, blue = np.moveaxis(colours.reshape(-1, 3).astype(np.uint32), -1, 0)
    return red << 16 | green << 8 | blue


def _unpacked(colours: np.ndarray) -> UInt8[np.ndarray, "n 3"]:
    return np.stack([colours >> 16, colours >> 8 & 255, colours & 255], axis=-1).astype(np.uint8)
