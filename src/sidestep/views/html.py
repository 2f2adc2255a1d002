"""How numbers and pictures are put into HTML."""

from __future__ import annotations

import base64
from pathlib import Path
from typing import Any


def data_uri(png: Path) -> str:
    """A PNG as a data URI."""
    return "data:image/png;base64," + base64.b64encode(png.read_bytes()).decode()


def shown_number(value: float | int | None, digits: int = 1, unit: str = "") -> str:
    """A number for readers; a dash for none."""
    return "–" if value is None else f"{value:,.{digits}f}{unit}".replace("-", "−").replace(" ", "\u00a0")


def shown_value(value: Any) -> str:
    """A setting for readers."""
    if value is None:
        return "random"
    return ", ".join(map(str, value)) if isinstance(value, (list, tuple)) else str(value)
