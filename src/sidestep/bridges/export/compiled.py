"""Decisions by compiled C in place of JAX: built on demand, kept on disk, and checked before they are used.

One call of a compiled JAX program takes some 50 us however little it computes. The same program as C, called
through ctypes, takes a few.
"""

from __future__ import annotations

import ctypes
import hashlib
import json
import logging
import math
import os
import shutil
import subprocess
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple, final

import jax
import numpy as np
from jaxtyping import Float

from sidestep.bridges.export.c_code import HELPERS, CBody, table
from sidestep.bridges.export.parity import SAME, random_states
from sidestep.bridges.export.program import KINDS, NotTranslatable, Program, Tables, kind_of
from sidestep.bridges.export.translate import translate
from sidestep.robot.answering import Answer, Answering, Estimate, Numbers
from sidestep.robot.readings import LARGEST
from sidestep.safety import Shield
from sidestep.store import programs

FLAGS = ("-std=c99", "-O2", "-ffp-contract=off", "-fPIC", "-shared")
"""What the C compiler is called with: every operation rounds by itself, as in JAX."""
_STATES, _FEWEST = 400, 100
"""States for the check, and how many of them it has to decide and to compare."""
_NUDGES, _ROUNDING, _TOUCHING = 8, 1e-6, 3e-3
_ACTION = 4
"""Entries of the answer's vector that are compared in every state: the nominal and the filtered velocity."""
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
        return self._jax.plan(world, _as_tree(memory))

    def __call__(
        self, world: Estimate, given: Numbers, ask: bool, flee: bool, delay: float, memory: Any
    ) -> tuple[Answer, Any]:
        numbers = self._jax.pack(world, given, ask, flee, delay)
        if not self._ready:
            memory = _as_tree(memory)
            self._native, self._ready = compiled(self._jax, numbers, memory), True
            if self._native is None or self._jax.may_look_ahead:
                # Nothing may be left to compile for later.
                self._jax.answer(numbers, memory)
        if self._native is not None:
            vector, decided, after = self._native(numbers, memory)
            if decided:
                return self._jax.unpack(vector), after
        vector, after = self._jax.answer(numbers, _as_tree(memory))
        return self._jax.unpack(vector), after


class _Memory(NamedTuple):
    """A memory as the library writes it, which takes a microsecond less than a pytree."""

    words: Numbers
    tree: Callable[[Numbers], Any]


def _as_tree(memory: Any) -> Any:
    return memory.tree(memory.words) if isinstance(memory, _Memory) else memory


class Native:
    """A loaded library: an `Answering` without look-ahead, from input vector and memory to answer and memory.

    **Arguments:** `path` of the library; an input vector and a memory as it will get them; `size` of the
    answer's vector. **Raises** `OSError` or `AttributeError` for a library that is none.
    """

    def __init__(self, path: Path, numbers: Numbers, memory: Any, size: int):
        leaves, self._structure = jax.tree.flatten(memory)
        self._shapes = [(np.shape(leaf), kind_of(np.asarray(leaf).dtype)) for leaf in leaves]
        count = sum(math.prod(shape) for shape, _ in self._shapes)
        self._words = np.zeros(len(numbers) + 2 * count + size + 1, np.float32)
        self._numbers, self._before = self._words[: len(numbers)], self._words[len(numbers) :][:count]
        self._outputs, self._size = self._words[len(numbers) + count :], size
        # It keeps Python's lock: to give it back and take it again takes longer than the call.
        self._library = ctypes.PyDLL(str(path))
        self._decide = self._library.sidestep_decide
        self._decide.argtypes, self._decide.restype = [ctypes.c_void_p], None
        self._address = self._words.ctypes.data

    def __call__(self, numbers: Numbers, memory: Any) -> tuple[Numbers, bool, Any]:
        """The answer's vector, whether it needs no look-ahead (else it is void), and the next memory."""
        self._numbers[:] = numbers
        self._before[:] = memory.words if isinstance(memory, _Memory) else self._flat(memory)
        self._decide(self._address)
        found, size = self._outputs.copy(), self._size
        return found[:size], found[size] != 0.0, _Memory(found[size + 1 :], self._tree)

    def _flat(self, memory: Any) -> Numbers:
        leaves = [np.asarray(leaf).reshape(-1) for leaf in jax.tree.leaves(memory)]
        kinds = [kind for _, kind in self._shapes]
        words = [
            leaf.astype(np.float32 if kind == "f" else np.int32).view(np.float32)
            for leaf, kind in zip(leaves, kinds, strict=True)
        ]
        return np.concatenate([*words, np.zeros(0, np.float32)])

    def _tree(self, words: Numbers) -> Any:
        leaves, at = [], 0
        for shape, kind in self._shapes:
            leaf = words[at : at + math.prod(shape)].reshape(shape)
            leaves.append(leaf if kind == "f" else leaf.view(np.int32).astype(KINDS[kind]))
            at += math.prod(shape)
        return jax.tree.unflatten(self._structure, leaves)


