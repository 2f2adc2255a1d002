"""Names that have moved: the old one still works for one release, and says where it is now."""

from __future__ import annotations

import importlib
import warnings
from collections.abc import Callable, Mapping
from typing import Any


def moved_names(old: str, names: Mapping[str, str]) -> Callable[[str], Any]:
    """A module's `__getattr__` for names that are in other modules now.

    **Arguments:** `old` the module's own name, `names` the module that each name is in now.

    The function warns `DeprecationWarning` at the line that uses the old name.
    """

    def find(name: str) -> Any:
        if name not in names:
            raise AttributeError(f"module {old!r} has no attribute {name!r}")
        message = f"{old}.{name} is {names[name]}.{name} now; the old name goes with the next release"
        warnings.warn(message, DeprecationWarning, stacklevel=2)
        return getattr(importlib.import_module(names[name]), name)

    return find


def moved_module(old: str, new: str) -> Callable[[str], Any]:
    """The same for a module all of whose names are in the module `new` now."""

    def find(name: str) -> Any:
        if name.startswith("__"):
            raise AttributeError(f"module {old!r} has no attribute {name!r}")
        return moved_names(old, {name: new})(name)

    return find
