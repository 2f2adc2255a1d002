"""Bounds of the fields of dataclasses and modules, with one checker for all."""

from __future__ import annotations

import dataclasses
import difflib
import functools
import math
import operator
import re
from collections.abc import Callable, Iterable, Mapping
from typing import Any

_NUMERIC = re.compile(r"\b(int|float|Scalar|Float|Int)\b")
_LIMITS: dict[str, tuple[Callable[[Any, float], Any], str]] = {
    "above": (operator.gt, "greater than {}"),
    "least": (operator.ge, "{} or more"),
    "below": (operator.lt, "less than {}"),
    "most": (operator.le, "at most {}"),
}
_SHOWN = {math.pi / 2.0: "pi/2", 2**31 - 1: "2^31 - 1", 2**32 - 1: f"2^32 - 1, {2**32 - 1}"}


@dataclasses.dataclass(frozen=True)
class Bound:
    """The numbers that a field accepts. Called with a value, it returns a float, an int or a NumPy array.

    - the range: `above` or `least`, `below` or `most`, in `unit`
    - `whole` numbers only; their default `most` is 2^31 - 1, since compiled programs count in 32 bits
    - `shape` of an array of such numbers, None for any length; `empty`: whether it may be empty
    - `infinite`: whether infinity is allowed

    **Raises** `ValueError` when called with anything else; `str` says what is allowed.
    """

    above: int | float | None = None
    least: int | float | None = None
    below: int | float | None = None
    most: int | float | None = None
    unit: str = ""
    whole: bool = False
    shape: tuple[int | None, ...] = ()
    empty: bool = False
    infinite: bool = False

    @functools.cached_property
    def _limits(self) -> dict[str, int | float]:
        limits = {name: getattr(self, name) for name in _LIMITS}
        if self.whole and self.most is None:
            limits["most"] = 2**31 - 1
        return {name: limit for name, limit in limits.items() if limit is not None}

    def __call__(self, value: Any) -> Any:
        import jax
        import numpy as np

        array = np.asarray(value)
        if self.empty and array.size == 0:
            return np.zeros([size or 0 for size in self.shape])
        if array.dtype.kind not in ("iu" if self.whole else "iuf") or array.ndim != len(self.shape):
            raise ValueError
        if any(size != (wanted or size or 1) for size, wanted in zip(array.shape, self.shape, strict=True)):
            raise ValueError
        # Checked in the precision that is used: 1e-60 is 0 in float32, 1e60 infinite.
        with np.errstate(over="ignore", under="ignore"):
            numbers = array if self.whole else array.astype(jax.dtypes.canonicalize_dtype(float))
        for number in numbers.ravel().tolist():
            good = math.isfinite(number) or (self.infinite and number == math.inf)
            if not (good and all(_LIMITS[name][0](number, limit) for name, limit in self._limits.items())):
                raise ValueError
        return array if self.shape else array.item() if self.whole else float(value)

    def __str__(self) -> str:
        shown = {
            name: _SHOWN.get(limit, str(int(limit)) if limit == int(limit) else f"{limit:g}")
            for name, limit in self._limits.items()
        }
        if self.least is not None and self.most is not None:
            limits = f" from {shown['least']} to {shown['most']}"
        elif self.whole:
            limits = f" of at least {shown['least']} and at most {shown['most']}"
        else:
            limits = " and ".join(_LIMITS[name][1].format(limit) for name, limit in shown.items())
            limits = limits and f", {limits}"
        if self.unit and limits:
            limits += f" {self.unit}" if limits[-1].isdigit() else f", in {self.unit}"
        kind = "whole number" if self.whole else "number" if self.infinite else "finite number"
        if not self.shape:
            return f"a {kind}{limits}"
        length = " x ".join("n" if size is None else str(size) for size in self.shape)
        return f"{length} {kind}s" + (limits and f", each {limits.lstrip(', ')}")


@dataclasses.dataclass(frozen=True)
class Kind:
    """Values of a type, limited to `options` if there are any; called like a `Bound`."""

    type: type
    words: str
    options: tuple[Any, ...] = ()

    def __call__(self, value: Any) -> Any:
        if not isinstance(value, self.type) or (self.options and value not in self.options):
            raise ValueError
        return value

    def __str__(self) -> str:
        return self.words


def one_of(*options: str) -> Kind:
    """One of these texts."""
    return Kind(str, f"one of {', '.join(map(repr, options))}", options)