def compiled(answering: Answering, numbers: Numbers, memory: Any) -> Native | None:
    """The library for `answering`, kept or built now; None, after a line in the log, if JAX has to do it.

    **Arguments:** an input vector and a memory as it will get them.
    """
    if numbers.dtype != np.float32:
        return _without("JAX computes in double precision here, compiled decisions in single")
    folder = programs.folder()
    leaves = jax.tree.leaves(memory)
    shapes = [(np.shape(leaf), np.asarray(leaf).dtype.str) for leaf in leaves]
    about = (answering.shield, answering.policy, answering.rows_only, len(numbers), shapes, FLAGS)
    digest = None if folder is None else programs.digest_of("C", about)
    place = None if folder is None or digest is None else folder / f"{digest}.json"
    size = 8 + len(answering.unpack(np.zeros(8 + len(numbers))).barriers)
    if place is not None and (kept := _kept(place, numbers, memory, size)) is not None:
        return kept.native if kept.native is not None else _without(kept.why)
    begun = time.perf_counter()
    try:
        code = c_code(*_flat_program(answering, numbers, memory))
    except NotTranslatable as error:
        return _without(str(error))
    with tempfile.TemporaryDirectory(prefix="sidestep-") as scratch:
        library, why = build(Path(scratch), code)
        if library is None:
            return _without(why)
        content = library.read_bytes()
        try:
            native = Native(library, numbers, memory, size)
        except (OSError, AttributeError) as error:
            return _without(f"the compiled library cannot be loaded: {error}")
    verdict = agreement(native, answering, memory)
    verdict["library"] = _name(content)
    if place is not None and _keep(place, content, verdict):
        where = f"kept in {place.parent}"
    else:
        where = "not kept, so the next start takes as long"
    if verdict["why"]:
        return _without(verdict["why"])
    _log.info(
        "decisions are compiled: %.1f us, %.1f us in JAX; built and checked on %d states in %.1f s, %s",
        verdict["microseconds"], verdict["microseconds in JAX"], verdict["compared"],
        time.perf_counter() - begun, where,
    )  # fmt: skip
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
    if not verdict["why"] and not programs.keep(place.with_name(verdict["library"]), library):
        return False
    return programs.keep(place, json.dumps(verdict, indent=2).encode())


def _flat_program(answering: Answering, numbers: Numbers, memory: Any) -> tuple[Any, ...]:
    """`answering.at_once` as a function of arrays, and example arguments: the input vector, then the memory.
    It returns the answer's vector, 1.0 where the answer needs no look-ahead, and the next memory."""
    leaves, structure = jax.tree.flatten(memory)

    def decide(numbers: Any, *leaves: Any) -> tuple[Any, ...]:
        found = answering.at_once(numbers, jax.tree.unflatten(structure, leaves))
        if found is None:
            raise NotTranslatable("the shield has to look ahead")
        vector, decided, after = found
        return (vector, decided.astype(vector.dtype), *jax.tree.leaves(after))

    return decide, numbers, *leaves


def c_code(function: Callable[..., tuple[Any, ...]], *examples: Any) -> str:
    """C99 of a function of arrays that returns a tuple of arrays: `void sidestep_decide(struct words *io)`.

    The struct holds the entries of all arguments, then those of all results, each as a float or an int32_t.
    **Raises** `NotTranslatable`.
    """
    program = Program(Tables())
    inputs, fields, outputs = [], [], []
    for k, example in enumerate(map(np.asarray, examples)):
        kind, made = kind_of(example.dtype), np.empty(example.shape, object)
        for flat, place in enumerate(np.ndindex(*example.shape)):
            name = f"io->in{k}[{flat}]"
            made[place] = program.given(name if kind != "b" else f"({name} != 0)", kind)
        inputs.append(made)
        fields.append((f"in{k}", made.size, kind))
    for k, nodes in enumerate(translate(program, function, inputs)):
        flat = nodes.reshape(-1)
        outputs += [(f"io->out{k}[{place}]", node) for place, node in enumerate(flat)]
        fields.append((f"out{k}", flat.size, flat[0].kind if flat.size else "f"))
    body = CBody(program, outputs)
    lines = ["#include <math.h>", "#include <stdbool.h>", "#include <stdint.h>", "", HELPERS]
    for number in body.tables:
        lines += table(f"table{number}", program.tables.arrays[number])
    lines += ["struct words {"]
    for name, size, kind in fields:
        lines += [f"    {'float' if kind == 'f' else 'int32_t'} {name}[{size}];"] if size else []
    lines += ["};", "void sidestep_decide(struct words *io);", "void sidestep_decide(struct words *io)", "{"]
    return "\n".join([*lines, *body.lines(), "}", ""])


def build(folder: Path, code: str) -> tuple[Path | None, str]:
    """The library, or None and why there is none."""
    asked = os.environ.get("CC", "cc")
    compiler = shutil.which(asked)
    if compiler is None:
        return None, f"there is no C compiler {asked!r}; install one, such as gcc, or set CC"
    source, library = folder / "decide.c", folder / "decide.so"
    source.write_text(code, encoding="ascii")
    try:
        subprocess.run(
            [compiler, *FLAGS, "-o", library, source, "-lm"], check=True, capture_output=True, text=True
        )
    except subprocess.CalledProcessError as error:
        said = (error.stderr.strip().splitlines() or ["it says nothing"])[0]
        return None, f"{compiler} failed with status {error.returncode}: {said}"
    except OSError as error:
        return None, f"{compiler} cannot be run: {error.strerror}"
    return library, ""


