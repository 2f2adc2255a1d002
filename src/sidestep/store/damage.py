"""What is said when something on disk is damaged, and the work goes on without it?"""

from __future__ import annotations

import sys
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any


class DamageWarning(UserWarning):
    """A file is damaged and was passed over; the text names it, and says what was lost and what follows."""


@contextmanager
def damage_on_stderr() -> Iterator[None]:
    """While this lasts, each `DamageWarning` is one line on the error stream."""
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
