"""Write ONNX graphs as formulas.

A `Tensor` is a symbolic value; arithmetic on it adds nodes to its `Graph`. onnxruntime takes about 0.3 us per
node, however small, and three times as long for a `Where`. Formulas therefore use few nodes on wide tensors,
and `min`, `max` and signs in place of `Where`.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, TypeAlias

import numpy as np

from sidestep._packages import needed

OPSET = 17
"""Supported since onnxruntime 1.12."""
_IR_VERSION = 8

Number: TypeAlias = "Tensor | float | np.ndarray | Sequence[Any]"


class Tensor:
    """A value in a graph. `+ - * / @ <` add nodes; the other operand may be a number or an array
    (float32)."""

    def __init__(self, graph: Graph, name: str):
        self.graph = graph
        self.name = name

    def __add__(self, other: Number) -> Tensor:
        return self.graph.op("Add", self, other)

    def __radd__(self, other: Number) -> Tensor:
        return self.graph.op("Add", other, self)

    def __sub__(self, other: Number) -> Tensor:
        return self.graph.op("Sub", self, other)

    def __rsub__(self, other: Number) -> Tensor:
        return self.graph.op("Sub", other, self)

    def __mul__(self, other: Number) -> Tensor:
        return self.graph.op("Mul", self, other)

    def __rmul__(self, other: Number) -> Tensor:
        return self.graph.op("Mul", other, self)

    def __truediv__(self, other: Number) -> Tensor:
        return self.graph.op("Div", self, other)

    def __rtruediv__(self, other: Number) -> Tensor:
        return self.graph.op("Div", other, self)

    def __matmul__(self, other: Number) -> Tensor:
        return self.graph.op("MatMul", self, other)

    def __neg__(self) -> Tensor:
        return self.graph.op("Neg", self)

    def __lt__(self, other: Number) -> Tensor:
        return self.graph.op("Less", self, other)

    def __gt__(self, other: Number) -> Tensor:
        return self.graph.op("Greater", self, other)

    def apply(self, operator: str) -> Tensor:
        """A function of one argument by its ONNX name: `Abs`, `Sign`, `Cos`, `Relu`, ..."""
        return self.graph.op(operator, self)

    def over(self, reduction: str, axis: int = -1) -> Tensor:
        """A reduction by its ONNX name (`ReduceMax`, `ReduceL2`, ...) along one axis, kept with size 1."""
        if reduction == "ReduceSum":
            return self.graph.op(reduction, self, np.array([axis]), keepdims=1)
        return self.graph.op(reduction, self, axes=[axis], keepdims=1)

    def reshape(self, *shape: int) -> Tensor:
        """Another shape; 0 keeps a size, -1 is inferred."""
        return self.graph.op("Reshape", self, np.array(shape))

    def transpose(self, *order: int) -> Tensor:
        """Permute the axes."""
        return self.graph.op("Transpose", self, perm=list(order))

    def take(self, indices: Sequence[int], axis: int = -1) -> Tensor:
        """Entries by index along an axis."""
        return self.graph.op("Gather", self, np.array(indices), axis=axis)

    def part(self, start: int, stop: int, axis: int = -1) -> Tensor:
        """Entries `start` to `stop` of an axis; onnxruntime gathers faster than it slices."""
        return self.take(range(start, stop), axis)


class Graph:
    """An ONNX graph under construction. Equal constants are stored once; names follow creation order."""

    def __init__(self) -> None:
        self._onnx = needed("onnx", "export", "exporting needs")
        self._nodes: list[Any] = []
        self._constants: dict[tuple[str, tuple[int, ...], bytes], tuple[str, np.ndarray]] = {}
        self._inputs: list[Any] = []
        self._outputs: list[Any] = []
        self._renamed: dict[str, str] = {}
        self._known: dict[tuple[str, tuple[str, ...], str], Tensor] = {}

    @property
    def size(self) -> int:
        """Number of nodes."""
        return len(self._nodes)

    def _described(self, name: str, shape: Sequence[int | str], kind: str) -> Any:
        element = getattr(self._onnx.TensorProto, kind)
        return self._onnx.helper.make_tensor_value_info(name, element, list(shape))

    def input(self, name: str, *shape: int | str) -> Tensor:
        """A float32 input; sizes given as text are symbolic."""
        self._inputs.append(self._described(name, shape, "FLOAT"))
        return Tensor(self, name)

    def output(self, name: str, value: Tensor, *shape: int | str, kind: str = "FLOAT") -> None:
        """Make `value`, the result of a node, an output of this name."""
        self._renamed[value.name] = name
        self._outputs.append(self._described(name, shape, kind))

    def constant(self, value: Any) -> Tensor:
        """A constant: float32, or int64 for integer arrays."""
        array = np.asarray(value)
        array = np.ascontiguousarray(array, np.int64 if array.dtype.kind in "iu" else np.float32).reshape(
            array.shape
        )
        key = (array.dtype.str, array.shape, array.tobytes())
        name, _ = self._constants.setdefault(key, (f"c{len(self._constants)}", array))
        return Tensor(self, name)

    def _names(self, inputs: Sequence[Number | None]) -> list[str]:
        """Names of tensors and constants; None is an omitted optional input."""
        values = [self.constant(_plain(x)) if not isinstance(x, Tensor | None) else x for x in inputs]
        return ["" if value is None else value.name for value in values]

    def op(self, operator: str, *inputs: Number | None, **attributes: Any) -> Tensor:
        """A node of this ONNX operator, with one output; an equal node is reused."""
        names = self._names(inputs)
        key = (operator, tuple(names), repr(attributes))
        if key not in self._known:
            output = f"t{len(self._nodes)}"
            self._nodes.append(self._onnx.helper.make_node(operator, names, [output], **attributes))
            self._known[key] = Tensor(self, output)
        return self._known[key]

    def several(self, operator: str, count: int, *inputs: Number | None, **attributes: Any) -> list[Tensor]:
        """A node of this ONNX operator, with `count` outputs."""
        names = self._names(inputs)
        outputs = [f"t{len(self._nodes)}_{index}" for index in range(count)]
        self._nodes.append(self._onnx.helper.make_node(operator, names, outputs, **attributes))
        return [Tensor(self, name) for name in outputs]

    def split(self, value: Tensor, *sizes: int) -> list[Tensor]:
        """Split `value` along its last axis."""
        return self.several("Split", len(sizes), value, np.array(sizes), axis=-1)

    def linear(
        self, value: Tensor, weights: np.ndarray, bias: Any = None, *, added: Tensor | None = None
    ) -> Tensor:
        """value @ weights + bias for `value (batch, n)`: the cheapest way to select, repeat, scale and add
        columns. `added (batch, ...)` is a bias that is not constant; `bias` may be a scalar."""
        if added is not None:
            return self.op("Gemm", value, weights, added)
        if bias is None:
            return self.op("Gemm", value, weights)
        return self.op("Gemm", value, weights, np.broadcast_to(np.asarray(bias, float), weights.shape[1:]))

    def join(self, *parts: Number, axis: int = -1) -> Tensor:
        """Concatenate along an axis."""
        return (
            parts[0]
            if len(parts) == 1 and isinstance(parts[0], Tensor)
            else self.op("Concat", *parts, axis=axis)
        )

    def largest(self, *values: Number) -> Tensor:
        """Elementwise maximum."""
        if len(values) == 2 and isinstance(values[1], float):
            return self.op("Clip", *values)
        return self.op("Max", *values)

    def least(self, *values: Number) -> Tensor:
        """Elementwise minimum."""
        if len(values) == 2 and isinstance(values[1], float):
            return self.op("Clip", values[0], None, values[1])
        return self.op("Min", *values)

    def where(self, condition: Tensor, value: Number, otherwise: Number) -> Tensor:
        """`value` where the condition holds, else `otherwise`; NaN in the branch not taken has no effect."""
        return self.op("Where", condition, value, otherwise)

    def model(self, name: str, text: str, metadata: dict[str, str]) -> bytes:
        """The checked model as bytes; equal graphs give equal bytes.

        **Raises** `onnx.checker.ValidationError` for a graph that is no valid ONNX.
        """
        onnx = self._onnx
        for node in self._nodes:
            for names in (node.input, node.output):
                names[:] = [self._renamed.get(label, label) for label in names]
        constants = [onnx.numpy_helper.from_array(array, label) for label, array in self._constants.values()]
        graph = onnx.helper.make_graph(self._nodes, name, self._inputs, self._outputs, constants)
        model = onnx.helper.make_model(
            graph, opset_imports=[onnx.helper.make_opsetid("", OPSET)], ir_version=_IR_VERSION
        )
        model.producer_name = "sidestep"
        model.doc_string = text
        onnx.helper.set_model_props(model, metadata)
        onnx.checker.check_model(model, full_check=True)
        return model.SerializeToString(deterministic=True)


def _plain(value: Any) -> Any:
    """Python integers are float32 in formulas; integer arrays are indices and shapes."""
    return value if isinstance(value, np.ndarray) else np.asarray(value, np.float32)
