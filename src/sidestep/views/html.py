"""Numbers and pictures in HTML."""

from __future__ import annotations

import base64
from io import BytesIO
from pathlib import Path
from typing import Any

from PIL import Image


def data_uri(png: Path) -> str:
    """A PNG as a data URI, reduced to 256 colours, a third of the size."""
    buffer = BytesIO()
    with Image.open(png) as picture:
        picture.convert("RGB").quantize(256, dither=Image.Dither.NONE).save(buffer, "PNG", optimize=True)
    return "data:image/png;base64," + base64.b64encode(buffer.getvalue()).decode()


def shown_number(value: float | int | None, digits: int = 1, unit: str = "") -> str:
    """A formatted number; a dash for None."""
    return "–" if value is None else f"{value:,.{digits}f}{unit}".replace("-", "−").replace(" ", "\u00a0")


def shown_value(value: Any) -> str:
    """A formatted setting."""
    if value is None:
        return "random"
    return ", ".join(map(str, value)) if isinstance(value, (list, tuple)) else str(value)
