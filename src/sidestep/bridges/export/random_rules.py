"""Rules for `jax.random`: the same random numbers, bit by bit, from keys as two whole numbers.

Keys must be raw ones, of `jax.random.PRNGKey`: typed keys hide their words from the program.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, no_type_check

import jax
import jax.numpy as jnp
import numpy as np
from jax.extend.random import threefry_prng_impl

from sidestep.bridges.export.program import Node

_ROTATIONS = ((13, 15, 26, 6), (17, 29, 16, 24))
"""Bits by which Threefry-2x32 rotates, four rounds at a time (Salmon et al., SC 2011, table 2)."""
_PARITY = np.int32(0x1BD11BDA)


@no_type_check  # called millions of times
class RandomRules:
    """Rules of a translator for keys and the numbers drawn from them."""

    program: Any
    op: Callable[..., Node]
    nodes: Callable[[Any], Any]
    run: Callable[..., list[Any]]

    def _random_wrap(self, equation: Any, words: Any) -> Any:
        return words

    def _random_unwrap(self, equation: Any, words: Any) -> Any:
        return words

    def _random_seed(self, equation: Any, seed: Any) -> Any:
        return self._inner(threefry_prng_impl.seed, seed)

    def _random_split(self, equation: Any, words: Any) -> Any:
        shape = equation.params["shape"]
        return self._inner(lambda key: threefry_prng_impl.split(key, shape), words)

    def _random_fold_in(self, equation: Any, words: Any, number: Any) -> Any:
        return self._inner(threefry_prng_impl.fold_in, words, number)

    def _random_bits(self, equation: Any, words: Any) -> Any:
        width, shape = equation.params["bit_width"], equation.params["shape"]
        if width != 32:
            raise NotImplementedError(f"{width} random bits")
        return self._inner(lambda key: threefry_prng_impl.random_bits(key, 32, shape), words)

    def _inner(self, function: Callable[..., Any], *values: Any) -> Any:
        """What a function of JAX's generator returns for these words."""
        if values[0].shape not in ((), (2,)):
            raise NotImplementedError("many keys at once, or typed ones")
        examples = [jax.ShapeDtypeStruct(value.shape, jnp.uint32) for value in values]
        traced = jax.make_jaxpr(function)(*examples)
        words = [value if value.dtype == object else value.astype(np.uint32) for value in values]
        return self.run(traced.jaxpr, traced.consts, words)[0]

    def _threefry2x32(self, equation: Any, *values: Any) -> list[Any]:
        """Twenty rounds of Threefry-2x32: key words first, then the words to be encrypted."""
        shape = equation.outvars[0].aval.shape
        keys, counts = [np.broadcast_to(self.nodes(value), shape) for value in values[:2]], values[2:]
        counts = [np.broadcast_to(self.nodes(value), shape) for value in counts]
        made = [np.empty(shape, object), np.empty(shape, object)]
        for place in np.ndindex(*shape):
            schedule: list[Any] = [keys[0][place], keys[1][place]]
            parity = self.op("xor", self.program.constant(_PARITY), self.op("xor", *schedule))
            schedule.append(parity)
            one, other = (self.op("add", counts[k][place], schedule[k]) for k in (0, 1))
            for group in range(5):
                for turn in _ROTATIONS[group % 2]:
                    one = self.op("add", one, other)
                    other = self.op("xor", one, self._rotated(other, turn))
                number = self.program.constant(np.int32(group + 1))
                one = self.op("add", one, schedule[(group + 1) % 3])
                other = self.op("add", self.op("add", other, schedule[(group + 2) % 3]), number)
            made[0][place], made[1][place] = one, other
        return made

    def _rotated(self, word: Node, bits: int) -> Node:
        left, right = (self.program.constant(np.int32(n)) for n in (bits, 32 - bits))
        return self.op("or", self.op("shift_left", word, left), self.op("shift_right", word, right))

    def _shift_left(self, equation: Any, value: Any, by: Any) -> Any:
        return self._shifted("shift_left", equation, value, by)

    def _shift_right_logical(self, equation: Any, value: Any, by: Any) -> Any:
        return self._shifted("shift_right", equation, value, by)

    def _shifted(self, operation: str, equation: Any, value: Any, by: Any) -> Any:
        """Shifts by known numbers of bits; by 32 or more nothing is left, whatever a processor does."""
        aval = equation.outvars[0].aval
        if aval.dtype.itemsize != 4:
            raise NotImplementedError(f"shifts of {aval.dtype}")
        made = np.empty(aval.shape, object)
        words, shifts = (np.broadcast_to(self.nodes(part), aval.shape) for part in (value, by))
        for place in np.ndindex(*aval.shape):
            bits: Any = shifts[place]
            if not bits.constant:
                raise NotImplementedError("a shift by a number that is not known")
            zero = self.program.constant(np.int32(0))
            made[place] = self.op(operation, words[place], bits) if 0 <= int(bits.about) < 32 else zero
        return made

    def _bitcast_convert_type(self, equation: Any, value: Any) -> Any:
        new = np.dtype(equation.params["new_dtype"])
        old = np.dtype(equation.invars[0].aval.dtype)
        if (old.itemsize, new.itemsize) != (4, 4):
            raise NotImplementedError(f"the bits of {old} as {new}")
        words, kind = self.nodes(value), "f" if new.kind == "f" else "i"
        made = np.empty(words.shape, object)
        for place in np.ndindex(*words.shape):
            word = words[place]
            made[place] = word if word.kind == kind else self.program.make("bits", word, kind=kind)
        return made

    def _split(self, equation: Any, value: Any) -> list[Any]:
        ends = np.cumsum([int(size) for size in equation.params["sizes"]])[:-1]
        return list(np.split(self.nodes(value), ends, int(equation.params["axis"])))
