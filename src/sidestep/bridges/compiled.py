"""Decisions by compiled C in place of JAX: built on demand, kept on disk, and checked before they are used.

One call of a compiled JAX program takes some 50 us however little it computes. The same program as C, called
through ctypes, takes a few.
"""

from __future__ import annotations

import ctypes
import hashlib
import json
import logging
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple, final

import jax
import numpy as np
from jaxtyping import Float

from sidestep.robot.answering import Answer, Answering, Estimate, Numbers
from sidestep.safety import Shield
from sidestep.store import programs

_log = logging.getLogger("sidestep")


@final
class CompiledAnswering:
    """As `sidestep.robot.answering.Answering`, by compiled C where that is faster and agrees with JAX.

    The first call translates the shield and the policy, compiles with `cc` (or `$CC`), and compares some
    hundred states with JAX, also ones that are not finite. The library and the verdict are kept where JAX
    keeps compiled programs (see `sidestep.store.programs`), so that the next process only loads them. Where
    the shield has to look ahead, JAX decides.

    JAX decides everything, and a line in the log says why, if there is no compiler, if it fails, if the
    shield or the policy cannot be translated, if an answer differs, or if C is not faster.
    """

    def __init__(self, shield: Shield, policy: Callable[..., Any] | None, *, rows_only: bool = False):
        self._jax = Answering(shield, policy, rows_only=rows_only)
        self._native: Native | None = None
        self._ready = False

    @property
    def compiled(self) -> bool:
        """Whether compiled C decides; known after the first call."""
        return self._native is not None

    def start(self, world: Estimate) -> Any:
        return self._jax.start(world)

    def plan(self, world: Estimate, memory: Any) -> Float[np.ndarray, "n 2"]:
        return self._jax.plan(world, as_tree(memory))

    def __call__(
        self, world: Estimate, given: Numbers, ask: bool, flee: bool, delay: float, memory: Any
    ) -> tuple[Answer, Any]:
        numbers = self._jax.pack(world, given, ask, flee, delay)
        if not self._ready:
            memory = as_tree(memory)
            self._native, self._ready = compiled(self._jax, numbers, memory), True
            if self._native is None or self._jax.may_look_ahead:
                # Nothing may be left to compile for later.
                self._jax.answer(numbers, memory)
        if self._native is not None:
            vector, decided, after = self._native(numbers, memory)
            if decided:
                return self._jax.unpack(vector), after
        vector, after = self._jax.answer(numbers, as_tree(memory))
        return self._jax.unpack(vector), after


class _Memory(NamedTuple):
    """A memory as a library writes it: to make a pytree of it takes a microsecond or two."""

    words: np.ndarray
    tree: Callable[[np.ndarray], Any]


def as_tree(memory: Any) -> Any:
    """The pytree of a memory, whoever wrote it."""
    return memory.tree(memory.words) if isinstance(memory, _Memory) else memory


@final
class Native:
    """A loaded library: an `Answering` without look-ahead, from input vector and memory to answer and memory.

    **Arguments:** `path` of the library; an input vector and a memory as it will get them; `size` of the
    answer's vector. **Raises** `OSError` or `AttributeError` for a file that is no such library.
    """

    def __init__(self, path: Path, numbers: Numbers, memory: Any, size: int):
        leaves, self._structure = jax.tree.flatten(memory)
        self._like = [np.asarray(leaf) for leaf in leaves]
        count = sum(leaf.size for leaf in self._like)
        # It keeps Python's lock: to give it back and take it again takes longer than the call.
        library = ctypes.PyDLL(str(path))
        self._decide = library.sidestep_decide
        self._decide.argtypes, self._decide.restype = [ctypes.c_void_p], None
        self._size = size
        # As in the library's struct: input vector, memory, answer, whether it is decided, next memory.
        self._words = np.zeros(len(numbers) + 2 * count + self._size + 1, np.float32)
        self._numbers = self._words[: len(numbers)]
        self._before = self._words[len(numbers) : len(numbers) + count]
        self._outputs = self._words[len(numbers) + count :]
        self._address = self._words.ctypes.data

    def __call__(self, numbers: Numbers, memory: Any) -> tuple[np.ndarray, bool, Any]:
        """The answer's vector, whether it needs no look-ahead (else all is void), and the next memory, of
        which `as_tree` makes a pytree."""
        self._numbers[:] = numbers
        self._before[:] = memory.words if isinstance(memory, _Memory) else self._flat(memory)
        self._decide(self._address)
        found, size = self._outputs.copy(), self._size
        return found[:size], bool(found[size]), _Memory(found[size + 1 :], self._tree)

    def with_pytree(self, numbers: Numbers, memory: Any) -> tuple[np.ndarray, bool, Any]:
        """The same, with the next memory as a pytree."""
        vector, decided, after = self(numbers, memory)
        return vector, decided, as_tree(after)

    def _flat(self, memory: Any) -> np.ndarray:
        words = [np.zeros(0, np.float32)]
        for leaf in map(np.asarray, jax.tree.leaves(memory)):
            word = np.float32 if leaf.dtype.kind == "f" else np.int32
            words.append(leaf.reshape(-1).astype(word).view(np.float32))
        return np.concatenate(words)

    def _tree(self, words: np.ndarray) -> Any:
        leaves, at = [], 0
        for like in self._like:
            leaf = words[at : at + like.size].reshape(like.shape)
            leaves.append(leaf if like.dtype.kind == "f" else leaf.view(np.int32).astype(like.dtype))
            at += like.size
        return jax.tree.unflatten(self._structure, leaves)


