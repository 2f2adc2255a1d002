"""Does a compiled decision answer as JAX does, and is it faster?"""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any

import jax
import numpy as np

from sidestep.bridges.export.parity import SAME, random_states
from sidestep.bridges.export.program import KINDS, kind_of
from sidestep.robot.answering import Answering, Numbers
from sidestep.robot.readings import LARGEST

_STATES, _FEWEST = 400, 100
"""States for the check, and how many of them have to be compared."""
_NUDGES, _ROUNDING, _TOUCHING = 8, 1e-6, 3e-3
_ROUGH = 0.02
"""Share of the states that may be `rough`."""
_ACTION = 4
"""Entries of the answer's vector that are compared in every state: the nominal and the filtered velocity."""


def agreement(native: Callable[..., Any], answering: Answering, memory: Any) -> dict[str, Any]:
    """Compare `native(input vector, memory)`, which returns what `answering.at_once` does, with JAX on random
    states; a verdict as JSON values.

    - `why`: what is wrong with it, empty if nothing is
    - `states`, of which it `decided` so many without a look-ahead; `compared` are those of them in which no
      rounding error decides between two answers, `rough` those in which a square root makes up to 3e-3 m/s
      of one. Where a number is not finite, or larger than the decision core lets through, only velocities,
      status and whole numbers of the memory are compared
    - `microseconds`, `microseconds in JAX`: medians of whole calls
    """
    leaves, structure = jax.tree.flatten(memory)
    numbers, before = _states(answering, [np.asarray(leaf) for leaf in leaves])
    movable = np.ones(numbers.shape[1], bool)
    movable[answering.flags] = False
    rng = np.random.default_rng(1)
    verdict: dict[str, Any] = {"why": "", "states": len(numbers)}
    verdict |= dict.fromkeys(("decided", "compared", "rough"), 0)
    spent: dict[str, list[float]] = {"microseconds": [], "microseconds in JAX": []}

    def ask(call: Callable[..., Any], given: Numbers, memory: Any, name: str = "") -> tuple[np.ndarray, ...]:
        begun = time.perf_counter()
        vector, *_, after = call(given, memory)
        vector = np.asarray(vector)
        if name:
            spent[name].append(1e6 * (time.perf_counter() - begun))
        flat = [np.asarray(leaf).reshape(-1) for leaf in jax.tree.leaves(after)]
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
        allowed, open_ = np.full(wanted[0].shape, SAME), False
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
        close = np.where(finite & np.isfinite(found[0]), ~(off > allowed), finite == np.isfinite(found[0]))
        same = close | (off <= allowed + _TOUCHING)
        if not credible:
            # The rest is void there, such as distances that have overflowed.
            close, same = close[:_ACTION], same[:_ACTION]
        verdict["rough"] += int(not np.all(close))
        if not (np.all(same) and np.array_equal(found[1], wanted[1], equal_nan=True)):
            verdict["why"] = f"state {i} of the check is answered otherwise than by JAX"
            return verdict
    if verdict["compared"] < _FEWEST:
        verdict["why"] = f"the check could compare only {verdict['compared']} states"
        return verdict
    if verdict["rough"] > _ROUGH * verdict["compared"]:
        verdict["why"] = "{rough} of {compared} states of the check differ by rounding".format(**verdict)
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
