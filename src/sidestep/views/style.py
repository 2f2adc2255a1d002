"""The style of all figures: fonts, sizes, and colours that colour-blind readers can distinguish."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from io import BytesIO
from pathlib import Path
from typing import Any

import matplotlib
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.patches import Circle

from sidestep.store.files import write_bytes
from sidestep.views.labels import place_labels

# Okabe and Ito's palette, "Color universal design" (2008).
BLACK, ORANGE, SKY, GREEN = "#000000", "#E69F00", "#56B4E9", "#009E73"
YELLOW, BLUE, VERMILION, PURPLE, GREY = "#F0E442", "#0072B2", "#D55E00", "#CC79A7", "#8A8A8A"

EVADER, PURSUER, OBSTACLE, TARGET = BLUE, VERMILION, "#595959", GREEN
INK, FAINT = "#222222", "#C8C8C8"

OUTCOME_COLOURS = {"captured": VERMILION, "collided": PURPLE, "reached": GREEN, "timed_out": GREY}
OUTCOME_MARKERS = {"captured": "X", "collided": "^", "reached": ".", "timed_out": "s"}
OUTCOME_WORDS = {
    "captured": "captured",
    "collided": "collided",
    "reached": "reached the target",
    "timed_out": "timed out",
    "cut": "cut short",
}

_SHIELD_COLOURS = {"none": GREY, "paper": ORANGE, "game": BLUE, "joint": GREEN}
_SHIELD_WORDS = {
    "none": "no shield",
    "paper": "paper's shield",
    "game": "game shield",
    "joint": "joint shield",
}
# Distinguishable without colour too, in print and where two colours are equally light.
_SHIELD_DASHES: dict[str, Any] = {
    "none": (0, (1, 1.2)),
    "paper": (0, (4, 1.5)),
    "game": (0, (6, 1.5, 1, 1.5)),
}
_OTHERS = (PURPLE, SKY, VERMILION, BLACK)

WIDTH, COLUMN = 7.16, 3.5
"""Widths of a two-column page's text and of one of its columns, inches."""
_CAPTION = "belongs into the caption"
_DPI = 200
_MOST_BYTES = 300_000

_SETTINGS: dict[str, Any] = {
    "font.family": "DejaVu Sans",
    "font.size": 8.0,
    "axes.titlesize": 9.0,
    "axes.titleweight": "bold",
    "axes.titlelocation": "left",
    "axes.labelsize": 8.0,
    "axes.labelcolor": INK,
    "axes.edgecolor": "#777777",
    "axes.linewidth": 0.6,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.axisbelow": True,
    "axes.unicode_minus": True,
    "text.color": INK,
    "xtick.labelsize": 7.5,
    "ytick.labelsize": 7.5,
    "xtick.color": "#555555",
    "ytick.color": "#555555",
    "xtick.labelcolor": INK,
    "ytick.labelcolor": INK,
    "xtick.major.width": 0.6,
    "ytick.major.width": 0.6,
    "xtick.major.size": 3.0,
    "ytick.major.size": 3.0,
    "legend.fontsize": 7.5,
    "legend.frameon": False,
    "legend.handlelength": 1.8,
    "lines.linewidth": 1.4,
    "lines.solid_capstyle": "round",
    "mathtext.fontset": "dejavusans",
    "figure.facecolor": "white",
    "savefig.facecolor": "white",
    "pdf.fonttype": 42,
    "svg.fonttype": "none",
}


def shield_colour(name: str, position: int = 0) -> str:
    """The colour of a shield in all figures; for a custom shield one of the other colours, by its
    position."""
    return _SHIELD_COLOURS.get(name, _OTHERS[position % len(_OTHERS)])


def shield_dashes(name: str) -> Any:
    """The line style of a shield in all figures; solid for `joint` and for custom shields."""
    return _SHIELD_DASHES.get(name, "solid")


