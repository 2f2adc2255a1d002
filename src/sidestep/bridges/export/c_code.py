"""A `Program` as C99: no allocation, no recursion, bounded loops, single precision, nothing but math.h."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterator
from typing import Any, no_type_check

import numpy as np

from sidestep.bridges.export.program import (
    KINDS,
    Block,
    Loop,
    Node,
    NotTranslatable,
    Program,
    Stored,
    kind_of,
    live,
)

TYPES = {"f": "float", "i": "int32_t", "b": "bool"}
"""What C calls each kind of number."""
_INLINE = 60
"""Characters up to which what is used once is written where it is used."""
_WIDTH = 100

HELPERS = """\
static inline float least(float a, float b) { return a < b || a != a ? a : b; }
static inline float most(float a, float b) { return a > b || a != a ? a : b; }
static inline int32_t least_i(int32_t a, int32_t b) { return a < b ? a : b; }
static inline int32_t most_i(int32_t a, int32_t b) { return a > b ? a : b; }
static inline int32_t plus(int32_t a, int32_t b) { return (int32_t)((uint32_t)a + (uint32_t)b); }
static inline int32_t minus(int32_t a, int32_t b) { return (int32_t)((uint32_t)a - (uint32_t)b); }
static inline int32_t times(int32_t a, int32_t b) { return (int32_t)((uint32_t)a * (uint32_t)b); }
static inline int32_t size(int32_t a) { return a < 0 ? minus(0, a) : a; }
static inline int32_t rest(int32_t a, int32_t b) { return b == 0 ? a : b == -1 ? 0 : a % b; }
static inline int32_t quotient(int32_t a, int32_t b)
{
    return b == 0 ? -1 : b == -1 ? minus(0, a) : a / b;
}
static inline int32_t left(int32_t a, int32_t b) { return (int32_t)((uint32_t)a << b); }
static inline int32_t right(int32_t a, int32_t b) { return (int32_t)((uint32_t)a >> b); }
static inline float real_of(int32_t a)
{
    const union { int32_t whole; float real; } bits = {a};
    return bits.real;
}
static inline int32_t bits_of(float a)
{
    const union { float real; int32_t whole; } bits = {a};
    return bits.whole;
}
static inline int32_t sign_i(int32_t a) { return (a > 0) - (a < 0); }
static inline float sign(float a) { return a > 0.0f ? 1.0f : a < 0.0f ? -1.0f : a; }
static inline int32_t whole(float a)
{
    return a >= 2147483648.0f ? INT32_MAX : a >= -2147483648.0f ? (int32_t)a : a != a ? 0 : INT32_MIN;
}
"""
"""What JAX's operations are in C: a NaN stays one, and whole numbers wrap or saturate."""
_INFIX = {"lt": "<", "le": "<=", "gt": ">", "ge": ">=", "eq": "==", "ne": "!="}
_OPERATIONS = {
    "f": {
        "add": "({} + {})", "sub": "({} - {})", "mul": "({} * {})", "div": "({} / {})", "neg": "(-{})",
        "min": "least({}, {})", "max": "most({}, {})", "abs": "fabsf({})", "sign": "sign({})",
        "rem": "fmodf({}, {})", "pow": "powf({}, {})", "atan2": "atan2f({}, {})",
        "bits": "real_of({})", "round": "rintf({})",
    }
    | {
        name: f"{name}f({{}})"
        for name in (
            "sqrt", "cos", "sin", "tan", "acos", "asin", "atan", "exp", "log", "log1p", "expm1", "asinh",
            "tanh", "floor", "ceil",
        )
    },
    "i": {
        "add": "plus({}, {})", "sub": "minus({}, {})", "mul": "times({}, {})", "min": "least_i({}, {})",
        "max": "most_i({}, {})", "rem": "rest({}, {})", "div": "quotient({}, {})", "abs": "size({})",
        "neg": "minus(0, {})", "sign": "sign_i({})", "not": "(~{})", "and": "({} & {})", "or": "({} | {})",
        "xor": "({} ^ {})", "shift_left": "left({}, {})", "shift_right": "right({}, {})",
        "bits": "bits_of({})",
    },
    "b": {
        "and": "({} && {})", "or": "({} || {})", "xor": "({} != {})", "not": "(!{})",
        "is_finite": "(isfinite({}) != 0)",
    }
    | {name: f"({{}} {sign} {{}})" for name, sign in _INFIX.items()},
}  # fmt: skip
_FIRST = {
    ("min", "f"): "INFINITY", ("max", "f"): "-INFINITY", ("add", "f"): "0.0f", ("min", "i"): "INT32_MAX",
    ("max", "i"): "INT32_MIN", ("add", "i"): "0", ("and", "b"): "true", ("or", "b"): "false",
}  # fmt: skip


def number(value: Any) -> str:
    """A constant."""
    if value.dtype.kind == "b":
        return "true" if value else "false"
    if value.dtype.kind == "i":
        return str(value) if value >= 0 else f"({value})"
    if np.isnan(value):
        return "NAN"
    if np.isinf(value):
        return "INFINITY" if value > 0 else "(-INFINITY)"
    text = str(np.float32(value))
    text += "f" if any(sign in text for sign in ".e") else ".0f"
    return f"({text})" if np.signbit(value) else text


