"""Place labels without overlap: each at the first free position around its point, or not at all."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, final

from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.text import Annotation, Text
from matplotlib.transforms import Bbox

_DOT = 2.5
"""Half the width (points) of the square that is kept free around every labelled point."""


@final
class Label(Annotation):
    """A text beside a point of the data, positioned by `place_labels`.

    **Arguments:** `point` in data units; `places`, offsets from it in points, the best one first; `rank`,
    labels with the lowest rank are placed first.
    """

    def __init__(
        self,
        text: str,
        point: tuple[float, float],
        places: Sequence[tuple[float, float]],
        *,
        rank: int = 0,
        **look: Any,
    ):
        super().__init__(
            text, point, xytext=places[0], textcoords="offset points", ha="center", va="center",
            clip_on=False, **look,
        )  # fmt: skip
        self.places, self.rank = tuple(places), rank


def place_labels(figure: Figure) -> None:
    """Move every `Label` to its first place inside the axes that covers no text and no labelled point; hide
    labels without such a place."""
    found = {
        axes: [child for child in axes.get_children() if isinstance(child, Label)] for axes in figure.axes
    }
    if not any(found.values()):
        return
    # Texts have their places only once the figure has been laid out.
    figure.draw_without_rendering()
    for axes, labels in found.items():
        if labels:
            _place(axes, sorted(labels, key=lambda label: label.rank))


def _place(axes: Axes, labels: list[Label]) -> None:
    figure: Any = axes.figure
    renderer, frame = figure.canvas.get_renderer(), axes.get_window_extent()
    taken = [
        child.get_window_extent(renderer)
        for child in axes.get_children()
        if isinstance(child, Text) and not isinstance(child, Label) and child.get_text()
    ]
    half = _DOT * figure.dpi / 72.0
    dots = [axes.transData.transform(label.xy) for label in labels]
    taken += [Bbox.from_extents(x - half, y - half, x + half, y + half) for x, y in dots]
    for label in labels:
        label.set_visible(True)
        for place in label.places:
            label.set_position(place)
            box = label.get_window_extent(renderer)
            inside = frame.x0 <= box.x0 and box.x1 <= frame.x1 and frame.y0 <= box.y0 and box.y1 <= frame.y1
            if inside and not any(box.overlaps(other) for other in taken):
                taken.append(box)
                break
        else:
            label.set_visible(False)