def shield_words(name: str) -> str:
    """The name of a shield in captions."""
    return _SHIELD_WORDS.get(name, f"{name} shield")


def mark(colour: str, size: float | int, edge: str = "white", width: float = 0.8) -> dict[str, Any]:
    """Arguments of `Axes.plot` and `Line2D` for a single mark with an edge; size and width in points."""
    return {"color": colour, "ms": size, "mec": edge, "mew": width, "ls": "none"}


def draw_disc(
    axes: Axes, centre: tuple[float, float], radius: float, colour: str, *, alpha: float
) -> tuple[Circle, Circle]:
    """A tinted disc with a hairline edge, below everything else; **returns** disc and edge."""
    area = Circle(centre, radius, facecolor=colour, alpha=alpha, linewidth=0, zorder=1)
    edge = Circle(centre, radius, fill=False, edgecolor=colour, linewidth=0.8, zorder=2)
    axes.add_patch(area)
    axes.add_patch(edge)
    return area, edge


@contextmanager
def house_style() -> Iterator[None]:
    """Figures drawn in this context use the common style, independent of the user's matplotlib settings."""
    with matplotlib.rc_context():
        matplotlib.rcdefaults()
        matplotlib.rcParams.update(_SETTINGS)  # pyright: ignore[reportCallIssue, reportArgumentType]
        yield


def new_figure(width: float, height: float) -> Figure:
    """A figure of this size in inches, without a window and without global state."""
    figure = Figure(figsize=(width, height), layout="constrained")
    FigureCanvasAgg(figure)
    return figure


def light_grid(axes: Axes, axis: Any = "both") -> None:
    """A faint grid."""
    axes.grid(True, axis=axis, color="#E6E6E6", linewidth=0.6)


def panel_titles(axes: Sequence[Axes], titles: Sequence[str], *, in_caption: bool = False) -> None:
    """Titles with letters a, b, ... for references; no letter for a single panel.

    With `in_caption` the PDF, which is for papers, has the letters only: the titles belong in its caption.
    """
    for index, (one, title) in enumerate(zip(axes, titles, strict=True)):
        text = one.set_title(title if len(axes) == 1 else f"{chr(ord('a') + index)}   {title}")
        text.set_gid(_CAPTION if in_caption else None)


def figure_files(path: str | Path) -> tuple[Path, Path]:
    """The files that `save` writes: PNG, and PDF beside it."""
    path = Path(path)
    return path.with_suffix(".png"), path.with_suffix(".pdf")


def save(figure: Figure, path: str | Path) -> tuple[Path, Path]:
    """Write the figure as PNG and as PDF beside it; the suffix of `path`, if any, is replaced.

    The same figure gives the same bytes, without dates. The PNG's resolution is lowered until it is below
    300 kB. The PDF is for a two-column paper: fonts are embedded as TrueType, and titles marked `in_caption`
    are left out.
    """
    png, pdf = figure_files(path)
    content = b""
    place_labels(figure)
    for dpi in (_DPI, 160, 130, 100, 75):
        content = _as_png(figure, dpi)
        if len(content) < _MOST_BYTES:
            break
    write_bytes(png, content)
    buffer = BytesIO()
    for text in figure.findobj(lambda artist: artist.get_gid() == _CAPTION):
        letter, gap, _ = text.get_text().partition("   ")  # type: ignore[attr-defined]
        text.set_text(letter if gap else "")  # type: ignore[attr-defined]
    place_labels(figure)
    figure.savefig(buffer, format="pdf", metadata={"CreationDate": None, "Producer": None, "Creator": None})
    write_bytes(pdf, buffer.getvalue())
    return png, pdf


def _as_png(figure: Figure, dpi: int) -> bytes:
    buffer = BytesIO()
    figure.savefig(buffer, format="png", dpi=dpi, metadata={"Software": None}, pil_kwargs={"optimize": True})
    return buffer.getvalue()