def table(name: str, values: np.ndarray) -> list[str]:
    """A constant array; whole numbers keep their width."""
    kind = kind_of(values.dtype)
    width = f"{values.dtype.name}_t" if kind == "i" else TYPES[kind]
    lines, line = [f"static const {width} {name}[{len(values)}] = {{"], "   "
    for entry in (number(value).strip("()") for value in values.astype(KINDS[kind])):
        if len(line) + len(entry) + 2 > _WIDTH:
            lines.append(line)
            line = "   "
        line += f" {entry},"
    return [*lines, line, "};"]


@no_type_check  # called millions of times: checking types would take the tests a minute
class Body:
    """What the `outputs`, (where, node), of a program need, and who uses it: the same for every back end."""

    def __init__(self, program: Program, outputs: list[tuple[str, Node]]):
        self.program, self.outputs = program, outputs
        self.live = live(program, [node for _, node in outputs])
        self.arrays: dict[Block, list[Stored]] = defaultdict(list)
        self.parts: dict[Loop, list[tuple[Stored, int, Node]]] = defaultdict(list)
        self.users: dict[Node, list[Any]] = defaultdict(list)
        for one in self.live:
            if isinstance(one, Stored):
                self.arrays[one.block].append(one)
                for offset, node in one.parts:
                    self.users[node].append(node.loop or one.block)
                    if node.loop is not None:
                        self.parts[node.loop].append((one, offset, node))
            else:
                for node in one.inputs:
                    self.users[node].append(None if one.operation == "reduce" else one.loop or one.block)
                if one.operation == "result":
                    for block, results in zip(*one.inputs[0].about, strict=True):
                        self.users[results[one.about]].append(block)
        for _, node in outputs:
            self.users[node].append(program.root)

    @property
    def tables(self) -> list[int]:
        """Numbers of the tables that it reads."""
        found = {node.about for node in self._live_nodes("entry")}
        return sorted(found | {int(node.inputs[1].about) for node in self._live_nodes("dot")})

    @property
    def given(self) -> set[str]:
        """Names of the inputs that it reads."""
        return {node.about for node in self._live_nodes("given")}

    def _live_nodes(self, operation: str) -> list[Node]:
        return [one for one in self.live if isinstance(one, Node) and one.operation == operation]

    def _reductions(self, block: Block) -> dict[Loop, list[Node]]:
        """The reductions of a block by the loop that they are over."""
        found: dict[Loop, list[Node]] = defaultdict(list)
        for node in block.nodes:
            if node.operation == "reduce" and node in self.live:
                assert node.inputs[0].loop is not None
                found[node.inputs[0].loop].append(node)
        return found

    def _in_order(self, block: Block) -> Iterator[Loop | Node]:
        """The loops and the numbers of a block that are needed, in the order in which they are computed."""
        for stage in range(block.stages):
            yield from (loop for (at, _), loop in block.loops.items() if at == stage)
            for node in block.nodes:
                wanted = node.about if node.operation == "store" else node
                if node.stage == stage and wanted in self.live:
                    yield node

    def _has_one_user(self, node: Node) -> bool:
        """Whether it may be computed where it is used: once, and as often as it would be by itself."""
        users = self.users[node]
        return len(users) == 1 and users[0] is (node.loop or node.block)


