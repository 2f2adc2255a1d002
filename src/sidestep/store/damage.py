"""The warning about a damaged file that was skipped."""

from __future__ import annotations

import sys
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any


class DamageWarning(UserWarning):
    """A damaged file was skipped; the text names it, what was lost, and the consequence."""


@contextmanager
def damage_on_stderr() -> Iterator[None]:
    """A context in which each `DamageWarning` is printed as one line on the error stream."""
    with warnings.catch_warnings():
        warnings.simplefilter("always", DamageWarning)
        shown = warnings.showwarning

        def show(message: Any, category: type[Warning], *where: Any, **more: Any) -> None:
            if issubclass(category, DamageWarning):
                print(f"sidestep: warning: {message}", file=sys.stderr)
            else:
                shown(message, category, *where, **more)

        warnings.showwarning = show
        yield