_FLAG, _TEXT = Kind(bool, "true or false"), Kind(str, "text")
SEED = Bound(least=0, most=2**32 - 1, whole=True)
"""JAX drops the upper bits of larger seeds, so that different seeds would be equal."""
EPISODES = Bound(least=1, most=10**8, whole=True)
SIDE_BY_SIDE = Bound(least=1, most=2**20, whole=True)
"""Number of episodes computed at once."""
DISTANCE = Bound(least=0.0, most=1e6, unit="m")
HEADING_ERROR = Bound(least=0.0, below=math.pi / 2.0, unit="rad")
DURATION = Bound(above=0.0, most=1e6)
DELAY = Bound(least=0.0, most=1e6, unit="s")
TRACKING_ERROR = Bound(least=0.0, most=1e6, unit="m/s")
ACCELERATION = Bound(above=0.0, most=1e6, unit="m/s^2")
WIND = Bound(shape=(2,), least=-100.0, most=100.0, unit="m/s")
WORKERS = Bound(least=1, most=1024, whole=True)
VISITORS = Bound(least=1, most=10_000, whole=True)
SPEED_UP = Bound(least=0.01, most=1000.0)
"""Speed of a video as a factor on real time."""


def within(rule: Bound | Kind | None = None, **limits: Any) -> dict[str, Any]:
    """The metadata of a field limited by `rule`, or of numbers with these limits, see `Bound`."""
    return {"allowed": rule or Bound(**limits)}


def bounded(default: Any, rule: Bound | Kind | None = None, **limits: Any) -> Any:
    """A field with limits: `bounded(0.2, above=0.0, unit="m/s")`. With an int default, for whole numbers."""
    metadata = within(rule, **{"whole": isinstance(default, int), **limits})
    return dataclasses.field(default=default, metadata=metadata)


def allowed(owner: Any) -> dict[str, Any]:
    """The `Bound` or `Kind` of each field of a dataclass: as declared, or according to its default for flags
    and texts; None for other fields without a declaration, and for fields of type `Any`.

    **Raises** `TypeError` for a numeric field without a declaration.
    """
    rules: dict[str, Any] = {}
    for field in dataclasses.fields(owner):
        by_default = None if "Any" in str(field.type) else {bool: _FLAG, str: _TEXT}.get(type(field.default))
        rules[field.name] = rule = field.metadata.get("allowed", by_default)
        if rule is None and _NUMERIC.search(str(field.type)):
            raise TypeError(
                f"field '{field.name}' of {owner} is numeric and declares no bound: see `bounded`"
            )
    return rules


def taken(name: str, value: Any, rule: Bound | Kind, error: type[ValueError] = ValueError) -> Any:
    """The value converted by `rule`. **Raises** `error`, with `name`, if `rule` does not allow it."""
    try:
        return rule(value)
    except (ValueError, TypeError):
        shown = value.tolist() if hasattr(value, "tolist") else value
        raise error(f"{name} = {shown!r}: it must be {rule}") from None


def check(
    owner: Any,
    values: Mapping[str, Any] | None = None,
    *,
    title: str = "",
    label: str = "{}",
    error: type[ValueError] = ValueError,
) -> dict[str, Any]:
    """The values of a dataclass' fields, checked against the fields' bounds and converted.

    **Arguments:** `owner` the class, with `values` for some of its fields; or an instance, whose values are
    checked. Messages start with `title` and name a field by `label`. A default of None is allowed.

    **Raises** `error` naming every invalid field, its value and what is allowed; `TypeError` as `allowed`.
    """
    optional = {field.name for field in dataclasses.fields(owner) if field.default is None}
    rules = allowed(owner)
    used = {name: getattr(owner, name) for name in rules} if values is None else dict(values)
    wrong = []
    for name, value in used.items():
        rule = rules[name]
        if rule is None or (value is None and name in optional):
            continue
        try:
            used[name] = taken(label.format(name), value, rule)
        except ValueError as refused:
            wrong.append(str(refused))
    if wrong:
        raise error(title + "; ".join(wrong))
    return used


def did_you_mean(name: str, known: Iterable[str]) -> str:
    """The end of a message about an unknown name: the most similar known one, if any is similar."""
    near = difflib.get_close_matches(name, list(known), n=1)
    return f"; did you mean '{near[0]}'?" if near else "."