@no_type_check  # as above
class CBody(Body):
    """The statements of a function that leaves the `outputs`, (where, node), of a program."""

    def __init__(self, program: Program, outputs: list[tuple[str, Node]]):
        super().__init__(program, outputs)
        self.names: dict[Any, str] = {}
        self.short: dict[Node, bool] = {}

    def lines(self) -> list[str]:
        """The body of the function."""
        lines = self._block(self.program.root)
        lines += [f"{where} = {self._text(node)};" for where, node in self.outputs]
        return ["    " + line for line in lines]

    def _name(self, one: Any, letter: str) -> str:
        if one not in self.names:
            self.names[one] = f"{letter}{len(self.names)}"
        return self.names[one]

    def _block(self, block: Block) -> list[str]:
        lines = []
        for array in sorted(self.arrays[block], key=lambda array: (array.stage, array.size)):
            lines.append(f"{TYPES[array.kind]} {self._name(array, 'a')}[{array.size}];")
        reductions = self._reductions(block)
        for one in self._in_order(block):
            lines += self._loop(one, reductions[one]) if isinstance(one, Loop) else self._statement(one)
        return lines

    def _loop(self, loop: Loop, reductions: list[Node]) -> list[str]:
        inside: list[str] = []
        for node in loop.nodes:
            if node in self.live and not self._inlined(node):
                inside += self._statement(node)
        before = []
        for node in reductions:
            value, name = self._text(node.inputs[0]), self._name(node, "t")
            kind = node.inputs[0].kind
            if node.about.startswith("arg"):
                low = node.about == "argmin"
                before += [f"int32_t {name} = 0;", f"float {name}b = {'INFINITY' if low else '-INFINITY'};"]
                sign = "<" if low else ">"
                inside += [
                    f"if (({value} {sign} {name}b || {value} != {value}) && {name}b == {name}b) {{",
                    f"    {name} = i;",
                    f"    {name}b = {value};",
                    "}",
                ]
                continue
            before.append(f"{TYPES[kind]} {name} = {_FIRST[node.about, kind]};")
            inside.append(f"{name} = {_OPERATIONS[kind][node.about].format(name, value)};")
        for array, offset, node in self.parts[loop]:
            where = f"i + {offset}" if offset else "i"
            inside.append(f"{self._name(array, 'a')}[{where}] = {self._text(node)};")
        if not inside:
            return []
        head = f"for (int32_t i = 0; i < {loop.size}; i++) {{"
        return [*before, head, *("    " + line for line in inside), "}"]

    def _statement(self, node: Node) -> list[str]:
        if node.operation in ("reduce", "result") or self._inlined(node):
            return []
        if node.operation == "store":
            array = node.about
            return [
                f"{self._name(array, 'a')}[{offset}] = {self._text(part)};"
                for offset, part in array.parts
                if part.loop is None
            ]
        if node.operation == "condition":
            return self._condition(node)
        name = self._name(node, "t")
        if node.operation == "dot":
            where, numbered = node.inputs
            values = self._name(node.about, "a")
            row = f"{self._text(where)} * {node.about.size} + k"
            return [
                f"float {name} = 0.0f;",
                f"for (int32_t k = 0; k < {node.about.size}; k++) {{",
                f"    {name} += table{int(numbered.about)}[{row}] * {values}[k];",
                "}",
            ]
        return [f"const {TYPES[node.kind]} {name} = {_bare(self._expression(node))};"]

    def _condition(self, node: Node) -> list[str]:
        blocks, results = node.about
        wanted = sorted({one.about for one in self._live_nodes("result") if one.inputs[0] is node})
        index, name = self._text(node.inputs[0]), self._name(node, "r")
        lines = [f"{TYPES[results[0][k].kind]} {name}_{k};" for k in wanted]
        for number_, (block, found) in enumerate(zip(blocks, results, strict=True)):
            last = number_ == len(blocks) - 1
            test = "" if last else f"if ({index} {'<=' if number_ == 0 else '=='} {number_}) "
            lines.append(("} else " if number_ else "") + test + "{")
            body = self._block(block) + [f"{name}_{k} = {self._text(found[k])};" for k in wanted]
            lines += ["    " + line for line in body]
        return [*lines, "}"]

    def _inlined(self, node: Node) -> bool:
        if node.operation in ("reduce", "condition", "result", "dot", "store"):
            return False
        if node.operation in ("constant", "given", "counter"):
            return True
        if not self._has_one_user(node):
            return False
        if node not in self.short:
            self.short[node] = len(self._expression(node)) <= _INLINE
        return self.short[node]

    def _text(self, node: Node) -> str:
        """Its name, or where it is used once the expression itself."""
        if node.operation == "constant":
            return number(node.about)
        if node.operation == "given":
            return node.about
        if node.operation == "counter":
            return "i"
        if node.operation == "result":
            return f"{self._name(node.inputs[0], 'r')}_{node.about}"
        if node.operation == "reduce" or not self._inlined(node):
            return self._name(node, "t")
        return self._expression(node)

    def _expression(self, node: Node) -> str:
        operation, inputs = node.operation, [self._text(one) for one in node.inputs]
        if operation == "same":
            return inputs[0]
        if operation == "select":
            return f"({inputs[0]} ? {inputs[1]} : {inputs[2]})"
        if operation == "entry":
            cast = "(int32_t)" if node.kind == "i" else ""
            return f"{cast}table{node.about}[{_bare(inputs[0])}]"
        if operation == "element":
            return f"{self._name(node.about, 'a')}[{_bare(inputs[0])}]"
        if operation.startswith("to_"):
            return _converted(inputs[0], node.inputs[0].kind, node.kind)
        if operation not in _OPERATIONS[node.kind]:
            raise NotTranslatable(f"there is no {operation!r} of {TYPES[node.kind]} in C yet")
        return _OPERATIONS[node.kind][operation].format(*inputs)


def _converted(text: str, old: str, new: str) -> str:
    if new == "b":
        return f"({text} != 0)"
    if old == "b":
        return f"({text} ? 1.0f : 0.0f)" if new == "f" else f"({text} ? 1 : 0)"
    return f"(float){text}" if new == "f" else f"whole({_bare(text)})"


def _bare(text: str) -> str:
    """Without the parentheses around all of it."""
    if not (text.startswith("(") and text.endswith(")")):
        return text
    depth = 0
    for k, letter in enumerate(text):
        depth += (letter == "(") - (letter == ")")
        if depth == 0 and k < len(text) - 1:
            return text
    return text[1:-1]