def agreement(native: Native, answering: Answering, memory: Any) -> dict[str, Any]:
    """Compare `native` with JAX on random states; a verdict as JSON values.

    `why` says what is wrong with it, empty if nothing is; `states`, of which it `decided` so many; in those
    where no rounding error decides between two answers the two were `compared`. Where a number is not finite,
    or larger than the decision core lets through, only velocities, status, and whole numbers of the memory
    are. Medians of whole calls in `microseconds` and `microseconds in JAX`.
    """
    leaves, structure = jax.tree.flatten(memory)
    numbers, before = _states(answering, [np.asarray(leaf) for leaf in leaves])
    movable = np.ones(numbers.shape[1], bool)
    movable[answering.flags] = False
    rng = np.random.default_rng(1)
    verdict: dict[str, Any] = {"why": "", "states": len(numbers), "decided": 0, "compared": 0}
    spent: dict[str, list[float]] = {"microseconds": [], "microseconds in JAX": []}

    def ask(call: Callable[..., Any], given: Numbers, memory: Any, name: str = "") -> tuple[np.ndarray, ...]:
        begun = time.perf_counter()
        vector, *_, after = call(given, memory)
        vector = np.asarray(vector)
        if name:
            spent[name].append(1e6 * (time.perf_counter() - begun))
        flat = [np.asarray(leaf).reshape(-1) for leaf in jax.tree.leaves(_as_tree(after))]
        real = [vector[:_ACTION], vector[5:], *(leaf for leaf in flat if leaf.dtype.kind == "f")]
        whole = [vector[4:5], *(leaf for leaf in flat if leaf.dtype.kind != "f")]
        return np.concatenate(real), np.concatenate(whole, dtype=np.float32, casting="unsafe")

    answering.answer(numbers[0], jax.tree.unflatten(structure, [leaf[0] for leaf in before]))
    for i, given in enumerate(numbers):
        memory = jax.tree.unflatten(structure, [leaf[i] for leaf in before])
        if not native(given, memory)[1]:
            continue
        verdict["decided"] += 1
        found = ask(native, given, memory, "microseconds")
        wanted = ask(answering.answer, given, memory, "microseconds in JAX")
        allowed, open_ = np.full(wanted[0].shape, SAME + _TOUCHING), False
        with np.errstate(all="ignore"):
            for _ in range(_NUDGES):
                scale = np.maximum(np.abs(given), 1.0) * _ROUNDING * movable
                nudged = (given + rng.uniform(-1.0, 1.0, given.shape) * scale).astype(np.float32)
                other = ask(answering.answer, nudged, memory)
                allowed += np.abs(other[0] - wanted[0])
                open_ |= not np.array_equal(other[1], wanted[1], equal_nan=True)
            if open_:
                continue
            verdict["compared"] += 1
            off = np.abs(found[0] - wanted[0])
            credible = bool(np.all(np.abs(given) <= LARGEST))
        finite = np.isfinite(wanted[0])
        same = np.where(finite & np.isfinite(found[0]), ~(off > allowed), finite == np.isfinite(found[0]))
        # The rest is void there, such as distances that have overflowed.
        same = same if credible else same[:_ACTION]
        if not (np.all(same) and np.array_equal(found[1], wanted[1], equal_nan=True)):
            verdict["why"] = f"state {i} of the check is answered otherwise than by JAX"
            return verdict
    if verdict["compared"] < _FEWEST:
        verdict["why"] = f"the check could compare only {verdict['compared']} states"
        return verdict
    verdict |= {name: round(float(np.median(one)), 2) for name, one in spent.items()}
    if verdict["microseconds"] >= verdict["microseconds in JAX"]:
        verdict["why"] = "a call of it takes {microseconds} us, of JAX {microseconds in JAX}".format(
            **verdict
        )
    return verdict


def _states(answering: Answering, leaves: list[np.ndarray]) -> tuple[np.ndarray, list[np.ndarray]]:
    """Input vectors and leaves of memories for the check."""
    state, rng = random_states(answering.shield.scenario, _STATES, 0), np.random.default_rng(2)
    flags = rng.integers(0, 2, (2, _STATES)).astype(np.float32)
    delay = rng.uniform(0.0, 0.3, _STATES).astype(np.float32)
    names = ("evader", "pursuers", "obstacles", "target", "evader_velocity", "wheel_speeds", "time", "wish")
    parts = [*(state[name] for name in names), *flags, delay]
    numbers = np.concatenate([part.reshape(_STATES, -1) for part in parts], 1)
    return numbers, [
        rng.integers(-1, 2, (_STATES, *leaf.shape)).astype(KINDS[kind_of(leaf.dtype)]) for leaf in leaves
    ]
