"""Moved names: the old name works for one release, with a warning that names the new module."""

from __future__ import annotations

import importlib
import inspect
import warnings
from collections.abc import Callable, Mapping
from typing import Any, TypeVar

_Class = TypeVar("_Class", bound=type)
_WRAPPERS = ("equinox", "jaxtyping", "importlib")


def moved_names(old: str, names: Mapping[str, str]) -> Callable[[str], Any]:
    """A module's `__getattr__` for names that were moved to other modules.

    **Arguments:** `old` the module's name, `names` the new module of each name.

    The function warns `DeprecationWarning` at the line that uses the old name.
    """

    def find(name: str) -> Any:
        if name not in names:
            raise AttributeError(f"module {old!r} has no attribute {name!r}")
        words = _words(f"{old}.{name}", f"{names[name]}.{name}")
        _warn(words)
        return getattr(importlib.import_module(names[name]), name)

    return find


def moved_module(old: str, new: str) -> Callable[[str], Any]:
    """As `moved_names`, for a module whose names were all moved to the module `new`."""

    def find(name: str) -> Any:
        if name.startswith("__"):
            raise AttributeError(f"module {old!r} has no attribute {name!r}")
        return moved_names(old, {name: new})(name)

    return find


def renamed(function: Callable[..., Any], old: str) -> Callable[..., Any]:
    """`function` under its old name, which warns `DeprecationWarning` where it is called."""

    def call(*arguments: Any, **named: Any) -> Any:
        _warn(_words(old, function.__name__))
        return function(*arguments, **named)

    return call


def renamed_methods(subclass: type, names: Mapping[str, str]) -> None:
    """For the `__init_subclass__` of a base class whose methods were renamed.

    A subclass that defines an old name warns `DeprecationWarning` and also gets the new one. A subclass that
    defines a new name also gets the old one, see `renamed`.

    **Arguments:** `names` old to new.
    """
    for old, new in names.items():
        if old in vars(subclass):
            function = vars(subclass)[old]
            code = inspect.unwrap(function).__code__
            words, place = _words(f"{subclass.__name__}.{old}", new), (code.co_filename, code.co_firstlineno)
            warnings.warn_explicit(words, DeprecationWarning, *place, module=subclass.__module__)
            setattr(subclass, new, function)
        elif new in vars(subclass):
            setattr(subclass, old, renamed(vars(subclass)[new], old))


def renamed_arguments(**names: str) -> Callable[[_Class], _Class]:
    """Decorate a class whose fields were renamed: the old keyword still works, with a warning."""

    def decorate(decorated: _Class) -> _Class:
        begin: Callable[..., None] = decorated.__init__

        def __init__(self: Any, *arguments: Any, **named: Any) -> None:
            for old in names.keys() & named.keys():
                _warn(_words(old, names[old]))
                named[names[old]] = named.pop(old)
            begin(self, *arguments, **named)

        decorated.__init__ = __init__
        return decorated

    return decorate


def _words(old: str, new: str) -> str:
    return f"{old} is {new} now; the old name goes with the next release"


def _warn(words: str) -> None:
    """Warn at the caller's line: the first outside this package and the libraries that wrap its methods."""
    frame, level = inspect.currentframe(), 1
    while frame and frame.f_globals.get("__name__", "").partition(".")[0] in ("sidestep", *_WRAPPERS):
        frame, level = frame.f_back, level + 1
    warnings.warn(words, DeprecationWarning, stacklevel=level)
