"""A `Program` as an ONNX graph.

A number is a column of a tensor `(batch, width)`, one of a loop of size n a tensor `(batch, n)`; what is the
same for all has no batch. onnxruntime takes about 0.3 us per node, however small its tensors are, so numbers
that are computed alike share a node where that saves some: see `packing`.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Sequence
from graphlib import CycleError, TopologicalSorter
from typing import Any, no_type_check

import numpy as np

from sidestep.bridges.export.exported import Field
from sidestep.bridges.export.graph import ELEMENTS, OPSET, Graph
from sidestep.bridges.export.numbers import CHAINS, Numbers
from sidestep.bridges.export.packing import Pack, find_packs
from sidestep.bridges.export.program import Node, NotTranslatable, Program, Stored

_OPERATORS = {
    "add": "Add", "sub": "Sub", "mul": "Mul", "div": "Div", "neg": "Neg", "min": "Min", "max": "Max",
    "abs": "Abs", "sign": "Sign", "pow": "Pow", "sqrt": "Sqrt", "cos": "Cos", "sin": "Sin", "tan": "Tan",
    "acos": "Acos", "asin": "Asin", "atan": "Atan", "exp": "Exp", "log": "Log", "asinh": "Asinh",
    "tanh": "Tanh", "floor": "Floor", "ceil": "Ceil", "lt": "Less", "le": "LessOrEqual", "gt": "Greater",
    "ge": "GreaterOrEqual", "eq": "Equal", "round": "Round", "and": "And", "or": "Or", "xor": "Xor",
    "not": "Not",
}  # fmt: skip
_SEVERAL = {"add": "Sum", "min": "Min", "max": "Max"}
_REDUCED = {"add": "ReduceSum", "min": "ReduceMin", "max": "ReduceMax", "and": "ReduceMin", "or": "ReduceMax"}
_SPLIT = 32
"""Columns up to which a tensor is split as a whole."""
_COSTS = {"Where": 2.5, "Split": 2.0}
"""Of nodes that take longer than others, in units of those."""


def write_numbers(
    graph: Graph, program: Program, fields: Sequence[Field], outputs: Sequence[tuple[Field, np.ndarray]]
) -> None:
    """Write into an empty graph what the `outputs`, fields and their nodes, need; of the `fields` those that
    they depend on become inputs.

    **Raises** `NotTranslatable` for an operation that ONNX does not have.
    """
    numbers = Numbers(program, [node for _, nodes in outputs for node in nodes.reshape(-1)])
    read = {node.about for node in numbers.order if node.operation == "given"}
    used = [field for field in fields if read & set(field.entries())]

    def cost(packs: Sequence[Pack]) -> float:
        trial = Graph()
        try:
            _Writer(trial, numbers, packs, used).write(outputs)
        except CycleError:
            return np.inf
        return sum(_COSTS.get(operator, 1.0) for operator in trial.operators)

    _Writer(graph, numbers, find_packs(numbers, cost), used).write(outputs)


@no_type_check  # called millions of times: checking types would take the tests a minute
class _Writer:
    """Writes numbers into a graph; those of a pack share a node."""

    def __init__(self, graph: Graph, numbers: Numbers, packs: Sequence[Pack], fields: Sequence[Field]):
        self.graph, self.numbers = graph, numbers
        self.packs = {node: pack for pack in packs for node in pack}
        self.places: dict[Node, tuple[str, int]] = {}
        """Tensor and column of a number; of a loop's number the column is 0."""
        self.widths: dict[str, int] = {}
        self.arrays: dict[Stored, str] = {}
        self.batched: set[Node] = set()
        """What is not the same for all."""
        self.given: dict[str, tuple[str, int]] = {}
        for field in fields:
            tensor = graph.input(field.name, field.kind, "batch", *field.shape)
            if len(field.shape) != 1:
                tensor = graph.op("Reshape", tensor, self._indices([-1, field.size]))
            self.widths[tensor] = field.size
            self.given |= {name: (tensor, k) for k, name in enumerate(field.entries())}
        self.rows: dict[Any, set[int]] = defaultdict(set)
        for node in numbers.order:
            if node.operation == "dot" and node.inputs[0].constant:
                self.rows[node.about, node.inputs[1]].add(int(node.inputs[0].about))

    def write(self, outputs: Sequence[tuple[Field, np.ndarray]]) -> None:
        """Write all numbers and the outputs.

        **Raises** `graphlib.CycleError` for packs that need each other.
        """
        sorter: TopologicalSorter[Pack] = TopologicalSorter()
        for node in self.numbers.order:
            pack = self.packs.get(node, (node,))
            if pack[0] is node:
                needed = {
                    self.packs.get(one, (one,)) for member in pack for one in self.numbers.needs(member)
                }
                sorter.add(pack, *needed)
        for pack in sorter.static_order():
            self._write(pack)
        for field, nodes in outputs:
            tensor = self._together(tuple(nodes.reshape(-1)))
            if len(field.shape) != 1:
                tensor = self.graph.op("Reshape", tensor, self._indices([-1, *field.shape]))
            self.graph.output(field.name, tensor, field.kind, "batch", *field.shape)

    # Where numbers are

    def _put(self, pack: Pack, tensor: str) -> None:
        self.widths[tensor] = len(pack) if pack[0].size is None else pack[0].size
        for k, node in enumerate(pack):
            self.places[node] = (tensor, k)

    def _indices(self, values: Sequence[int]) -> str:
        return self.graph.constant(np.asarray(values, np.int64))

    def _column(self, node: Node) -> str:
        """The tensor of one number, `(batch, 1)`, or `(batch, n)` in a loop."""
        if node.constant:
            return self.graph.constant(np.asarray(node.about))
        if node.operation == "counter":
            return self.graph.constant(np.arange(node.about, dtype=np.int32))
        tensor, k = self.places[node]
        width = self.widths[tensor]
        if node.size is not None or width == 1:
            return tensor
        if width <= _SPLIT:
            return self.graph.several("Split", width, tensor, self._indices([1] * width), axis=1)[k]
        return self.graph.op("Gather", tensor, self._indices([k]), axis=1)

    def _for_all(self, node: Node) -> str:
        """As `_column`, with a batch where the number is the same for all, too."""
        if node in self.batched:
            return self._column(node)
        some, _ = next(iter(self.given.values()))
        shape = self.graph.op("Shape", self.graph.op("Gather", some, self._indices([0]), axis=1))
        row = self.graph.op("Reshape", self._column(node), self._indices([1, node.size or 1]))
        return self.graph.op("Expand", row, shape)

    def _together(self, nodes: Pack) -> str:
        """The tensor that has these numbers as columns, or the one number that all of them are."""
        if all(node is nodes[0] for node in nodes):
            return self._column(nodes[0])
        if all(node.constant for node in nodes):
            return self.graph.constant(np.stack([node.about for node in nodes]))
        places = [self.places.get(node) for node in nodes]
        if self._is_whole(places):
            assert places[0] is not None
            return places[0][0]
        if len({place and place[0] for place in places}) == 1:
            columns = [place[1] for place in places if place]
            return self.graph.op("Gather", self.places[nodes[0]][0], self._indices(columns), axis=1)
        parts, k = [], 0
        while k < len(nodes):
            place = places[k]
            width = self.widths[place[0]] if place else 1
            if place and width > 1 and self._is_whole(places[k : k + width]):
                parts.append(place[0])
                k += width
            else:
                parts.append(self._for_all(nodes[k]))
                k += 1
        return self.graph.op("Concat", *parts, axis=1)

    def _is_whole(self, places: Sequence[tuple[str, int] | None]) -> bool:
        """Whether these are all columns of a tensor, in order."""
        if not places or places[0] is None:
            return False
        tensor, _ = places[0]
        return list(places) == [(tensor, k) for k in range(self.widths[tensor])]

    # Operations

    def _write(self, pack: Pack) -> None:
        first, operation = pack[0], self.numbers.operations[pack[0]]
        if operation == "counter":
            return
        inputs = list(zip(*(self.numbers.inputs[node] for node in pack), strict=True))
        if operation in ("given", "element", "dot") or any(
            one in self.batched for part in inputs for one in part
        ):
            self.batched.update(pack)
        elif operation == "reduce":
            raise NotTranslatable("there is no reduction of constants in ONNX")
        if operation in ("given", "same", "element", "dot"):
            self._placed(operation, first)
            return
        rule = getattr(self, f"_{operation}", None)
        if first.kind == "i" and operation in ("and", "or", "xor", "not"):
            raise NotTranslatable(f"there is no {operation!r} of whole numbers in ONNX {OPSET}")
        if operation in CHAINS and len(inputs) > 2:
            tensor = self._chained(operation, first, inputs)
        elif operation in _OPERATORS:
            tensor = self.graph.op(_OPERATORS[operation], *map(self._together, inputs))
        elif operation.startswith("to_"):
            tensor = self._converted(first, self._together(inputs[0]))
        elif rule is not None:
            tensor = rule(first, *map(self._together, inputs))
        else:
            raise NotTranslatable(f"there is no {operation!r} in ONNX")
        self._put(pack, tensor)

    def _chained(self, operation: str, first: Node, inputs: Sequence[Pack]) -> str:
        alone = tuple(part[0] for part in inputs)
        if len(inputs[0]) == 1 and (first.kind == "b" or self._is_whole([*map(self.places.get, alone)])):
            return self._over(operation, self._together(alone), first.kind)
        found, *rest = map(self._together, inputs)
        if first.kind == "f":
            return self.graph.op(_SEVERAL[operation], found, *rest)
        for one in rest:
            found = self.graph.op(_OPERATORS[operation], found, one)
        return found

    def _over(self, operation: str, tensor: str, kind: str) -> str:
        """A reduction over the columns."""
        if kind == "b":
            tensor = self.graph.op("Cast", tensor, to=ELEMENTS["u"])
        axes: dict[str, Any] = {"keepdims": 1}
        inputs = [tensor]
        if operation == "add":
            inputs.append(self._indices([1]))
        else:
            axes["axes"] = (1,)
        found = self.graph.op(_REDUCED[operation], *inputs, **axes)
        return self.graph.op("Cast", found, to=ELEMENTS["b"]) if kind == "b" else found

    def _reduce(self, node: Node, tensor: str) -> str:
        if not node.about.startswith("arg"):
            return self._over(node.about, tensor, node.kind)
        found = self.graph.op(f"Arg{node.about[3:].capitalize()}", tensor, axis=1, keepdims=1)
        return self.graph.op("Cast", found, to=ELEMENTS["i"])

    def _converted(self, node: Node, value: str) -> str:
        if node.kind == "i" and node.inputs[0].kind == "f":
            ends = (self.graph.constant(np.float32(end)) for end in (-(2.0**31), 2.0**31 - 128.0))
            value = self.graph.op("Clip", value, *ends)
        return self.graph.op("Cast", value, to=ELEMENTS[node.kind])

    def _is_finite(self, node: Node, value: str) -> str:
        return self.graph.op("Less", self.graph.op("Abs", value), self._number(np.inf))

    def _number(self, value: float) -> str:
        return self.graph.constant(np.float32(value))

    def _ne(self, node: Node, one: str, other: str) -> str:
        return self.graph.op("Not", self.graph.op("Equal", one, other))

    def _select(self, node: Node, flag: str, yes: str, no: str) -> str:
        if node.kind != "b":
            return self.graph.op("Where", flag, yes, no)
        against = self.graph.op("And", self.graph.op("Not", flag), no)
        return self.graph.op("Or", self.graph.op("And", flag, yes), against)

    def _rem(self, node: Node, one: str, other: str) -> str:
        return self.graph.op("Mod", one, other, fmod=1)

    def _atan2(self, node: Node, y: str, x: str) -> str:
        zero = self._number(0.0)
        angle = self.graph.op("Atan", self.graph.op("Div", self.graph.op("Abs", y), self.graph.op("Abs", x)))
        angle = self.graph.op("Where", self.graph.op("IsNaN", angle), zero, angle)
        behind = self.graph.op("Sub", self._number(np.pi), angle)
        angle = self.graph.op("Where", self.graph.op("Less", x, zero), behind, angle)
        return self.graph.op("Where", self.graph.op("Less", y, zero), self.graph.op("Neg", angle), angle)

    def _log1p(self, node: Node, x: str) -> str:
        # Right near 0, too: W. Kahan's way.
        one = self._number(1.0)
        more = self.graph.op("Add", x, one)
        step, log = self.graph.op("Sub", more, one), self.graph.op("Log", more)
        scaled = self.graph.op("Mul", log, self.graph.op("Div", x, step))
        scaled = self.graph.op("Where", self.graph.op("Equal", step, self._number(0.0)), x, scaled)
        return self.graph.op("Where", self.graph.op("Equal", step, x), log, scaled)

    def _entry(self, node: Node, index: str) -> str:
        table = self.graph.constant(self.numbers.program.tables.arrays[node.about])
        found = self.graph.op("Gather", table, index)
        return self.graph.op("Cast", found, to=ELEMENTS["i"]) if node.kind == "i" else found

    # What is there already, or stands in an array

    def _placed(self, operation: str, node: Node) -> None:
        if operation == "given":
            self.places[node] = self.given[node.about]
        elif operation == "dot":
            self._dot(node)
        elif operation == "element":
            self._element(node)
        else:
            self._put((node,), self._column(node.inputs[0]))

    def _array(self, array: Stored) -> str:
        """The tensor `(batch, size)` of an array."""
        if array not in self.arrays:
            nodes = tuple(node for _, node in sorted(array.parts, key=lambda part: part[0]))
            if all(node.size is None for node in nodes) and len(set(nodes)) > 1:
                tensor = self._together(nodes)
            else:
                parts = [self._for_all(node) for node in nodes]
                tensor = parts[0] if len(parts) == 1 else self.graph.op("Concat", *parts, axis=1)
            self.arrays[array] = tensor
            self.widths.setdefault(tensor, array.size)
        return self.arrays[array]

    def _element(self, node: Node) -> None:
        (index,), array = node.inputs, node.about
        if index.constant:
            at = int(index.about)
            same = [part for offset, part in array.parts if part.size is None and offset == at]
            if same and not same[0].constant:
                self.places[node] = self.places[same[0]]
            else:
                self.places[node] = (self._array(array), at)
        elif index.operation == "counter" and index.about == array.size:
            self.places[node] = (self._array(array), 0)
        else:
            operator = "GatherElements" if index in self.batched else "Gather"
            self._put((node,), self.graph.op(operator, self._array(array), self._column(index), axis=1))

    def _dot(self, node: Node) -> None:
        row, number = node.inputs
        rows = self.numbers.program.tables.arrays[int(number.about)].reshape(-1, node.about.size)
        wanted = sorted(self.rows[node.about, number]) if row.constant else list(range(len(rows)))
        weights = self.graph.constant(np.ascontiguousarray(rows[wanted].T))
        product = self.graph.op("MatMul", self._array(node.about), weights)
        self.widths.setdefault(product, len(wanted))
        self.places[node] = (product, wanted.index(int(row.about)) if row.constant else 0)
