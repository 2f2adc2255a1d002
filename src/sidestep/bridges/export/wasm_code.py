"""Programs as WebAssembly, for browsers: one module with one memory, written without a compiler.

The instructions do what JAX's operations do: a NaN stays one in `f32.min` and `f32.max`, whole numbers wrap,
and conversions to them saturate. Sines, logarithms and the like are imported: JavaScript's `Math` has them in
double precision, and the host rounds them.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, final, no_type_check

import numpy as np

from sidestep.bridges.export.c_code import Body
from sidestep.bridges.export.program import (
    KINDS,
    Block,
    Loop,
    Node,
    NotTranslatable,
    Program,
    Stored,
    Tables,
)
from sidestep.bridges.export.translate import translate
from sidestep.bridges.export.wasm_module import Module, constant, ins

IMPORTED = dict.fromkeys(
    ("cos", "sin", "tan", "acos", "asin", "atan", "exp", "log", "log1p", "expm1", "asinh", "tanh"), 1
) | dict.fromkeys(("atan2", "pow", "rem"), 2)
"""Functions of single precision that a module may import from `math`, and how many numbers each takes; `rem`
is the remainder with the sign of the first."""
_PLAIN = {
    "f": ("add", "sub", "mul", "div", "min", "max", "abs", "neg", "ceil", "floor", "sqrt"),
    "i": ("add", "sub", "mul", "and", "or", "xor"),
}
_INSTRUCTIONS = {
    "f": {name: f"f32.{name}" for name in _PLAIN["f"]}
    | {"bits": "f32.reinterpret_i32", "round": "f32.nearest"},
    "i": {name: f"i32.{name}" for name in _PLAIN["i"]}
    | {"shift_left": "i32.shl", "shift_right": "i32.shr_u", "bits": "i32.reinterpret_f32"},
    "b": {"and": "i32.and", "or": "i32.or", "xor": "i32.xor", "not": "i32.eqz"},
}
_COMPARISONS = ("eq", "ne", "lt", "gt", "le", "ge")
_LOADS = {
    "<f4": "f32.load", "<i4": "i32.load", "<u4": "i32.load", "<i2": "i32.load16_s", "<u2": "i32.load16_u",
    "|i1": "i32.load8_s", "|u1": "i32.load8_u", "|b1": "i32.load8_u",
}  # fmt: skip
_A, _B, _NIL, _ONE, _LESS = ins("local.get", 0), ins("local.get", 1), *(constant("i", k) for k in (0, 1, -1))
_NEGATED = _NIL + _A + ins("i32.sub")
_BY_NIL, _BY_LESS = _B + ins("i32.eqz"), _B + _LESS + ins("i32.eq")
_SELECT = ins("select")
HELPERS = {
    ("min", "i"): ("ii", _A + _B + _A + _B + ins("i32.lt") + _SELECT),
    ("max", "i"): ("ii", _A + _B + _A + _B + ins("i32.gt") + _SELECT),
    ("neg", "i"): ("i", _NEGATED),
    ("not", "i"): ("i", _A + _LESS + ins("i32.xor")),
    ("abs", "i"): ("i", _NEGATED + _A + _A + _NIL + ins("i32.lt") + _SELECT),
    ("sign", "i"): ("i", _A + _NIL + ins("i32.gt") + _A + _NIL + ins("i32.lt") + ins("i32.sub")),
    ("rem", "i"): ("ii", _A + _A + _ONE + _B + _BY_NIL + _SELECT + ins("i32.rem") + _BY_NIL + _SELECT),
    ("div", "i"): (
        "ii",
        (_LESS + _NEGATED)
        + (_A + _ONE + _B + _BY_NIL + _BY_LESS + ins("i32.or") + _SELECT + ins("i32.div"))
        + (_BY_LESS + _SELECT + _BY_NIL + _SELECT),
    ),
    ("sign", "f"): (
        "f",
        constant("f", 1.0)
        + (constant("f", -1.0) + _A + _A + constant("f", 0.0) + ins("f32.lt") + _SELECT)
        + (_A + constant("f", 0.0) + ins("f32.gt") + _SELECT),
    ),
}
"""Operations that need more than an instruction, as functions: parameters, code. A division by zero is -1 and
its remainder the number itself, as in JAX, and nothing traps."""
_FIRST = {
    ("min", "f"): np.inf, ("max", "f"): -np.inf, ("add", "f"): 0.0, ("min", "i"): 2**31 - 1,
    ("max", "i"): -(2**31), ("add", "i"): 0, ("and", "b"): True, ("or", "b"): False,
}  # fmt: skip
_DEEPEST = 40
"""Nesting up to which what is used once is computed where it is used."""
_COUNTER, _INNER = 0, 1
"""Local variables of the counters of loops, and of products inside of them."""


@dataclass(frozen=True)
@no_type_check  # called millions of times
class Area:
    """Numbers in the memory of a module: their address (bytes), kind, and shape. Each takes four bytes."""

    address: int
    kind: str
    shape: tuple[int, ...]

    @property
    def size(self) -> int:
        """How many numbers there are."""
        return int(np.prod(self.shape))

    @property
    def addresses(self) -> list[int]:
        """The address of each number."""
        return [self.address + 4 * k for k in range(self.size)]


@final
class WasmLibrary:
    """Functions translated from JAX over one memory, whose areas the host fills and reads.

    ```python
    library = WasmLibrary()
    x, y = library.area("f", (2,)), library.area("f", ())
    library.add("length", jnp.linalg.norm, [x], [y])
    Path("library.wasm").write_bytes(library.binary())
    ```

    A function of the module takes and returns nothing: it reads its areas and writes its areas, which may be
    the same ones.
    """

    def __init__(self) -> None:
        self.tables = Tables()
        self._top = 16
        self._functions: list[tuple[str, Program, list[tuple[str, Node]]]] = []

    def area(self, kind: str, shape: tuple[int, ...]) -> Area:
        """A new area for numbers of this kind ("f", "i" or "b")."""
        made = Area(self._top, kind, shape)
        self._top += 4 * made.size
        return made

    def add(
        self, name: str, function: Callable[..., Any], inputs: Sequence[Area], outputs: Sequence[Area]
    ) -> None:
        """Translate a function of arrays that returns a tuple of arrays.

        **Raises** `NotTranslatable`, and `ValueError` where it returns another number of values.
        """
        program = Program(self.tables)
        given = []
        for area in inputs:
            made = np.empty(area.size, object)
            made[:] = [program.given(str(address), area.kind) for address in area.addresses]
            given.append(made.reshape(area.shape))
        results = translate(program, function, given)
        written = []
        for area, result in zip(outputs, results, strict=True):
            kinds = {node.kind for node in result.reshape(-1)}
            if result.shape != area.shape or kinds - {area.kind}:
                raise ValueError(f"{name}: {result.shape} of {kinds}, not {area.shape} of {area.kind}")
            written += zip(map(str, area.addresses), result.reshape(-1), strict=True)
        self._functions.append((name, program, written))

    def binary(self) -> bytes:
        """The module."""
        bodies = [(name, _WasmBody(program, outputs)) for name, program, outputs in self._functions]
        needed = {operation for _, body in bodies for operation in body.operations}
        module, calls = Module(), {}
        for name, count in IMPORTED.items():
            if (name, "f") in needed:
                calls[name, "f"] = module.imported(name, "f" * count, "f")
        for operation, (parameters, code) in HELPERS.items():
            if operation in needed:
                calls[operation] = module.function(parameters, operation[1], (), code)
        top, places = self._top, {}
        for number in sorted({one for _, body in bodies for one in body.tables}):
            values = _plain(self.tables.arrays[number])
            places[number] = (top, values.dtype)
            module.data(top, values.tobytes())
            top += -(-values.nbytes // 4) * 4
        most = top
        for name, body in bodies:
            code = body.code(calls, places, top)
            module.function("", "", body.local, code, name)
            most = max(most, body.top)
        return module.binary(most)


def _plain(values: np.ndarray) -> np.ndarray:
    """A table as the memory has it, little-endian; whole numbers keep their width up to 32 bits."""
    if values.dtype.kind == "f":
        return values.astype("<f4")
    return values.astype(values.dtype.newbyteorder("<") if values.dtype.itemsize <= 4 else "<i4")


@no_type_check  # called millions of times
class _WasmBody(Body):
    """The instructions of a function that leaves the `outputs`, (address, node), of a program."""

    @property
    def operations(self) -> set[tuple[str, str]]:
        """Operations that it uses, and the kind of number of each."""
        found = {(one.operation, one.kind) for one in self.live if isinstance(one, Node)}
        return found | {(node.about, node.kind) for node in self._live_nodes("reduce")}

    def code(
        self, calls: dict[tuple[str, str], int], tables: dict[int, tuple[int, np.dtype]], top: int
    ) -> bytes:
        """Its instructions. `calls`: numbers of functions by operation; `tables`: address and dtype of each;
        its arrays lie from `top` on."""
        self.calls, self.places, self.top = calls, tables, top
        self.local = ["i", "i"]
        self.variables: dict[Any, int] = {}
        self.depths: dict[Node, int] = {}
        self.arrays_at: dict[Stored, int] = {}
        code = self._block(self.program.root)
        # All is read before anything is written: an area may be input and output.
        stores = []
        for address, node in self.outputs:
            value = self._push(node)
            if not node.constant and node not in self.variables:
                result = object()
                code += value + self._set(result, node.kind)
                value = self._get(result)
            stores.append(_NIL + value + _store(node.kind, int(address)))
        return code + b"".join(stores)

    def _variable(self, one: Any, kind: str) -> int:
        """The local variable of a node, or of anything else."""
        if one not in self.variables:
            self.variables[one] = len(self.local)
            self.local.append(kind)
        return self.variables[one]

    def _get(self, one: Any) -> bytes:
        return ins("local.get", self.variables[one])

    def _set(self, one: Any, kind: str) -> bytes:
        return ins("local.set", self._variable(one, kind))

    def _block(self, block: Block) -> bytes:
        for array in sorted(self.arrays[block], key=lambda array: (array.stage, array.size)):
            self.arrays_at[array] = self.top
            self.top += 4 * array.size
        reductions = self._reductions(block)
        code = bytearray()
        for one in self._in_order(block):
            code += self._loop(one, reductions[one]) if isinstance(one, Loop) else self._statement(one)
        return bytes(code)

    def _loop(self, loop: Loop, reductions: list[Node]) -> bytes:
        inside, before = bytearray(), bytearray()
        for node in loop.nodes:
            if node in self.live:
                inside += self._statement(node)
        for node in reductions:
            value, kind = self._push(node.inputs[0]), node.inputs[0].kind
            if node.about.startswith("arg"):
                begun, each = self._argument(node, value, kind)
            else:
                begun = constant(kind, _FIRST[node.about, kind]) + self._set(node, kind)
                operation = self._operation(node.about, kind)
                each = self._get(node) + value + operation + self._set(node, kind)
            before += begun
            inside += each
        for array, offset, node in self.parts[loop]:
            inside += _times_four(ins("local.get", _COUNTER)) + self._push(node)
            inside += _store(node.kind, self.arrays_at[array] + 4 * offset)
        return bytes(before) + _counted(_COUNTER, loop.size, bytes(inside)) if inside else b""

    def _argument(self, node: Node, value: bytes, kind: str) -> tuple[bytes, bytes]:
        """`argmin` or `argmax`: what comes before the loop, and in it. The first NaN wins."""
        low, best, new = node.about == "argmin", (node, "best"), (node, "new")
        begun = _NIL + self._set(node, "i") + constant("f", np.inf if low else -np.inf) + self._set(best, "f")
        each = value + (b"" if kind == "f" else ins("f32.convert_i32")) + self._set(new, "f")
        better = self._get(new) + self._get(best) + ins("f32.lt" if low else "f32.gt")
        unknown = self._get(new) + self._get(new) + ins("f32.ne") + ins("i32.or")
        known = self._get(best) + self._get(best) + ins("f32.eq") + ins("i32.and")
        each += better + unknown + known + ins("if") + ins("local.get", _COUNTER) + self._set(node, "i")
        return begun, each + self._get(new) + self._set(best, "f") + ins("end")

    def _statement(self, node: Node) -> bytes:
        """What leaves a node in its variable; nothing where it is computed where it is used."""
        if node.operation in ("reduce", "result"):
            return b""
        if node.operation == "store":
            array = node.about
            parts = [(4 * offset, part) for offset, part in array.parts if part.loop is None]
            at = self.arrays_at[array]
            return b"".join(_NIL + self._push(part) + _store(part.kind, at + by) for by, part in parts)
        if node.operation == "condition":
            return self._condition(node)
        if node.operation == "dot":
            return self._dot(node)
        if self._inlined(node):
            return b""
        return self._expression(node) + self._set(node, node.kind)

    def _dot(self, node: Node) -> bytes:
        where, numbered = node.inputs
        weights, _ = self.places[int(numbered.about)]
        row, four = (node, "row"), _times_four(ins("local.get", _INNER))
        begun = self._push(where) + constant("i", 4 * node.about.size) + ins("i32.mul") + self._set(row, "i")
        begun += constant("f", 0.0) + self._set(node, "f")
        weight = four + self._get(row) + ins("i32.add") + _load("f", weights)
        value = four + _load("f", self.arrays_at[node.about])
        each = self._get(node) + weight + value + ins("f32.mul") + ins("f32.add") + self._set(node, "f")
        return begun + _counted(_INNER, node.about.size, each)

    def _condition(self, node: Node) -> bytes:
        blocks, results = node.about
        wanted = sorted({one.about for one in self._live_nodes("result") if one.inputs[0] is node})
        index, code = self._push(node.inputs[0]), bytearray()
        last = len(blocks) - 1
        for number, (block, found) in enumerate(zip(blocks, results, strict=True)):
            if number < last:
                code += index + constant("i", number) + ins("i32.eq" if number else "i32.le") + ins("if")
            code += self._block(block)
            for k in wanted:
                code += self._push(found[k]) + self._set((node, k), found[k].kind)
            if number < last:
                code += ins("else")
        return bytes(code) + ins("end") * last

    def _inlined(self, node: Node) -> bool:
        if node.operation in ("constant", "given", "counter"):
            return True
        return self._has_one_user(node) and self._depth(node) < _DEEPEST

    def _depth(self, node: Node) -> int:
        """How deep its expression is nested."""
        if node not in self.depths:
            inner = [self._depth(one) for one in node.inputs if one not in self.variables]
            self.depths[node] = 1 + max(inner, default=0)
        return self.depths[node]

    def _push(self, node: Node) -> bytes:
        """What leaves the number of a node on the stack."""
        if node.operation == "constant":
            return constant(node.kind, node.about)
        if node.operation == "counter":
            return ins("local.get", _COUNTER)
        if node.operation == "given":
            return _NIL + _load(node.kind, int(node.about))
        if node.operation == "result":
            return self._get((node.inputs[0], node.about))
        return self._get(node) if node in self.variables else self._expression(node)

    def _expression(self, node: Node) -> bytes:
        operation, kind = node.operation, node.kind
        if operation == "same":
            return self._push(node.inputs[0])
        if operation == "select":
            flag, yes, no = node.inputs
            return self._push(yes) + self._push(no) + self._push(flag) + _SELECT
        if operation == "entry":
            address, dtype = self.places[node.about]
            at = self._push(node.inputs[0]) + constant("i", dtype.itemsize) + ins("i32.mul")
            return at + ins(_LOADS[dtype.str], dtype.itemsize.bit_length() - 1, address)
        if operation == "element":
            at, (index,) = self.arrays_at[node.about], node.inputs
            if index.constant:
                return _NIL + _load(kind, at + 4 * int(index.about))
            return _times_four(self._push(index)) + _load(kind, at)
        pushed = b"".join(map(self._push, node.inputs))
        if operation.startswith("to_"):
            return pushed + _converted(node.inputs[0].kind, kind)
        if operation == "is_finite":
            return pushed + ins("f32.abs") + constant("f", np.inf) + ins("f32.lt")
        if operation in _COMPARISONS:
            return pushed + ins(f"{'f' if node.inputs[0].kind == 'f' else 'i'}32.{operation}")
        return pushed + self._operation(operation, kind)

    def _operation(self, operation: str, kind: str) -> bytes:
        """What takes the numbers from the stack and leaves the result."""
        if operation in _INSTRUCTIONS[kind]:
            return ins(_INSTRUCTIONS[kind][operation])
        if (operation, kind) not in self.calls:
            raise NotTranslatable(f"there is no {operation!r} of {KINDS[kind].__name__} in WebAssembly yet")
        return ins("call", self.calls[operation, kind])


def _load(kind: str, address: int) -> bytes:
    """The number at an address on the stack, and so many bytes on."""
    return ins("f32.load" if kind == "f" else "i32.load", 2, address)


def _store(kind: str, address: int) -> bytes:
    return ins("f32.store" if kind == "f" else "i32.store", 2, address)


def _times_four(index: bytes) -> bytes:
    return index + constant("i", 2) + ins("i32.shl")


def _converted(old: str, new: str) -> bytes:
    if new == "b":
        return constant(old, 0) + ins("f32.ne" if old == "f" else "i32.ne")
    if new == "f":
        return ins("f32.convert_i32")
    return ins("i32.trunc_sat_f32") if old == "f" else b""


def _counted(variable: int, size: int, inside: bytes) -> bytes:
    """A loop over 0 ... size - 1."""
    step = ins("local.get", variable) + _ONE + ins("i32.add") + ins("local.tee", variable)
    again = step + constant("i", size) + ins("i32.lt") + ins("br_if", 0)
    return _NIL + ins("local.set", variable) + ins("loop") + inside + again + ins("end")
