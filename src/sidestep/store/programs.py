"""Compiled programs on disk, found by what they are made of: nothing is traced a second time."""

from __future__ import annotations

import functools
import hashlib
import io
import os
import pickle
import platform
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

import equinox as eqx
import jax
import jaxlib.version
import numpy as np
from jax.experimental import serialize_executable
from jax.experimental.compilation_cache import compilation_cache

from sidestep._arrays import traced
from sidestep.store.files import OutputError, write_bytes

_MOST = 64
"""Files in the folder; beyond it the least recently used ones are deleted."""
_SEAL = hashlib.sha256().digest_size
_PACKAGES = ("sidestep", "jax", "jaxlib", "equinox", "numpy", "builtins", "copyreg")
"""Packages whose code the digest stands for: ours by its source, the others by their versions."""


def folder() -> Path | None:
    """`sidestep` in the folder of JAX's compilation cache; None where JAX keeps no programs."""
    place = jax.config.jax_compilation_cache_dir  # type: ignore[attr-defined]
    return Path(place) / "sidestep" if place and jax.config.jax_enable_compilation_cache else None  # type: ignore[attr-defined]


def digest_of(*parts: Any) -> str | None:
    """A digest of `parts`, of the package's source, of what it runs on and of JAX's settings.

    None if it would not tell everything: for parts with code of other packages, or that cannot be pickled.
    """
    text = io.BytesIO()
    try:
        recipe = _Recipe(text)
        # Which parts are the same object does not count.
        recipe.fast = True
        recipe.dump(parts)
        source = _source()
    except (pickle.PicklingError, AttributeError, TypeError, ValueError, RecursionError, OSError):
        return None
    settings = [jax.config.jax_enable_x64, jax.config.jax_default_matmul_precision]  # type: ignore[attr-defined]
    settings += [os.environ.get(name) for name in ("XLA_FLAGS", "PJRT_NPROC")]
    about = repr((source, _machine(), settings)).encode()
    return hashlib.sha256(about + text.getvalue()).hexdigest()


class _Recipe(pickle.Pickler):
    """Refuses code that the digest does not stand for."""

    def reducer_override(self, value: Any) -> Any:
        package = (getattr(value, "__module__", None) or "builtins").partition(".")[0]
        if package not in _PACKAGES:
            raise pickle.PicklingError(f"{value!r} is of another package")
        return NotImplemented


@functools.cache
def _source() -> str:
    """A digest of the package's source. **Raises** `OSError` if it lies in no folder."""
    here, found = Path(__file__).parents[1], hashlib.sha256()
    for path in sorted(here.rglob("*.py")):
        found.update(str(path.relative_to(here)).encode() + b"\0" + path.read_bytes())
    return found.hexdigest()


@functools.cache
def _machine() -> tuple[str, ...]:
    """Versions, and the processor: XLA compiles for this one."""
    processor = ""
    with suppress(OSError):
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines()
        processor = "".join(
            sorted({line for line in lines if line.startswith(("model name", "flags", "Features"))})
        )
    versions = (jax.__version__, jaxlib.version.__version__, eqx.__version__, np.__version__, sys.version)
    return (*versions, platform.platform(), processor)


def read_own(path: Path) -> bytes | None:
    """The content of a file that belongs to this user or to the administrator; None if there is none."""
    try:
        with open(path, "rb") as file:
            owner, content = os.fstat(file.fileno()).st_uid, file.read()
    except OSError:
        return None
    if hasattr(os, "getuid") and owner not in (0, os.getuid()):
        return None
    with suppress(OSError):
        os.utime(path)
    return content


def keep(path: Path, content: bytes) -> bool:
    """Write a file whole; returns whether that was possible.

    Beyond 64 files in the folder, those that were not used for longest are deleted.
    """
    try:
        write_bytes(path, content)
    except OutputError:
        return False
    with suppress(OSError):
        files = sorted(path.parent.glob("[!.]*"), key=lambda one: one.stat().st_mtime)
        for old in files[:-_MOST]:
            old.unlink(missing_ok=True)
    return True


def kept_program(about: Any, function: Callable[..., Any], *examples: Any) -> Callable[..., Any]:
    """`function` compiled for arguments like `examples`, which are arrays; it returns a pytree of arrays.

    Where JAX keeps compiled programs, so does this, under a digest of `about`, which must determine the
    function. A program that is there is loaded, in some 10 ms per MB, and `function` is not traced.
    """
    place = folder()
    shapes = [(np.shape(one), np.dtype(one.dtype).str) for one in examples]
    digest = None if place is None or jax.default_backend() != "cpu" else digest_of(about, shapes)
    if place is None or digest is None:
        return jax.jit(function)
    path = place / f"{digest}.xla"
    content = read_own(path) or b""
    # JAX raises errors of many kinds for what another version wrote, and cannot write every program.
    with suppress(Exception):
        if hashlib.sha256(content[_SEAL:]).digest() == content[:_SEAL]:
            return _loaded(content[_SEAL:], examples)
    like: Any = None

    def flat(*given: Any) -> list[Any]:
        nonlocal like
        leaves, structure = jax.tree.flatten(function(*given))
        # An object, because structures do not outlive the process.
        like = jax.tree.unflatten(structure, range(len(leaves)))
        return leaves

    lowered = jax.jit(flat).lower(*examples)
    with _compiling_anew():
        compiled = lowered.compile()
    with suppress(Exception):
        content = pickle.dumps((serialize_executable.serialize(compiled), like))
        _loaded(content, examples)
        keep(path, hashlib.sha256(content).digest() + content)
    return _joined(compiled, like)


def kept_jit(function: Callable[..., Any]) -> Callable[..., Any]:
    """`equinox.filter_jit` of a function of this package, as a `kept_program` for each kind of arguments."""
    jitted, made = eqx.filter_jit(function), dict[str, Callable[..., Any]]()
    name = f"{function.__module__}.{function.__qualname__}"

    @functools.wraps(function)
    def call(*arguments: Any) -> Any:
        arrays, fixed = eqx.partition(arguments, eqx.is_array)
        leaves, structure = jax.tree.flatten(arrays)
        if folder() is None or traced(leaves):
            return jitted(*arguments)
        digest = digest_of(name, fixed, [(leaf.shape, str(leaf.dtype)) for leaf in leaves])
        if digest is None:
            return jitted(*arguments)

        def flat(*leaves: Any) -> Any:
            return function(*eqx.combine(jax.tree.unflatten(structure, leaves), fixed))

        if digest not in made:
            made[digest] = kept_program((name, fixed), flat, *leaves)
        return made[digest](*leaves)

    return call


def _loaded(content: bytes, examples: tuple[Any, ...]) -> Callable[..., Any]:
    """A program that was kept. It is tried: some errors come only then."""
    payload, like = pickle.loads(content)
    program = _joined(serialize_executable.deserialize_and_load(*payload), like)
    program(*examples)
    return program


@contextmanager
def _compiling_anew() -> Iterator[None]:
    """A context without JAX's own cache: a program that comes from there cannot be written again."""
    jax.config.update("jax_enable_compilation_cache", False)
    compilation_cache.reset_cache()
    try:
        yield
    finally:
        jax.config.update("jax_enable_compilation_cache", True)
        compilation_cache.reset_cache()


def _joined(compiled: Callable[..., Any], like: Any) -> Callable[..., Any]:
    structure = jax.tree.structure(like)
    return lambda *given: jax.tree.unflatten(structure, compiled(*given))
