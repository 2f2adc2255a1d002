"""What has to be computed for one decision, as a graph computes it: without loops, arrays and branches."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Sequence
from graphlib import TopologicalSorter
from typing import Any, no_type_check

import numpy as np

from sidestep.bridges.export.program import Node, Program, Stored, live

CHAINS = ("add", "min", "max", "and", "or")
"""Operations of any number of inputs."""


@no_type_check  # called millions of times: checking types would take the tests a minute
class Numbers:
    """The nodes of a program on which `outputs` depend, in an `order` in which each comes after those that it
    needs. A condition is a choice between what its branches return; a chain of sums, or of least or largest,
    is one operation of several inputs. So `operations` and `inputs` may differ from those of the nodes."""

    def __init__(self, program: Program, outputs: Sequence[Node]):
        self.program, self.outputs = program, list(outputs)
        self.operations: dict[Node, str] = {}
        self.inputs: dict[Node, tuple[Node, ...]] = {}
        self._made: dict[Any, Node] = {}
        alive = live(program, self.outputs)
        for node in alive:
            if isinstance(node, Node) and node.operation not in ("constant", "condition", "store"):
                self._read(node)
        users = Counter(self.outputs)
        users.update(node for array in alive if isinstance(array, Stored) for _, node in array.parts)
        for inputs in self.inputs.values():
            users.update(inputs)
        for node in self._sorted():
            self._chain(node, users)
        self.order = self._sorted()

    def needs(self, node: Node) -> Iterator[Node]:
        """What has to be there before it."""
        yield from (one for one in self.inputs[node] if not one.constant)
        if isinstance(node.about, Stored):
            yield from (one for _, one in node.about.parts if not one.constant)

    def commutes(self, node: Node) -> bool:
        """Whether its two inputs can be swapped, to the last bit."""
        return (
            self.operations[node] in ("add", "mul", "and", "or", "eq", "ne") and len(self.inputs[node]) == 2
        )

    def _read(self, node: Node) -> None:
        if node.operation != "result":
            self.operations[node], self.inputs[node] = node.operation, node.inputs
            return
        (index,), (_, results) = node.inputs[0].inputs, node.inputs[0].about
        *before, found = [result[node.about] for result in results]
        for k, one in reversed(list(enumerate(before))):
            if index.operation == "to_i" and index.inputs[0].kind == "b":
                choice = (index.inputs[0], found, one)
            else:
                flag = self._new("le", (index, self.program.constant(np.int32(k))), "b")
                choice = (flag, one, found)
            if k:
                found = self._new("select", choice, node.kind)
            else:
                self.operations[node], self.inputs[node] = "select", choice

    def _new(self, operation: str, inputs: tuple[Node, ...], kind: str) -> Node:
        node = self._made.setdefault((operation, inputs), Node(operation, inputs, kind))
        self.operations[node], self.inputs[node] = operation, inputs
        return node

    def _sorted(self) -> list[Node]:
        sorter: TopologicalSorter[Node] = TopologicalSorter()
        waiting, seen = [node for node in self.outputs if not node.constant], set()
        while waiting:
            node = waiting.pop()
            if node not in seen:
                seen.add(node)
                before = list(self.needs(node))
                sorter.add(node, *before)
                waiting += before
        return list(sorter.static_order())

    def _chain(self, node: Node, users: Counter[Node]) -> None:
        """Take over the inputs of those inputs that only this node needs. Sums keep their order."""
        operation = self.operations[node]
        if operation not in CHAINS or node.size is not None or node.kind == "i":
            return
        found: list[Node] = []
        for k, one in enumerate(self.inputs[node]):
            joins = self.operations.get(one) == operation and users[one] == 1 and one.size is None
            found += self.inputs[one] if joins and (operation != "add" or k == 0) else [one]
        self.inputs[node] = tuple(found)
