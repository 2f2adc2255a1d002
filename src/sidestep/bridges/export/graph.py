"""An ONNX graph under construction."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, no_type_check

import numpy as np

from sidestep._packages import needed

OPSET = 17
"""Supported since onnxruntime 1.12."""
_IR_VERSION = 8
ELEMENTS = {"f": 1, "u": 2, "i": 6, "b": 9}
"""ONNX's numbers for float, uint8, int32 and bool."""


@no_type_check  # called millions of times: checking types would take the tests a minute
class Graph:
    """Nodes in the order in which they are computed; tensors go by their names. Equal nodes and equal
    constants are there once."""

    def __init__(self) -> None:
        self._nodes: list[tuple[str, tuple[str, ...], list[str], dict[str, Any]]] = []
        self._constants: dict[tuple[str, tuple[int, ...], bytes], tuple[str, np.ndarray]] = {}
        self._inputs: list[tuple[str, str, list[int | str]]] = []
        self._outputs: list[tuple[str, str, list[int | str]]] = []
        self._known: dict[Any, list[str]] = {}
        self._renamed: dict[str, str] = {}

    @property
    def size(self) -> int:
        """Number of nodes."""
        return len(self._nodes)

    @property
    def operators(self) -> list[str]:
        """The operator of each node."""
        return [operator for operator, *_ in self._nodes]

    def input(self, name: str, kind: str, *shape: int | str) -> str:
        """An input; sizes given as text are symbolic."""
        self._inputs.append((name, kind, list(shape)))
        return name

    def output(self, name: str, tensor: str, kind: str, *shape: int | str) -> None:
        """Make `tensor` an output of this name."""
        if tensor in self._renamed or tensor in (given for given, _, _ in self._inputs):
            self._nodes.append(("Identity", (tensor,), [name], {}))
        else:
            self._renamed[tensor] = name
        self._outputs.append((name, kind, list(shape)))

    def constant(self, value: np.ndarray | np.generic) -> str:
        """A constant."""
        value = np.asarray(value)
        key = (value.dtype.str, value.shape, value.tobytes())
        name, _ = self._constants.setdefault(key, (f"c{len(self._constants)}", value))
        return name

    def op(self, operator: str, *inputs: str, **attributes: Any) -> str:
        """The output of a node of this ONNX operator."""
        return self.several(operator, 1, *inputs, **attributes)[0]

    def several(self, operator: str, count: int, *inputs: str, **attributes: Any) -> list[str]:
        """The outputs of a node of this ONNX operator."""
        key = (operator, inputs, tuple(sorted(attributes.items())))
        if key not in self._known:
            begin = f"t{len(self._nodes)}"
            names = [begin] if count == 1 else [f"{begin}_{k}" for k in range(count)]
            self._nodes.append((operator, inputs, names, attributes))
            self._known[key] = names
        return self._known[key]

    def model(self, name: str, text: str, metadata: dict[str, str]) -> bytes:
        """The checked model as bytes; equal graphs give equal bytes.

        **Raises** `ValueError` where onnx is missing, `onnx.checker.ValidationError` for a graph that is no
        valid ONNX.
        """
        onnx = needed("onnx", "export", "exporting needs")

        def described(values: Sequence[tuple[str, str, list[int | str]]]) -> list[Any]:
            return [
                onnx.helper.make_tensor_value_info(name, ELEMENTS[kind], shape)
                for name, kind, shape in values
            ]

        def names(tensors: Sequence[str]) -> list[str]:
            return [self._renamed.get(tensor, tensor) for tensor in tensors]

        nodes = [
            onnx.helper.make_node(operator, names(inputs), names(outputs), **attributes)
            for operator, inputs, outputs, attributes in self._nodes
        ]
        constants = [onnx.numpy_helper.from_array(array, label) for label, array in self._constants.values()]
        graph = onnx.helper.make_graph(
            nodes, name, described(self._inputs), described(self._outputs), constants
        )
        model = onnx.helper.make_model(
            graph, opset_imports=[onnx.helper.make_opsetid("", OPSET)], ir_version=_IR_VERSION
        )
        model.producer_name = "sidestep"
        model.doc_string = text
        onnx.helper.set_model_props(model, metadata)
        onnx.checker.check_model(model, full_check=True)
        return model.SerializeToString(deterministic=True)