def compiled(answering: Answering, numbers: Numbers, memory: Any) -> Native | None:
    """The library for `answering`, kept or built now; None, after a line in the log, if JAX has to do it.

    **Arguments:** an input vector and a memory as it will get them.
    """
    if numbers.dtype != np.float32:
        return _without("JAX computes in double precision here, compiled decisions in single")
    folder, leaves = programs.folder(), jax.tree.leaves(memory)
    shapes = [(np.shape(leaf), np.asarray(leaf).dtype.str) for leaf in leaves]
    about = ("C", answering.shield, answering.policy, answering.rows_only, len(numbers), shapes)
    digest = None if folder is None else programs.digest_of(about)
    place = None if folder is None or digest is None else folder / f"{digest}.json"
    if place is not None and (kept := _kept(place, numbers, memory, answering.size)) is not None:
        return kept.native if kept.native is not None else _without(kept.why)
    try:
        return _built(answering, numbers, memory, place)
    except Exception as error:
        # Whatever it is, a robot that starts can still be guided by JAX.
        return _without(f"{type(error).__name__}: {error}".splitlines()[0])


def _built(answering: Answering, numbers: Numbers, memory: Any, place: Path | None) -> Native | None:
    # Not before: it takes a sixth of a second, and a library that was kept needs none of it.
    from sidestep.bridges.export.agreement import agreement
    from sidestep.bridges.export.library import build, c_code, compiler
    from sidestep.bridges.export.program import NotTranslatable

    begun, native, library = time.perf_counter(), None, b""
    if (program := compiler()) is None:
        return _without("there is no C compiler cc; install one, such as gcc, or name yours in CC")
    try:
        code = c_code(*_flat_program(answering, numbers, memory))
    except NotTranslatable as error:
        verdict: dict[str, Any] = {"why": str(error)}
    else:
        with tempfile.TemporaryDirectory(prefix="sidestep-") as scratch:
            path, why = build(Path(scratch), code, program)
            if path is None:
                # Not kept: a compiler can be installed.
                return _without(why)
            library = path.read_bytes()
            try:
                native = Native(path, numbers, memory, answering.size)
            except (OSError, AttributeError) as error:
                return _without(f"the compiled library cannot be loaded: {error}")
        verdict = agreement(native.with_pytree, answering, memory)
    is_kept = place is not None and _keep(place, library, verdict)
    if native is None or verdict["why"]:
        return _without(verdict["why"])
    _log.info(
        "decisions are compiled: %.1f us, %.1f us in JAX; built and checked on %d states in %.1f s%s",
        verdict["microseconds"],
        verdict["microseconds in JAX"],
        verdict["compared"],
        time.perf_counter() - begun,
        "" if is_kept else ", and not kept: the next start takes as long",
    )
    return native


def _without(why: str) -> None:
    _log.warning("decisions are made by JAX, not by compiled C: %s", why)


class _Kept(NamedTuple):
    native: Native | None
    why: str


def _kept(place: Path, numbers: Numbers, memory: Any, size: int) -> _Kept | None:
    """What an earlier process built and found; None if there is nothing that is whole."""
    try:
        verdict = json.loads(programs.read_own(place) or b"")
        if verdict["why"]:
            return _Kept(None, verdict["why"])
        library = place.with_name(verdict["library"])
        if _name(programs.read_own(library) or b"") != library.name:
            return None
        return _Kept(Native(library, numbers, memory, size), "")
    except (ValueError, KeyError, TypeError, OSError, AttributeError):
        return None


def _name(library: bytes) -> str:
    """By its content: processes that build at once write the same file, or two."""
    return f"{hashlib.sha256(library).hexdigest()}.so"


def _keep(place: Path, library: bytes, verdict: dict[str, Any]) -> bool:
    """Write the library, then the verdict that names it."""
    if not verdict["why"]:
        verdict["library"] = _name(library)
        if not programs.keep(place.with_name(verdict["library"]), library):
            return False
    return programs.keep(place, json.dumps(verdict, indent=2).encode())


def _flat_program(answering: Answering, numbers: Numbers, memory: Any) -> tuple[Any, ...]:
    """`answering.at_once` as a function of arrays, and example arguments: the input vector, then the memory.
    It returns the answer's vector, 1.0 where the answer needs no look-ahead, and the next memory."""
    from sidestep.bridges.export.program import NotTranslatable

    leaves, structure = jax.tree.flatten(memory)

    def decide(numbers: Any, *leaves: Any) -> tuple[Any, ...]:
        found = answering.at_once(numbers, jax.tree.unflatten(structure, leaves))
        if found is None:
            raise NotTranslatable("the shield has to look ahead")
        vector, decided, after = found
        return (vector, decided.astype(vector.dtype), *jax.tree.leaves(after))

    return decide, numbers, *leaves
