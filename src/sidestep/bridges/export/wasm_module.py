"""The binary format of WebAssembly: as much of it as translated functions need.

See chapter 5 of the core specification, 2.0, <https://www.w3.org/TR/wasm-core-2/>.
"""

from __future__ import annotations

import functools
import struct
from collections.abc import Iterable, Sequence
from typing import Any, no_type_check

TYPES = {"f": 0x7D, "i": 0x7F, "b": 0x7F}
"""The types f32 and i32 of each kind of number."""
_PAGE = 65536


def unsigned(value: int) -> bytes:
    """LEB128 of a whole number >= 0."""
    made = bytearray()
    while True:
        value, low = value >> 7, value & 0x7F
        made.append(low | (0x80 if value else 0))
        if not value:
            return bytes(made)


def signed(value: int) -> bytes:
    """LEB128 of a whole number."""
    made = bytearray()
    while True:
        value, low = value >> 7, value & 0x7F
        done = value == (-1 if low & 0x40 else 0)
        made.append(low | (0 if done else 0x80))
        if done:
            return bytes(made)


_OPCODES = {
    "if": 0x04, "else": 0x05, "loop": 0x03, "end": 0x0B, "br_if": 0x0D, "call": 0x10, "select": 0x1B,
    "local.get": 0x20, "local.set": 0x21, "local.tee": 0x22,
    "i32.load": 0x28, "f32.load": 0x2A, "i32.load8_s": 0x2C, "i32.load8_u": 0x2D, "i32.load16_s": 0x2E,
    "i32.load16_u": 0x2F, "i32.store": 0x36, "f32.store": 0x38, "i32.const": 0x41, "f32.const": 0x43,
    "i32.eqz": 0x45, "i32.eq": 0x46, "i32.ne": 0x47, "i32.lt": 0x48, "i32.gt": 0x4A, "i32.le": 0x4C,
    "i32.ge": 0x4E, "f32.eq": 0x5B, "f32.ne": 0x5C, "f32.lt": 0x5D, "f32.gt": 0x5E, "f32.le": 0x5F,
    "f32.ge": 0x60, "i32.add": 0x6A, "i32.sub": 0x6B, "i32.mul": 0x6C, "i32.div": 0x6D, "i32.rem": 0x6F,
    "i32.and": 0x71, "i32.or": 0x72, "i32.xor": 0x73, "i32.shl": 0x74, "i32.shr_u": 0x76, "f32.abs": 0x8B,
    "f32.neg": 0x8C, "f32.ceil": 0x8D, "f32.floor": 0x8E, "f32.nearest": 0x90, "f32.sqrt": 0x91,
    "f32.add": 0x92, "f32.sub": 0x93, "f32.mul": 0x94, "f32.div": 0x95, "f32.min": 0x96, "f32.max": 0x97,
    "f32.convert_i32": 0xB2, "i32.reinterpret_f32": 0xBC, "f32.reinterpret_i32": 0xBE,
}  # fmt: skip
"""Codes of instructions; comparisons, divisions and conversions of whole numbers are the signed ones."""


@functools.cache
def ins(name: str, *immediates: int) -> bytes:
    """An instruction and what belongs to it. Blocks (`if`, `loop`) take and leave nothing."""
    if name == "i32.trunc_sat_f32":
        return b"\xfc\x00"
    code = bytes([_OPCODES[name]])
    if name in ("if", "loop"):
        return code + b"\x40"
    return code + b"".join(map(signed if name == "i32.const" else unsigned, immediates))


def constant(kind: str, value: Any) -> bytes:
    """The instruction that leaves a number of a kind of `TYPES`."""
    if kind == "f":
        return ins("f32.const") + struct.pack("<f", value)
    return ins("i32.const", int(value))


def _vector(parts: Sequence[bytes]) -> bytes:
    return unsigned(len(parts)) + b"".join(parts)


def _named(text: str) -> bytes:
    return _vector([bytes([byte]) for byte in text.encode()])


def _section(number: int, parts: Sequence[bytes]) -> bytes:
    content = _vector(parts)
    return bytes([number]) + unsigned(len(content)) + content


@no_type_check  # called millions of times
class Module:
    """Functions, one memory, and what it holds at first.

    The memory is exported as `memory`. Imported functions come from the module `math`. They must all be named
    before the first function is added, because functions are numbered through.
    """

    def __init__(self) -> None:
        self._types: list[bytes] = []
        self._imports: list[bytes] = []
        self._functions: list[tuple[int, bytes]] = []
        self._exports: list[bytes] = []
        self._data: list[bytes] = []

    def imported(self, name: str, parameters: str, result: str) -> int:
        """The number of an imported function; `parameters` and `result` as letters of `TYPES`."""
        assert not self._functions
        kind = self._type(parameters, result)
        self._imports.append(_named("math") + _named(name) + b"\x00" + unsigned(kind))
        return len(self._imports) - 1

    def function(
        self, parameters: str, result: str, local: Iterable[str], code: bytes, name: str | None = None
    ) -> int:
        """Add a function, exported under its name if it has one, and return its number. `local`: the kinds of
        its local variables, which count from the last parameter on."""
        runs: list[tuple[str, int]] = []
        for kind in local:
            if runs and TYPES[runs[-1][0]] == TYPES[kind]:
                runs[-1] = (kind, runs[-1][1] + 1)
            else:
                runs.append((kind, 1))
        body = _vector([unsigned(count) + bytes([TYPES[kind]]) for kind, count in runs]) + code + ins("end")
        number = len(self._imports) + len(self._functions)
        self._functions.append((self._type(parameters, result), unsigned(len(body)) + body))
        if name is not None:
            self._exports.append(_named(name) + b"\x00" + unsigned(number))
        return number

    def data(self, address: int, content: bytes) -> None:
        """What the memory holds at an address (bytes) at first."""
        self._data.append(b"\x00" + ins("i32.const", address) + ins("end") + unsigned(len(content)) + content)

    def binary(self, size: int) -> bytes:
        """The file, with a memory of at least `size` bytes."""
        types = [unsigned(kind) for kind, _ in self._functions]
        exports = [_named("memory") + b"\x02\x00", *self._exports]
        sections = [
            _section(1, self._types),
            _section(2, self._imports),
            _section(3, types),
            _section(5, [b"\x00" + unsigned(-(-size // _PAGE))]),
            _section(7, exports),
            _section(10, [body for _, body in self._functions]),
            _section(11, self._data),
        ]
        return b"\x00asm\x01\x00\x00\x00" + b"".join(sections)

    def _type(self, parameters: str, result: str) -> int:
        ends = [_vector([bytes([TYPES[kind]]) for kind in part]) for part in (parameters, result)]
        made = b"\x60" + b"".join(ends)
        if made not in self._types:
            self._types.append(made)
        return self._types.index(made)
